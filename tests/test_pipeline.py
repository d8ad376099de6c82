import numpy as np
import pytest
import torch

from ditr_lite import pipeline
from ditr_lite.conditioning import depth_bounds
from ditr_lite.config import override, preset
from ditr_lite.data import SAMPLES, read_sample
from ditr_lite.pipeline import BRANCHES, Ditr, build, compose
from ditr_lite.region import refine_region
from ditr_lite.store import load_parts, save_part

TINY = override(preset("tiny"), **{"sampler.steps": 2, "sampler.samples": 1})


def untrained(config=TINY, seed=0):
    """Return the networks with woken-up output layers, which otherwise start at zero."""
    torch.manual_seed(seed)
    parts = build(config)
    for parameter in parts.parameters():
        if parameter.ndim > 1 and not parameter.any():
            torch.nn.init.normal_(parameter, std=0.05)
    return parts


@pytest.fixture(scope="module")
def ditr():
    return Ditr(untrained(), TINY)


@pytest.fixture(scope="module")
def sample():
    return read_sample(SAMPLES / "val" / "val_00000")


def frame(height, width, seed=0):
    """Return colours, a sloping table with a step and holes, and a region in the middle."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width] / max(height, width)
    depth = (0.6 + 0.3 * v + 0.2 * (u > 0.5) + 0.001 * rng.random(v.shape)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    region = np.zeros(depth.shape, bool)
    region[height // 4 : height // 2, width // 4 : 3 * width // 4] = True
    return rng.integers(0, 256, (height, width, 3), np.uint8), depth, region


def same_bits(a, b):
    return np.array_equal(a.view(np.uint32), b.view(np.uint32))


# --- what comes back --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(64, 96), (100, 37), (33, 200), (720, 1280)])
@pytest.mark.parametrize("given", [True, False])
def test_any_size_comes_back_dense_and_with_its_readings(ditr, size, given):
    rgb, depth, region = frame(*size)
    before = rgb.copy(), depth.copy()
    out = ditr(rgb, depth, region if given else None)
    assert out.depth.shape == size and out.depth.dtype == np.float32
    assert np.isfinite(out.depth).all() and (out.depth > 0).all()
    for mask in (out.region, out.boundary_rgb, out.boundary_depth, out.boundary_da):
        assert mask.shape == size and mask.dtype == bool
    kept = ~out.region & (depth > 0)
    assert same_bits(out.depth[kept], depth[kept])
    assert np.array_equal(rgb, before[0]) and same_bits(depth, before[1])
    assert (out.std[kept] == 0).all() and out.std.dtype == np.float32


def test_given_region_is_respected(ditr):
    rgb, depth, region = frame(64, 96)
    out = ditr(rgb, depth, region)
    assert np.array_equal(out.region, region) and out.probability is None
    assert (out.depth != depth)[region].mean() > 0.99
    assert same_bits(ditr(rgb, depth, region.tolist()).depth, out.depth)
    nothing = ditr(rgb, depth, np.zeros_like(region))
    assert same_bits(nothing.depth[depth > 0], depth[depth > 0])


def test_stage_one_finds_the_region_and_refines_it(ditr):
    rgb, depth, _ = frame(64, 96)  # the working size: nothing is resized
    out = ditr(rgb, depth)
    assert out.probability.shape == (64, 96) and 0 <= out.probability.min() <= out.probability.max() <= 1
    refine = TINY.refine
    expected = refine_region(out.probability > 0.5, refine.median, refine.dilate, refine.iterations)
    assert np.array_equal(out.region, expected)


def test_the_result_is_composed_of_what_both_branches_painted(ditr):
    rgb, depth, region = frame(64, 96)
    out = ditr(rgb, depth, region, samples=2)
    assert same_bits(out.depth, compose(depth, out.optical, out.geometric, region))
    for mine in (out.optical, out.geometric):
        assert mine.shape == (64, 96) and (mine > 0).all()
    assert not np.array_equal(out.optical, out.geometric)


def test_adjusting_moves_readings_outside_the_region_too(ditr):
    rgb, depth, region = frame(64, 96)
    kept, moved = (ditr(rgb, depth, region, adjust=a) for a in (False, True))
    outside = ~region & (depth > 0)
    assert (moved.depth != depth)[outside].mean() > 0.99
    assert same_bits(moved.depth[outside], moved.geometric[outside])
    assert same_bits(kept.depth[~outside], moved.depth[~outside])


# --- chance -----------------------------------------------------------------------------------------------------------


def test_a_seed_gives_the_same_bytes(ditr):
    rgb, depth, region = frame(64, 96)
    one, again, other = (ditr(rgb, depth, region, seed=s) for s in (5, 5, 6))
    assert same_bits(one.depth, again.depth) and not same_bits(one.depth, other.depth)


def test_spread_is_that_of_the_samples(ditr):
    rgb, depth, region = frame(64, 96)
    one, many = (ditr(rgb, depth, region, samples=n) for n in (1, 3))
    assert (one.std == 0).all()
    painted = region | (depth == 0)
    assert (many.std[painted] > 0).mean() > 0.95 and (many.std[~painted] == 0).all()


def test_spread_of_two_samples_is_their_distance_over_root_two(ditr, monkeypatch):
    rgb, depth, region = frame(64, 96)
    two = np.stack([np.full((64, 96), 0.5), np.full((64, 96), 0.7)]).astype(np.float32)
    monkeypatch.setattr(ditr, "inpaint", lambda *a: (two, two + 1))
    out = ditr(rgb, depth, region, samples=2)
    assert np.allclose(out.depth[region], 0.6) and np.allclose(out.depth[~region & (depth == 0)], 1.6)
    assert np.allclose(out.std[region], 0.2 / np.sqrt(2)) and (out.std[~region & (depth > 0)] == 0).all()


def test_spread_is_the_standard_deviation_of_what_was_drawn(ditr, monkeypatch):
    rgb, depth, region = frame(64, 96)
    drawn = np.random.default_rng(0).uniform(0.5, 1, (2, 5, 64, 96)).astype(np.float32)
    monkeypatch.setattr(ditr, "inpaint", lambda *a: tuple(drawn))
    std = ditr(rgb, depth, region, samples=5).std
    expected = np.where(region, *drawn.std(1, ddof=1, dtype=np.float64))
    assert std.dtype == np.float32 and np.allclose(std, np.where(region | (depth == 0), expected, 0), rtol=1e-5)


@pytest.mark.parametrize(("steps", "samples"), [(1, 1), (3, 2)])
def test_steps_and_samples_cost_what_they_say(ditr, steps, samples):
    rgb, depth, region = frame(64, 96)
    calls = {branch: [] for branch in BRANCHES}
    hooks = [
        ditr.parts[b].register_forward_hook(lambda m, given, out, b=b: calls[b].append(len(given[0]))) for b in BRANCHES
    ]
    ditr(rgb, depth, region, steps=steps, samples=samples)
    for hook in hooks:
        hook.remove()
    assert calls == {branch: [samples] * steps for branch in BRANCHES}


# --- what each branch sees --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("guide", "branch"), [(0, "geometric"), (2, "optical")])
def test_each_branch_has_its_own_boundary_map(guide, branch):
    config = override(TINY, **{"detail.width": 0})  # the finer final step looks at M_RGB for both
    ditr = Ditr(untrained(config), config)
    rgb, depth, region = frame(64, 96)
    maps = [np.zeros((64, 96), bool) for _ in range(3)]
    plain = ditr.inpaint(rgb, depth, region, maps, depth_bounds(depth), 1, 1, 0)
    maps[guide] = np.random.default_rng(0).random((64, 96)) < 0.3
    guided = ditr.inpaint(rgb, depth, region, maps, depth_bounds(depth), 1, 1, 0)
    changed = [b for b, p, g in zip(BRANCHES, plain, guided, strict=True) if not np.array_equal(p, g)]
    assert changed == [branch]


@pytest.mark.parametrize("evidence", [True, False])
def test_readings_inside_the_region_matter_only_as_evidence(evidence):
    config = override(TINY, evidence=evidence)
    ditr = Ditr(untrained(config), config)
    rgb, depth, region = frame(64, 96)
    other, maps = depth.copy(), [np.zeros((64, 96), bool)] * 3
    other[region] = other[region][::-1]  # the same readings elsewhere: the bounds stay
    one, two = (ditr.inpaint(rgb, d, region, maps, depth_bounds(depth), 1, 1, 0)[0][0] for d in (depth, other))
    assert np.array_equal(one[region], two[region]) != evidence


def test_output_is_metric(ditr, sample):
    out = ditr(sample.rgb, sample.depth, sample.region)
    twice = ditr(sample.rgb, 2 * sample.depth, sample.region)  # the raw depth alone sets the scale
    error = np.abs(twice.optical - 2 * out.optical) / out.optical
    assert np.median(error) < 0.01


# --- weights and errors -----------------------------------------------------------------------------------------------


def test_weights_from_a_folder_are_the_ones_used(tmp_path):
    parts = untrained()
    for name, part in parts.items():
        save_part(name, part.state_dict(), TINY, tmp_path, {})
    loaded = Ditr.from_pretrained(path=tmp_path)
    config, states = load_parts(tmp_path)
    assert loaded.config == TINY == config
    for name, part in loaded.parts.items():
        assert not part.training and not any(p.requires_grad for p in part.parameters())
        assert all(torch.equal(states[name][k], v) for k, v in part.state_dict().items())
    rgb, depth, region = frame(64, 96)
    half = build(TINY)
    for name, part in half.items():
        part.load_state_dict(states[name])
    assert same_bits(loaded(rgb, depth, region).depth, Ditr(half, TINY)(rgb, depth, region).depth)


def test_weights_of_another_size_are_refused_by_name(tmp_path):
    wide = override(TINY, **{"region.width": 16})
    for name, part in untrained().items():
        save_part(name, part.state_dict(), wide, tmp_path, {})  # the card says one thing, the file another
    with pytest.raises(ValueError, match="the region weights do not fit"):
        Ditr.from_pretrained(path=tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rgb": np.zeros((64, 96), np.uint8)}, "rgb: expected"),
        ({"depth": np.ones((64, 96), np.uint16)}, "divide millimetres"),
        ({"depth": np.zeros((64, 96), np.float32)}, "no reading"),
        ({"depth": np.ones((64, 95), np.float32)}, "align depth"),
        ({"region": np.zeros((64, 96))}, "region: expected"),
        ({"samples": 0}, "samples: expected at least 1"),
        ({"steps": 0}, "steps"),
        ({"steps": 1001}, "steps"),
    ],
)
def test_bad_requests_are_named(ditr, change, message):
    rgb, depth, region = frame(64, 96)
    with pytest.raises(ValueError, match=message):
        ditr(**{"rgb": rgb, "depth": depth, "region": region} | change)


def test_unknown_boundary_backend_is_refused():
    with pytest.raises(ValueError, match="classical"):
        Ditr(build(TINY), TINY, boundary="magic")


def test_a_few_scattered_readings_are_enough(ditr):
    rgb, depth, _ = frame(720, 1280)
    sparse = np.zeros_like(depth)
    sparse[::90, ::90] = np.maximum(depth[::90, ::90], 0.5)
    out = ditr(rgb, sparse, np.zeros(depth.shape, bool), steps=1)
    assert (out.depth > 0).all() and same_bits(out.depth[sparse > 0], sparse[sparse > 0])


def test_no_boundary_runs_along_the_edge_of_the_padding(ditr):
    rgb = np.full((60, 160, 3), 200, np.uint8)  # the tiny system pads it below
    out = ditr(rgb, np.full((60, 160), 0.7, np.float32), samples=1)
    assert not out.boundary_rgb.any()


def test_what_is_claimed_of_the_padding_does_not_grow_into_the_picture(ditr, monkeypatch):
    rgb, depth, _ = frame(60, 160)  # the tiny system pads it below
    classify = ditr.classify

    def claim_the_padding(*given):
        where, classes = classify(*given)
        return where, np.stack([where.picture, ~where.picture]).astype(np.float32)

    monkeypatch.setattr(ditr, "classify", claim_the_padding)
    _, region = ditr.find_region(rgb, depth)
    assert not region.any()


def test_each_branch_draws_noise_of_its_own_for_every_seed(ditr, monkeypatch):
    seeds = []

    def stop(painter, views, schedule, steps, samples, prediction, generator, sampler):
        seeds.append(generator.initial_seed())
        return torch.zeros(samples, len(views.rgb), 1, *views.rgb.shape[2:])

    monkeypatch.setattr(pipeline, "paint", stop)
    rgb, depth, region = frame(64, 96)
    region[20:30, 20:30] = True
    for seed in (0, 1, 2):
        ditr(rgb, depth, region, steps=1, samples=1, seed=seed)
    assert len(seeds) == 6 == len(set(seeds))
