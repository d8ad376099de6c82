import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from made_scenes import table

from ditr_lite.conditioning import (
    CHANNELS,
    SPREADS,
    Bounds,
    condition,
    depth_bounds,
    depth_tensors,
    fill,
    to_tensor,
)

# --- bounds -----------------------------------------------------------------------------------------------------------


def test_bounds_of_known_logarithms():
    depth = np.exp(np.linspace(-0.2, 0.2, 101)).reshape(1, -1)  # median 0, median absolute deviation 0.1
    bounds = depth_bounds(depth)
    assert np.log(bounds.high) == pytest.approx(0.25, rel=1e-3)
    assert np.log(bounds.low) == pytest.approx(-1.25 * 0.25, rel=1e-3)


def test_missing_pixels_do_not_move_the_bounds():
    depth = np.linspace(1, 2, 101).astype(np.float32)
    assert depth_bounds(np.r_[depth, np.zeros(500, np.float32)]) == depth_bounds(depth)


def test_a_flat_wall_and_a_whole_street_get_ranges_that_can_be_painted_in():
    wall = depth_bounds(np.full((4, 4), 0.7, np.float32))
    assert wall.low < 0.7 < wall.high and np.log(wall.high / wall.low) == pytest.approx(2.25 * SPREADS[0])
    street = depth_bounds(np.geomspace(0.1, 60, 100).reshape(1, -1))
    assert np.log(street.high / street.low) == pytest.approx(2.25 * SPREADS[1])


@settings(deadline=None)
@given(st.floats(0.1, 20), st.floats(1.2, 5), st.floats(0.02, 60))
def test_normalising_is_invertible(low, ratio, depth):
    bounds = Bounds(low, low * ratio)
    assert bounds.normalise(low) == pytest.approx(-1) and bounds.normalise(low * ratio) == pytest.approx(1)
    assert bounds.denormalise(bounds.normalise(depth)) == pytest.approx(depth, rel=1e-6)
    tensors = Bounds(*(torch.tensor(v, dtype=torch.float64).view(1, 1, 1, 1) for v in (low, low * ratio)))
    x = torch.full((1, 1, 2, 2), depth, dtype=torch.float64)
    assert torch.allclose(tensors.normalise(x), torch.tensor(float(bounds.normalise(depth)), dtype=torch.float64))
    assert torch.allclose(tensors.denormalise(tensors.normalise(x)), x)


@settings(deadline=None)
@given(st.floats(0.1, 20), st.floats(1.2, 5), st.floats(0.02, 60), st.floats(1.001, 3))
def test_normalising_keeps_the_order_and_is_steepest_between_the_bounds(low, ratio, depth, more):
    bounds = Bounds(low, low * ratio)
    step = bounds.normalise(depth * more) - bounds.normalise(depth)
    inside = np.log(more) / (np.log(ratio) / 2)
    assert 0 < step <= inside * (1 + 1e-6)
    if low <= depth and depth * more <= low * ratio:
        assert step == pytest.approx(inside, rel=1e-5)


def test_beyond_the_bounds_it_is_compressed_once_more_without_a_kink():
    bounds = Bounds(1 / np.e, np.e)  # middle 1 m, half range 1
    assert bounds.normalise(np.exp(3.0)) == pytest.approx(1 + np.log(3))
    assert bounds.normalise(np.exp(-3.0)) == pytest.approx(-1 - np.log(3))
    before, after = (bounds.normalise(np.exp(1 + e)) for e in (-1e-4, 1e-4))
    assert after - before == pytest.approx(2e-4, rel=1e-3)


def test_what_is_missing_is_zero_in_network_units():
    assert Bounds(2.0, 3.0).normalise(np.float32([0, 2.5]))[0] == 0
    assert Bounds(2.0, 3.0).normalise(torch.tensor([0.0, 2.5]))[0] == 0
    depth_n, valid = depth_tensors(np.float32([[0, 2.0]]), Bounds(2.0, 3.0))
    assert depth_n.tolist() == [[[[0, -1]]]] and valid.tolist() == [[[[0, 1]]]]


@settings(deadline=None, max_examples=25)
@given(st.floats(0.2, 30))
def test_distance_is_no_matter(scale):
    depth = table()
    far = (depth * scale).astype(np.float32)
    one, other = (depth_bounds(d).normalise(d) for d in (depth, far))
    assert np.abs(one - other).max() < 1e-3


@pytest.mark.parametrize("far", [0.05, 2.5, 60.0])
def test_a_minority_of_strays_or_a_room_moves_the_bounds_by_little(far):
    depth = table()
    spoilt = depth.copy()
    spoilt.ravel()[::50] = far  # 2 per cent strays
    room = depth.copy()
    room[:6] = far  # an eighth of the picture
    bounds = depth_bounds(depth)
    half = np.log(bounds.high / bounds.low) / 2
    for other, limit in ((depth_bounds(spoilt), 0.1), (depth_bounds(room), 0.4)):
        assert abs(np.log(other.low / bounds.low)) < limit * half
        assert abs(np.log(other.high / bounds.high)) < limit * half


def test_bounds_are_about_the_pixels_asked_for_where_they_were_read():
    depth = table()
    about = np.zeros(depth.shape, bool)
    about[:10] = True
    assert depth_bounds(depth, about) == depth_bounds(depth[:10])
    assert depth_bounds(np.where(about, 0, depth), about) == depth_bounds(depth[10:])


def test_depth_without_a_reading_is_refused():
    with pytest.raises(ValueError, match="no reading at all"):
        depth_bounds(np.zeros((3, 3), np.float32))


# --- fill -------------------------------------------------------------------------------------------------------------


def holes(seed=0, share=0.1, size=(2, 1, 33, 47)):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(size, generator=generator) - 0.5, (torch.rand(size, generator=generator) < share).float()


def test_fill_keeps_what_is_known_and_stays_in_its_range():
    depth, known = holes()
    filled = fill(depth, known)
    assert torch.equal(filled[known > 0], depth[known > 0]) and filled.isfinite().all()
    for image, mask, out in zip(depth, known, filled, strict=True):
        assert image[mask > 0].min() - 1e-6 <= out.min() and out.max() <= image[mask > 0].max() + 1e-6


def test_fill_is_linear_and_blind_to_the_unknown():
    (a, known), (b, _) = holes(0), holes(1)
    assert torch.allclose(fill(2 * a + b, known), 2 * fill(a, known) + fill(b, known), atol=1e-5)
    assert torch.equal(fill(torch.where(known > 0, a, 99.0), known), fill(a, known))


def test_relaxing_brings_the_fill_nearer_to_laplace():
    y, x = torch.meshgrid(torch.linspace(-1, 1, 48), torch.linspace(-1, 1, 64), indexing="ij")
    harmonic = (torch.sin(3 * x) * torch.exp(3 * y))[None, None]  # solves Laplace's equation
    known = torch.ones_like(harmonic)
    known[..., 12:36, 16:48] = 0
    errors = [float((fill(harmonic, known, rounds) - harmonic).abs().mean()) for rounds in (0, 4, 40)]
    assert errors[0] < 0.09 and errors[1] < min(0.05, 0.7 * errors[0]) and errors[2] < 0.6 * errors[1]


def test_one_reading_fills_everything_and_none_gives_zero():
    known = torch.zeros(1, 1, 17, 30)
    assert (fill(torch.ones_like(known), known) == 0).all()
    known[0, 0, 5, 20] = 1
    assert torch.allclose(fill(3 * torch.ones_like(known), known), torch.tensor(3.0))


@pytest.mark.parametrize("size", [(64, 96), (240, 320), (360, 640), (736, 1280), (120, 480), (1, 64)])
def test_one_known_corner_fills_the_far_one(size):  # also where one side has shrunk to a pixel before the other
    known = torch.zeros(1, 1, *size)
    known[0, 0, 0, : size[1] // 8] = 1
    assert torch.allclose(fill(torch.full_like(known, 0.7), known), torch.tensor(0.7), atol=1e-5)


# --- the conditioning image -------------------------------------------------------------------------------------------


def test_colours_become_minus_one_to_one():
    rgb = np.zeros((1, 2, 3, 3), np.uint8)
    rgb[0, 0, 0] = 255, 0, 0
    out = to_tensor(rgb)
    assert out.shape == (1, 3, 2, 3) and out[0, 0, 0, 0] == 1 and out[0, 1:, 0, 0].eq(-1).all() and out.min() == -1


def inputs(seed=0):
    generator = torch.Generator().manual_seed(seed)
    maps = torch.rand(2, 4, 16, 24, generator=generator)
    rgb = torch.rand(2, 3, 16, 24, generator=generator)
    depth = 2 * maps[:, :1] - 1
    valid, region, boundary = ((maps[:, k : k + 1] > 0.5).float() for k in (1, 2, 3))
    return rgb, depth, valid, region, boundary


def test_channels_are_where_their_names_say():
    rgb, depth, valid, region, boundary = inputs()
    image, filled, share = condition(rgb, depth, valid, region, boundary)
    named = dict(zip(CHANNELS, image.split(1, dim=1), strict=True))
    known = valid * (1 - region)
    assert torch.equal(image[:, :3], rgb) and torch.equal(named["boundary"], boundary)
    assert torch.equal(named["filled"], filled) and torch.equal(filled, fill(depth, known))
    assert torch.equal(named["known"], known) and torch.equal(named["region"], region)
    assert torch.equal(named["trusted"], valid * region)
    assert torch.equal(named["evidence"], (fill(depth, valid) - filled).clamp(-2, 2))  # dense
    assert share.shape == (2, 1, 4, 6) and torch.allclose(share[0, 0, 1, 2], known[0, 0, 4:8, 8:12].mean())


@pytest.mark.parametrize("evidence", [True, False])
def test_depth_inside_the_region_is_seen_only_as_evidence(evidence):
    rgb, depth, valid, region, boundary = inputs()
    other = torch.where(region > 0, depth.flip(3) + 0.1, depth)
    (one, *rest), (two, *rest_two) = (condition(rgb, d, valid, region, boundary, evidence) for d in (depth, other))
    changed = [name for k, name in enumerate(CHANNELS) if not torch.equal(one[:, k], two[:, k])]
    assert changed == (["evidence"] if evidence else []) and all(map(torch.equal, rest, rest_two))


@pytest.mark.parametrize("size", [(24, 32), (33, 33), (45, 81), (61, 40)])
def test_a_ramp_is_filled_in_its_place_whatever_the_sides(size):
    height, width = size
    ramp = torch.linspace(0, 1, width).expand(1, 1, height, width).contiguous()
    known = torch.ones_like(ramp)
    known[..., height // 4 : -(height // 4), width // 4 : -(width // 4)] = 0
    off = (fill(ramp * known, known) - ramp)[known == 0] * width  # in pixels of the ramp
    assert abs(float(off.mean())) < 0.3, "it drifts sideways"
