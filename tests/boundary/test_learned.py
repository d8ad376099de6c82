import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ditr_lite import store
from ditr_lite.boundary import get_backend, precision_recall_f
from ditr_lite.boundary.learned import (
    MODES,
    BoundaryNet,
    LearnedBoundary,
    begin_with_stage_one,
    build_nets,
    depth_image,
    linear_units,
    load,
    thin,
)
from ditr_lite.config import RegionConfig, preset
from ditr_lite.region import RegionNet


def random_nets(seed=0):
    torch.manual_seed(seed)
    nets = build_nets()
    for net in nets.values():
        torch.nn.init.constant_(net.out.bias, 0.0)
    return nets


@pytest.fixture(scope="module")
def backend():
    return LearnedBoundary(random_nets(), {"rgb": 0.5, "depth": 0.5})


# ---- the network


def test_one_logit_a_pixel_and_few_boundaries_before_training():
    torch.manual_seed(0)
    out = BoundaryNet(3)(torch.randn(2, 3, 32, 48))
    assert out.shape == (2, 1, 32, 48) and 0.01 < torch.sigmoid(out).mean() < 0.15


def test_small_enough_to_ship(tmp_path):
    path = store.save_part("boundary", build_nets().state_dict(), preset("lite"), tmp_path, {})
    assert path.stat().st_size < 3_000_000


def test_every_parameter_learns():
    nets = random_nets()
    for mode, net in nets.items():
        net(torch.randn(1, MODES[mode], 32, 32)).square().mean().backward()
        assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in net.parameters()), mode


def test_encoders_begin_with_those_of_stage_one():
    torch.manual_seed(1)
    region, nets = RegionNet(RegionConfig(colour="scratch")), build_nets()
    assert begin_with_stage_one(nets, region.state_dict()) == ["rgb", "depth"]
    image = torch.randn(1, 3, 32, 32)
    for mine, theirs in zip(nets["rgb"].encoder(image), region.encoder_rgb(image), strict=True):
        assert torch.equal(mine, theirs)
    for mine, theirs in zip(nets["depth"].encoder(image), region.encoder_depth(image[:, :2]), strict=True):
        assert torch.allclose(mine, theirs, atol=1e-5)  # relief is not looked at yet
    assert nets["depth"].encoder.down[0][0].weight[:, 2].abs().sum() == 0


def test_encoders_that_are_not_alike_begin_afresh():
    for config, begun in ((RegionConfig(), ["depth"]), (RegionConfig(width=8, colour="scratch"), [])):
        torch.manual_seed(1)
        nets, same = random_nets(), random_nets()
        assert begin_with_stage_one(nets, RegionNet(config).state_dict()) == begun
        for mode in nets.keys() - set(begun):
            pairs = zip(nets[mode].parameters(), same[mode].parameters(), strict=True)
            assert all(torch.equal(a, b) for a, b in pairs)


# ---- what the depth network sees


def test_depth_image_hides_what_was_not_measured():
    depth, valid = torch.randn(1, 1, 20, 24), (torch.rand(1, 1, 20, 24) > 0.3).float()
    one, two = depth_image(depth, valid), depth_image(torch.where(valid > 0, depth, 99.0), valid)
    assert torch.equal(one, two) and one.shape == (1, 3, 20, 24)
    assert (one[:, [0, 2]] * (1 - valid) == 0).all() and torch.equal(one[:, 1:2], valid)


def test_relief_is_zero_on_a_wall_and_signed_at_a_step():
    valid = torch.ones(1, 1, 20, 40)
    valid[..., 8:10, 8:10] = 0
    wall = torch.full((1, 1, 20, 40), 0.3)
    assert depth_image(wall, valid)[:, 2].abs().max() < 1e-5
    wall[..., 20:] += 0.05
    relief = depth_image(wall, valid)[0, 2]
    assert (relief[12:, 19] < 0).all() and (relief[12:, 20] > 0).all() and relief[:, :14].abs().max() < 1e-5


def test_units_are_those_that_the_shipped_networks_were_trained_in():
    depth = np.linspace(1, 2, 101).reshape(1, -1).astype(np.float32)  # 2nd and 98th percentile: 1.02 and 1.98
    low, high = 1.02 - 0.25 * 0.96, 1.98 + 0.10 * 0.96
    wanted = 2 * (depth - low) / (high - low) - 1
    assert np.allclose(linear_units(depth), wanted, atol=1e-5) and linear_units(depth).dtype == np.float32
    holes = np.concatenate([depth, 0 * depth], axis=1)
    assert np.array_equal(linear_units(holes)[:, :101], linear_units(depth))
    wall = linear_units(np.float32([[0.7, 0.7, 0.71]]))  # a flat wall has a range of 15 cm and not more
    assert wall[0, 2] - wall[0, 0] == pytest.approx(2 * 0.01 / (1.35 * 0.15), rel=1e-3)


# ---- thinning


def test_a_soft_line_becomes_its_middle():
    x = np.arange(40, dtype=np.float32)
    bump = np.exp(-0.5 * ((x - 20) / 2) ** 2)
    for probability in (np.tile(bump, (40, 1)), np.tile(bump, (40, 1)).T):
        wanted = np.zeros((40, 40), bool)
        wanted[:, 20] = True
        wanted = wanted if probability[0].max() > 0.9 else wanted.T
        assert (thin(probability, 0.3) == wanted).all()


def test_a_diagonal_and_a_circle_stay_thin_and_connected():
    y, x = np.mgrid[:64, :64].astype(np.float32)
    for distance, true in (
        (np.abs(y - x) / 2**0.5, y == x),
        (np.abs(np.hypot(y - 32, x - 32) - 20), np.abs(np.hypot(y - 32, x - 32) - 20) <= 0.5),
    ):
        found = thin(np.exp(-0.5 * (distance / 1.5) ** 2), 0.3)
        precision, recall, _ = precision_recall_f(found, true, 1)
        assert precision > 0.97 and recall > 0.97
        blocks = found[1:, 1:] & found[:-1, 1:] & found[1:, :-1] & found[:-1, :-1]
        assert found.sum() <= 2 * true.sum() and blocks.sum() < 0.05 * true.sum()


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 1000), st.floats(0.1, 0.6), st.floats(0.1, 0.3))
def test_a_higher_threshold_never_adds_a_pixel(seed, low, more):
    probability = np.random.default_rng(seed).random((24, 31), dtype=np.float32)
    assert not (thin(probability, low + more, 1) & ~thin(probability, low, 1)).any()
    assert not thin(np.zeros((24, 31), np.float32), low).any()


# ---- the backend


def test_any_size_and_both_kinds_of_image(backend):
    rng = np.random.default_rng(0)
    for shape in ((48, 64), (37, 50), (5, 3)):
        for image in (rng.integers(0, 255, (*shape, 3), np.uint8), rng.uniform(0.5, 1, shape).astype(np.float32)):
            found, probability = backend(image), backend.probability(image)
            assert found.shape == probability.shape == shape and found.dtype == bool
            assert probability.dtype == np.float32 and (probability >= 0).all() and (probability <= 1).all()
            assert not (found & (backend.probability(image) <= 0)).any()
    assert (backend.probability(np.zeros((20, 30), np.float32)) == 0).all() and not backend(np.zeros((20, 30))).any()
    with pytest.raises(ValueError, match="expected RGB"):
        backend(np.zeros((8, 8, 3)))


def test_each_kind_of_image_goes_to_its_own_network_at_its_own_threshold(backend):
    depth = np.random.default_rng(1).uniform(0.5, 1, (32, 48)).astype(np.float32)
    depth[3:9, 4:20] = 0
    depth_n = torch.from_numpy(linear_units(depth))[None, None]
    x = depth_image(depth_n, torch.from_numpy(depth > 0).float()[None, None])
    with torch.no_grad():
        wanted = torch.sigmoid(backend.nets["depth"](x))[0, 0].numpy()
    assert np.allclose(backend.probability(depth), wanted, atol=1e-5)


class Line(torch.nn.Module):
    """Sees a vertical line of a given probability in everything."""

    def __init__(self, column, probability):
        super().__init__()
        self.column, self.logit = column, float(np.log(probability / (1 - probability)))

    def forward(self, x):
        out = torch.full((1, 1, *x.shape[2:]), -9.0)
        out[..., self.column - 1 : self.column + 2] = self.logit
        return out


def test_each_network_is_cut_at_its_own_threshold():
    nets = torch.nn.ModuleDict({"rgb": Line(10, 0.5), "depth": Line(20, 0.8)})
    colour, depth = np.zeros((32, 48, 3), np.uint8), np.ones((32, 48), np.float32)
    for thresholds, seen in (((0.3, 0.3), (1, 1)), ((0.6, 0.6), (0, 1)), ((0.3, 0.9), (1, 0))):
        backend = LearnedBoundary(nets, dict(zip(("rgb", "depth"), thresholds, strict=True)))
        assert (backend(colour)[:, 10].all(), backend(depth)[:, 20].all()) == seen
        assert (backend(colour).any(), backend(depth).any()) == seen


def test_depth_is_judged_whatever_its_unit_of_length(backend):
    depth = np.random.default_rng(2).uniform(0.5, 1, (32, 48)).astype(np.float32)
    assert np.abs(backend.probability(depth) - backend.probability(2 * depth)).max() < 1e-3


def test_weights_of_another_folder(tmp_path):
    nets = random_nets(3)
    state = nets.state_dict() | {"thresholds": torch.tensor([0.25, 0.5])}
    store.save_part("boundary", state, preset("tiny"), tmp_path, {})
    loaded = get_backend("learned", tmp_path)
    assert loaded.thresholds == {"rgb": 0.25, "depth": 0.5}
    image = np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)
    half = LearnedBoundary(nets.half().float(), loaded.thresholds)
    assert np.array_equal(loaded(image), half(image))


@pytest.mark.parametrize("broken", ["thresholds", "rgb.out.weight"])
def test_weights_of_other_sizes_are_refused(tmp_path, broken):
    state = build_nets().state_dict() | {"thresholds": torch.tensor([0.3, 0.3])}
    state[broken] = torch.zeros(3, 5, 1, 1).flatten() if broken == "thresholds" else torch.zeros(3, 5, 1, 1)
    store.save_part("boundary", state, preset("tiny"), tmp_path, {})
    with pytest.raises(ValueError, match="other sizes"):
        load(tmp_path)


def test_a_folder_without_these_weights_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no weights .*train-boundary"):
        get_backend("learned", tmp_path)
