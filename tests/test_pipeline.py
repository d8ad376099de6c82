import numpy as np
import pytest
import torch
from made_scenes import plane

from ditr_lite import pipeline
from ditr_lite.boundary import depth_aware
from ditr_lite.config import RefineConfig, override, preset
from ditr_lite.data import REFLECTIVE, TRANSPARENT
from ditr_lite.diffusion import sample
from ditr_lite.pipeline import Ditr, build, compose
from ditr_lite.region import refine_region
from ditr_lite.stage_two import BRANCHES, Plan
from ditr_lite.store import load_parts, save_part
from ditr_lite.windows import MOST, Layer, Painting, fit_frame, level, tie

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


def threshold_of(ditr, rgb, depth, share):
    """Return the threshold above which stage one, which untrained would claim everything, claims about ``share``."""
    return float(np.quantile(ditr.find_region(rgb, depth)[0], 1 - share))


# --- what comes back --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(64, 96), (100, 37), (50, 1000), (480, 640)])
@pytest.mark.parametrize("given", [True, False])
def test_any_size_comes_back_dense_and_with_its_readings(ditr, size, given):
    rgb, depth, region = frame(*size)
    before = rgb.copy(), depth.copy()
    out = ditr(rgb, depth, region if given else None, threshold=threshold_of(ditr, rgb, depth, 0.1))
    assert out.depth.shape == size and out.depth.dtype == np.float32
    assert np.isfinite(out.depth).all() and (out.depth > 0).all()
    for mask in (out.region, out.boundary_rgb, out.boundary_depth, out.boundary_da):
        assert mask.shape == size and mask.dtype == bool
    kept = ~out.region & (depth > 0)
    assert 0.05 < out.region.mean() < 0.4 and kept.mean() > 0.3
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
    threshold = threshold_of(ditr, rgb, depth, 0.1)
    out = ditr(rgb, depth, threshold=threshold)
    assert out.probability.shape == (64, 96) and 0 <= out.probability.min() <= out.probability.max() <= 1
    refine, claimed = TINY.refine, out.probability > threshold
    expected = refine_region(claimed, refine.median, refine.dilate, refine.iterations)
    assert np.array_equal(out.region, expected) and 0.05 < expected.mean() < 0.4
    assert not np.array_equal(expected, claimed)


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


def test_spread_is_the_standard_deviation_of_what_was_drawn(ditr, monkeypatch):
    drawn = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (5, 1, 1, 64, 96)).astype(np.float32))
    monkeypatch.setattr("ditr_lite.pipeline.paint", lambda *a: drawn)
    views, bounds = ditr.look([frame(64, 96)], None, False)
    mean, spread = ditr.paint(1, views, bounds, 1, 5, 0, Plan())
    metres = bounds.denormalise(drawn)[:, :, 0].numpy()
    assert np.allclose(mean, metres.mean(0), rtol=1e-5) and np.allclose(spread, metres.std(0, ddof=1), rtol=1e-4)
    assert not ditr.paint(1, views, bounds, 1, 1, 0, Plan())[1].any()  # of one sample there is none


def test_what_is_painted_may_be_far_nearer_than_what_was_read_but_never_nothing(ditr, monkeypatch):
    views, bounds = ditr.look([frame(64, 96)], None, False)
    for drawn, least in ((-2.5, 0.05), (-50.0, 0)):
        monkeypatch.setattr("ditr_lite.pipeline.paint", lambda *a, u=drawn: torch.full((1, 1, 1, 64, 96), u))
        metres = float(ditr.paint(0, views, bounds, 1, 1, 0, Plan())[0].max())
        assert metres == pytest.approx(float(bounds.denormalise(torch.tensor(drawn)).clamp(min=0.01)))
        assert least < metres < 0.5 * float(bounds.low)


def test_what_is_composed_is_as_sure_as_the_painting_says(ditr, monkeypatch):
    rgb, depth, region = frame(64, 96)
    view = fit_frame((64, 96), (64, 96))
    close, whole = (
        Layer(np.full((64, 96), v, np.float32), np.full((64, 96), s, np.float32), view)
        for v, s in ((0.6, 0.02), (1.6, 0.04))
    )
    holes, kept = ~region & (depth == 0), ~region & (depth > 0)
    painting = Painting(whole, (close,), None, np.packbits(holes, axis=1), (region,) * 3)
    monkeypatch.setattr(ditr, "inpaint", lambda *a: painting)
    out = ditr(rgb, depth, region, samples=2)
    assert np.allclose(out.depth[region], 0.6) and np.allclose(out.depth[holes], 1.6)
    assert np.allclose(out.std[region], 0.02) and np.allclose(out.std[holes], 0.04) and not out.std[kept].any()


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


# --- where it is painted ----------------------------------------------------------------------------------------------


def region_of(shape, *boxes):
    out = np.zeros(shape, bool)
    for top, left, bottom, right in boxes:
        out[top:bottom, left:right] = True
    return out


SHAPE = (120, 160)
GRID = [(8 + 36 * i, 5 + 32 * j, 20 + 36 * i, 15 + 32 * j) for i in range(3) for j in range(5)]
REGIONS = {
    "none": region_of(SHAPE),
    "all": ~region_of(SHAPE),
    "one pixel": region_of(SHAPE, (60, 80, 61, 81)),
    "every border": region_of(SHAPE, (0, 0, 20, 30), (100, 130, 120, 160), (0, 70, 5, 90), (50, 0, 70, 9)),
    "many blobs": region_of(SHAPE, *GRID),
}


@pytest.mark.parametrize("name", REGIONS)
def test_any_region_is_painted_in_windows_and_the_rest_is_kept(ditr, name):
    rgb, depth, _ = frame(*SHAPE)
    region = REGIONS[name]
    out = ditr(rgb, depth, region, samples=1, steps=1)
    kept = ~region & (depth > 0)
    assert same_bits(out.depth[kept], depth[kept]) and (out.depth > 0).all() and np.isfinite(out.depth).all()
    counts = {"none": (0, 0), "all": (1, 1), "one pixel": (1, 1), "many blobs": (MOST, MOST)}
    least, most = counts.get(name, (2, 4))
    assert least <= len(out.windows) <= most
    assert same_bits(out.optical[~region], out.geometric[~region])
    if region.any():
        assert (out.optical != out.geometric)[region].mean() > 0.9


def test_without_windows_the_optical_branch_paints_the_whole_frame():
    config = override(TINY, window=0)
    ditr = Ditr(untrained(config), config)
    rgb, depth, region = frame(*SHAPE)
    out = ditr(rgb, depth, region)
    assert out.windows == () and (out.optical != out.geometric)[~region].mean() > 0.9
    kept = ~region & (depth > 0)
    assert same_bits(out.depth[kept], depth[kept])


def test_windows_take_their_bounds_from_the_readings_around_the_region(ditr, monkeypatch):
    rgb, region = frame(64, 96)[0], region_of((64, 96), (20, 30, 44, 60))
    depth = np.tile(np.linspace(0.5, 0.6, 96, dtype=np.float32), (64, 1))
    far = np.where(region, 2 * depth, depth)
    monkeypatch.setattr(
        pipeline, "paint", lambda who, views, *a: torch.zeros(1, len(views.rgb), 1, *views.rgb.shape[2:])
    )
    one, other = (ditr(rgb, d, region, samples=1) for d in (depth, far))  # 0 is the middle of the bounds
    assert len(one.windows) == 1 and same_bits(one.depth[region], other.depth[region])


@pytest.mark.parametrize("distance", [0.3, 5.0])
def test_a_region_far_from_all_readings_is_painted_at_the_distance_of_the_frame(ditr, distance):
    rgb = frame(200, 400)[0]
    depth = np.zeros((200, 400), np.float32)
    depth[:, :40] = distance
    region = region_of((200, 400), (90, 350, 110, 370))
    out = ditr(rgb, depth, region, steps=1, samples=1)
    assert (out.windows[0].cut(depth) == 0).all()
    assert 0.6 * distance < np.median(out.depth[region]) < 1.6 * distance


def test_strays_beside_a_hole_do_not_move_what_is_painted_there(ditr):
    rgb, depth, _ = frame(64, 96)
    depth = np.where(depth > 0, depth, 0.7).astype(np.float32)
    depth[20:40, 40:60] = 0
    spoilt = depth.copy()
    spoilt[[22, 30, 36], 39] = 40.0
    nothing = np.zeros(depth.shape, bool)
    one, other = (ditr(rgb, d, nothing, steps=1, samples=1) for d in (depth, spoilt))
    hole = np.s_[20:40, 40:60]
    assert np.median(np.abs(other.depth[hole] / one.depth[hole] - 1)) < 0.05
    assert np.abs(np.log(other.depth[hole] / one.depth[hole])).max() < 0.1
    assert (other.depth[[22, 30, 36], 39] == 40).all()  # and they come back


# --- stage one --------------------------------------------------------------------------------------------------------


def test_threshold_and_kernels_are_the_callers_where_they_are_given(ditr):
    rgb, depth, _ = frame(64, 96)
    probability, _ = ditr.find_region(rgb, depth)
    level = float(np.median(probability))
    bare = RefineConfig(median=0, dilate=0)
    out = ditr(rgb, depth, samples=1, steps=1, threshold=level, refine=bare)
    assert np.array_equal(out.region, probability > level) and 0.3 < out.region.mean() < 0.7
    _, grown = ditr.find_region(rgb, depth, level, RefineConfig(0, 3, 1))
    assert np.array_equal(grown, refine_region(probability > level, 0, 3, 1))
    config = override(TINY, **{"refine.threshold": level, "refine.median": 0, "refine.dilate": 0})
    assert np.array_equal(Ditr(untrained(), config).find_region(rgb, depth)[1], out.region)


def test_temperature_makes_stage_one_less_sure(ditr):
    rgb, depth, _ = frame(64, 96)
    sure, _ = ditr.find_region(rgb, depth)
    config = override(TINY, **{"refine.temperature": 4.0})
    unsure, _ = Ditr(untrained(), config).find_region(rgb, depth)
    assert np.abs(unsure - 2 / 3).mean() < np.abs(sure - 2 / 3).mean()  # towards two classes of three


def test_the_logits_of_all_looks_are_averaged_at_the_working_size(ditr):
    looks = (1.5, 1.0)
    closer = Ditr(untrained(), override(TINY, **{"refine.looks": looks}))
    for given in (frame(64, 96)[:2], frame(128, 192)[:2]):
        size, classes = closer.classify(*given)
        assert (size.height, size.width) == (64, 96) and classes.shape == (3, 64, 96)
        logits = torch.stack([closer.region_logits(*given, scale) for scale in looks])
        assert np.allclose(classes, logits.mean(0).softmax(0).numpy(), atol=1e-6)
        assert np.allclose(ditr.classify(*given)[1], logits[1].softmax(0).numpy(), atol=1e-6)
        assert (logits[0] - logits[1]).abs().max() > 1e-3


def sure_of(ditr, monkeypatch, glass, metal):
    """Let stage one believe in glass and metal, (64, 96) probabilities each, and return them in float32."""
    glass, metal = (np.broadcast_to(np.float32(p), (64, 96)) for p in (glass, metal))
    classes = np.stack([1 - glass - metal, glass, metal])
    monkeypatch.setattr(ditr, "classify", lambda *_: (fit_frame((64, 96), (64, 96)), classes))
    return 1 - classes[0]


def test_the_likelier_class_is_named_and_the_belief_is_told_where_nothing_is_claimed_too(ditr, monkeypatch):
    rgb, depth, _ = frame(64, 96)
    columns = np.arange(96)
    glass = np.select([columns < 32, columns < 64], [0.7, 0.2], 0.1)
    metal = np.select([columns < 32, columns < 64], [0.1, 0.6], 0.2)
    believed = sure_of(ditr, monkeypatch, glass, metal)
    out = ditr(rgb, depth, samples=1, refine=RefineConfig(median=0, dilate=0))
    assert (out.classes[:, :32] == TRANSPARENT).all() and (out.classes[:, 32:64] == REFLECTIVE).all()
    assert not out.classes[:, 64:].any() and np.array_equal(out.region, np.tile(columns < 64, (64, 1)))
    assert np.array_equal(out.probability, believed) and np.allclose(out.probability[:, 64:], 0.3)


def test_a_reading_that_was_kept_is_the_less_sure_the_likelier_it_lies_on_glass(monkeypatch):
    rgb, depth, _ = frame(64, 96)
    unsure = Ditr(untrained(), override(TINY, **{"std.kept": 0.01, "std.missed": 0.2}))
    believed = sure_of(unsure, monkeypatch, np.where(np.arange(96) < 48, 0.04, 0.36), 0)
    out = unsure(rgb, depth)
    read = depth > 0
    assert not out.region.any()
    wanted = depth * np.hypot(0.01, 0.2 * np.sqrt(believed))
    assert np.allclose(out.std[read], wanted[read], rtol=1e-4)


def test_strays_reach_neither_stage_one_nor_the_outlines():
    rgb, seen = frame(64, 96)[0], []
    ditr = Ditr(untrained(), TINY, boundary=lambda image: seen.append(image) or np.zeros(image.shape[:2], bool))
    spoilt = plane(64, 96)
    without = spoilt.copy()
    spoilt[5:60:10, 7:90:12], without[5:60:10, 7:90:12] = 40, 0
    believed, wanted = (ditr.classify(rgb, d)[1] for d in (spoilt, without))
    assert np.array_equal(believed, wanted)
    ditr.boundaries(rgb, spoilt)
    assert np.array_equal(seen[-1], without) and seen[-1].ndim == 2


@pytest.mark.parametrize("size", [(64, 96), (60, 160)])
def test_each_outline_goes_by_its_own_name(size):
    def find(image):
        rows, columns = np.indices(image.shape[:2])
        return columns % 8 == 0 if image.ndim == 3 else (columns == 16) & (rows < 20)

    rgb, depth, region = frame(*size)
    ditr, fitted = Ditr(untrained(), TINY, boundary=find), fit_frame(size, TINY.size)
    small = np.zeros((fitted.height, fitted.width, 3)), np.zeros((fitted.height, fitted.width))
    m_rgb, m_d = map(find, small)
    wanted = [fitted.back(m) for m in (m_rgb, m_d, depth_aware(m_rgb, m_d))]
    assert len({m.tobytes() for m in wanted}) == 3 and all(m.any() for m in wanted)
    out = ditr(rgb, depth, region)
    for found in ((out.boundary_rgb, out.boundary_depth, out.boundary_da), ditr.boundaries(rgb, depth)):
        assert all(np.array_equal(*pair) for pair in zip(found, wanted, strict=True))


# --- who paints what --------------------------------------------------------------------------------------------------


def painted(ditr, plan=Plan(), depth=None):  # noqa: B008  frozen
    rgb, plain, region = frame(64, 96)
    return ditr.inpaint(rgb, plain if depth is None else depth, region, 1, 1, 0, plan)


@pytest.mark.parametrize(("guides", "changed"), [((None, 0), "optical"), ((2, None), "geometric")])
def test_each_branch_has_its_own_boundary_map(guides, changed):
    config = override(TINY, **{"detail.width": 0, "window": 0})  # the finer final step looks at M_RGB for both
    ditr = Ditr(untrained(config), config)
    plain, other = painted(ditr, Plan(guides=(2, 0))), painted(ditr, Plan(guides=guides))
    assert [b for b in BRANCHES if not np.array_equal(getattr(plain, b), getattr(other, b))] == [changed]


def test_painters_can_change_places():
    config = override(TINY, **{"window": 0, "evidence": False, "detail.width": 0})
    ditr = Ditr(untrained(config), config)
    one, swapped = (painted(ditr, Plan(painters=p, guides=(0, 0))) for p in (BRANCHES, BRANCHES[::-1]))
    _, depth, region = frame(64, 96)
    holes = ~region & (depth == 0)
    tied = swapped.optical.copy()
    tie(tied, level(tied, depth, region), holes)
    assert np.allclose(tied[holes], one.geometric[holes], rtol=1e-4)
    assert not np.allclose(swapped.optical, one.optical, rtol=1e-3)


def test_evidence_and_detail_can_be_left_out(ditr):
    plain = painted(ditr).optical
    for plan in (Plan(evidence=False), Plan(detail=False)):
        assert not np.array_equal(painted(ditr, plan).optical, plain)
    assert ditr.painter("optical").evidence and not ditr.painter("geometric").evidence
    assert ditr.painter("optical", Plan(detail=False)).detail is None


def test_an_autoencoder_of_another_factor_is_refused_before_anything_is_painted():
    with pytest.raises(ValueError, match="expected 2 levels"):
        config = override(TINY, **{"autoencoder.multipliers": "1,2,4"})
        Ditr(build(config), config)


@pytest.mark.parametrize("width", [0, TINY.detail.width])  # without and with the final step, which sees readings, too
@pytest.mark.parametrize("evidence", [True, False])
def test_readings_inside_the_region_matter_only_as_evidence(evidence, width):
    config = override(TINY, **{"evidence": evidence, "detail.width": width, "window": 0})
    ditr = Ditr(untrained(config), config)
    rgb, depth, region = frame(64, 96)
    other = depth.copy()
    other[region] = other[region][::-1]  # the same readings elsewhere: the bounds stay
    one, two = (painted(ditr, Plan(guides=(None, None)), d).optical for d in (depth, other))
    assert np.allclose(one[region], two[region], rtol=1e-5) != evidence
    plan = Plan(guides=(None, None), evidence=False)
    assert np.allclose(*(painted(ditr, plan, d).optical[region] for d in (depth, other)), rtol=1e-5)


@pytest.mark.parametrize("times", [0.5, 3.0])
def test_output_is_metric(ditr, times):
    rgb, depth, region = frame(64, 96)
    one, far = (ditr(rgb, (k * depth).astype(np.float32), region) for k in (1, times))
    for branch in BRANCHES:
        assert np.median(np.abs(getattr(far, branch) / getattr(one, branch) / times - 1)) < 0.01


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


def test_loading_asks_for_the_preset_and_takes_the_callers_sampler(tmp_path):
    for name, part in untrained().items():
        save_part(name, part.state_dict(), TINY, tmp_path, {})
    calls = []

    def own(*given, **how):
        calls.append(given[1])
        return sample(*given, **how)

    loaded = Ditr.from_pretrained(tmp_path, preset="tiny", sampler=own)
    assert loaded.config == TINY
    loaded(*frame(64, 96), samples=1)
    assert len(calls) == len(BRANCHES)
    with pytest.raises(ValueError, match="only the tiny preset is what"):
        Ditr.from_pretrained(tmp_path, preset="lite")


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
        ({"threshold": "high"}, "threshold: expected a probability"),
        ({"threshold": float("nan")}, "threshold: expected a probability"),
        ({"refine": (3, 3, 1)}, "refine: expected a config.RefineConfig"),
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


def test_maps_are_made_when_they_are_asked_for_and_stay(ditr):
    rgb, depth, region = frame(100, 150)
    out, again = ditr(rgb, depth, samples=1), ditr(rgb, depth, samples=1)
    again.depth[:], depth[:] = 0, 9  # neither what came nor what was given is looked at later
    for key in ("boundary_rgb", "boundary_depth", "boundary_da", "probability", "optical", "geometric", "classes"):
        first = getattr(out, key)
        assert first is getattr(out, key) and np.array_equal(first, getattr(again, key)), key
    assert out.classes.dtype == np.uint8 and ((out.classes > 0) == (out.probability > 0.5)).mean() > 0.98
    assert ditr(rgb, frame(100, 150)[1], region, samples=1).classes is None


def test_stage_one_and_the_boundaries_of_the_frame_are_found_once(monkeypatch):
    seen, asked = [], []
    ditr = Ditr(untrained(), TINY, boundary=lambda image: seen.append(image.shape) or np.zeros(image.shape[:2], bool))
    classify = ditr.classify
    monkeypatch.setattr(ditr, "classify", lambda *a: asked.append(1) or classify(*a))
    rgb, depth, region = frame(60, 160)
    out = ditr(rgb, depth, np.zeros_like(region), samples=1)
    assert len(seen) == 2 and not out.boundary_da.any() and not asked
    assert out.boundary_rgb.shape == (60, 160)
    ditr(rgb, depth, samples=1)
    assert len(asked) == 1


@pytest.mark.parametrize("strip", [1, 4000])
def test_a_large_frame_is_worked_on_in_strips_with_the_same_bits(ditr, monkeypatch, strip):
    rgb, depth, region = frame(333, 500)
    depth[5:300:40, 7:400:50] = 30  # strays
    keys = ("depth", "std", "optical", "geometric", "boundary_da")
    whole = ditr(rgb, depth, region, samples=2)
    monkeypatch.setattr("ditr_lite.units.STRIP", strip)
    parts = ditr(rgb, depth, region, samples=2)
    assert all(getattr(whole, key).tobytes() == getattr(parts, key).tobytes() for key in keys)


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
