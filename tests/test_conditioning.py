import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ditr_lite.conditioning import CHANNELS, MIN_SPAN_M, Bounds, condition, depth_bounds, fill, fit, to_tensor

SIZES = st.tuples(st.integers(1, 300), st.integers(1, 300))


# --- bounds -----------------------------------------------------------------------------------------------------------


def test_bounds_of_known_quantiles():
    depth = np.linspace(1, 2, 101).reshape(1, -1).astype(np.float32)  # 2nd and 98th percentile: 1.02 and 1.98
    bounds = depth_bounds(depth)
    assert (bounds.low, bounds.high) == (pytest.approx(1.02 - 0.25 * 0.96), pytest.approx(1.98 + 0.10 * 0.96))


def test_missing_pixels_do_not_move_the_bounds():
    depth = np.linspace(1, 2, 101).astype(np.float32)
    assert depth_bounds(np.r_[depth, np.zeros(500, np.float32)]) == depth_bounds(depth)


def test_a_flat_wall_gets_a_range_around_it():
    bounds = depth_bounds(np.full((4, 4), 0.7, np.float32))
    assert bounds.low < 0.7 < bounds.high and bounds.high - bounds.low == pytest.approx(1.35 * MIN_SPAN_M)


@given(st.floats(0.1, 5), st.floats(0.15, 5), st.floats(0, 70))
def test_normalising_is_affine_and_invertible(low, span, depth):
    bounds = Bounds(low, low + span)
    assert bounds.normalise(low) == pytest.approx(-1) and bounds.normalise(low + span) == pytest.approx(1)
    assert bounds.denormalise(bounds.normalise(depth)) == pytest.approx(depth, abs=1e-6)


def test_depth_without_a_reading_is_refused():
    with pytest.raises(ValueError, match="no reading at all"):
        depth_bounds(np.zeros((3, 3), np.float32))


# --- into the working size and back -----------------------------------------------------------------------------------


@settings(deadline=None)
@given(SIZES)
def test_any_size_fits_with_its_aspect_and_comes_back(source):
    frame = fit(source, (64, 96))
    assert 1 <= frame.height <= 64 and 1 <= frame.width <= 96 and (frame.height == 64 or frame.width == 96)
    scales = frame.height / source[0], frame.width / source[1]
    assert abs(scales[0] - scales[1]) * max(source) <= max(source) / min(source) + 1  # equal but for rounding
    inside = frame.into(np.ones(source, bool))
    assert inside.shape == (64, 96) and inside.sum() == frame.height * frame.width
    for image in (np.ones(source, np.float32), np.ones(source, bool)):
        back = frame.back(frame.into(image))
        assert back.shape == source and back.dtype == image.dtype and (back == 1).all()


def test_depth_is_never_averaged_and_missing_stays_missing():
    depth = np.random.default_rng(0).choice([0, 0.5, 2.0], (120, 170)).astype(np.float32)
    frame = fit(depth.shape, (64, 96))
    assert set(np.unique(frame.into(depth))) == {0, np.float32(0.5), 2}
    assert frame.into(np.full((120, 170, 3), 9, np.uint8)).shape == (64, 96, 3)


def test_way_back_is_smooth_on_surfaces_and_sharp_at_jumps():
    ramp = np.tile(np.linspace(1, 1.2, 96, dtype=np.float32), (64, 1))
    frame = fit((128, 192), (64, 96))
    fine = frame.back(ramp)[0]
    assert np.abs(np.diff(fine, 2)).max() < 1e-3 and len(np.unique(fine)) > 150  # no staircase
    step = np.where(np.arange(96) < 48, np.float32(0.5), np.float32(1.0)) * np.ones((64, 1), np.float32)
    assert set(np.unique(frame.back(step))) == {0.5, 1}  # no flying pixel between the two


def test_at_the_working_size_a_map_comes_back_as_a_copy_of_itself():
    depth = np.random.default_rng(0).random((64, 96)).astype(np.float32)
    back = fit((64, 96), (64, 96)).back(depth)
    assert np.array_equal(back, depth) and not np.shares_memory(back, depth)


def test_what_is_found_on_the_picture_never_sees_its_padding():
    frame = fit((72, 128), (96, 128))
    seen = []

    def find(image, depth, factor):
        seen.append((image.shape, depth.shape))
        return depth > 0, factor * depth

    image, depth = np.ones((96, 128, 3), np.uint8), np.ones((96, 128), np.float32)
    found, scaled = frame.on_picture(find, image, depth, factor=2)
    assert seen == [((72, 128, 3), (72, 128))]
    assert found[:72].all() and not found[72:].any() and found.dtype == bool
    assert (scaled[:72] == 2).all() and not scaled[72:].any()


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


def test_one_reading_fills_everything_and_none_gives_zero():
    known = torch.zeros(1, 1, 17, 30)
    assert (fill(torch.ones_like(known), known) == 0).all()
    known[0, 0, 5, 20] = 1
    assert torch.allclose(fill(3 * torch.ones_like(known), known), torch.tensor(3.0))


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
    assert torch.equal(named["evidence"], (depth - filled) * valid * region)
    assert share.shape == (2, 1, 4, 6) and torch.allclose(share[0, 0, 1, 2], known[0, 0, 4:8, 8:12].mean())


@pytest.mark.parametrize("evidence", [True, False])
def test_depth_inside_the_region_is_seen_only_as_evidence(evidence):
    rgb, depth, valid, region, boundary = inputs()
    other = torch.where(region > 0, depth.flip(3) + 0.1, depth)
    (one, *rest), (two, *rest_two) = (condition(rgb, d, valid, region, boundary, evidence) for d in (depth, other))
    changed = [name for k, name in enumerate(CHANNELS) if not torch.equal(one[:, k], two[:, k])]
    assert changed == (["evidence"] if evidence else []) and all(map(torch.equal, rest, rest_two))
