import numpy as np
import pytest
import torch

from ditr_lite.training.augment import colours, grow, lose_patches, lose_readings, mistake, reframe


def region():
    out = torch.zeros(3, 1, 40, 60)
    out[:, :, 10:30, 20:40] = 1
    return out


@pytest.mark.parametrize("function", [colours, lose_readings])
def test_the_generator_decides_and_the_input_stays(function):
    image = np.random.default_rng(0).integers(1, 256, (48, 64, 3), np.uint8)
    image = image if function is colours else image[..., 0].astype(np.float32)
    before = image.copy()
    first, again, other = (function(image, np.random.default_rng(k)) for k in (5, 5, 6))
    assert np.array_equal(first, again) and (image == before).all() and first.dtype == image.dtype
    assert not np.array_equal(first, other) or function is lose_readings


def test_colours_change_hue_now_and_then():
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    strongest = [colours(red, np.random.default_rng(k)).mean(axis=(0, 1)).argmax() for k in range(60)]
    assert set(strongest) == {0, 1, 2} and np.mean(np.array(strongest) == 0) > 0.6


def test_lost_readings_are_lost_and_the_rest_is_kept():
    depth = np.ones((48, 64), np.float32)
    drawn = [lose_readings(depth, np.random.default_rng(k)) for k in range(40)]
    assert all(set(np.unique(d)) <= {0.0, 1.0} for d in drawn)
    assert 0.2 < np.mean([(d == 0).any() for d in drawn]) < 0.8


def test_reframe_moves_image_and_maps_alike():
    v, u = torch.meshgrid(torch.linspace(-1, 1, 48), torch.linspace(-1, 1, 64), indexing="ij")
    plane = (v + 2 * u)[None, None].expand(4, 1, -1, -1).contiguous()
    rgb, (moved, ones) = reframe(plane.expand(-1, 3, -1, -1), [plane, torch.ones_like(plane)], np.random.default_rng(0))
    assert rgb.shape == (4, 3, 48, 64) and set(ones.unique().tolist()) == {0.0, 1.0}
    inside = ones > 0  # nearest and bilinear differ by at most a pixel's step of the plane
    assert float(((rgb[:, :1] - moved).abs() * inside).max()) < 0.12
    assert float((moved - plane).abs().max()) > 0.3
    assert not torch.equal(moved[0], moved[1])  # every frame has its own


def test_reframe_of_nothing_is_nothing():
    image = torch.rand(2, 3, 24, 32)
    same, (mask,) = reframe(image, [image[:, :1]], np.random.default_rng(0), zoom=(1.0, 1.0), turn=0.0)
    shifted = (same - image).abs().mean(dim=(1, 2, 3))  # only the shift is left
    assert bool((shifted > 0).all()) and mask.shape == (2, 1, 24, 32)


def test_grow_by_hand():
    dot = torch.zeros(1, 1, 9, 9)
    dot[..., 4, 4] = 1
    assert grow(dot, 2).sum() == 25 and grow(grow(dot, 2), -1).sum() == 9 and torch.equal(grow(dot, 0), dot)


def test_mistakes_miss_a_part_and_claim_another():
    true = region()
    drawn = torch.cat([mistake(true, np.random.default_rng(k)) for k in range(60)])
    assert set(drawn.unique().tolist()) == {0.0, 1.0} and torch.equal(true, region())
    far = grow(true[:1], 5)
    missed = ((1 - drawn) * true[:1])[:, :, 12:28, 22:38].flatten(1).any(1).float().mean()
    claimed = (drawn * (1 - far)).flatten(1).any(1).float().mean()
    assert 0.02 < missed < 0.5 and 0.1 < claimed < 0.5


def test_patches_lose_the_share_that_was_drawn_and_nothing_else_changes():
    depth_n, valid = torch.rand(6, 1, 48, 64) + 0.1, torch.ones(6, 1, 48, 64)
    valid[:, :, :8], depth_n[:, :, :8] = 0, 0
    few, left = lose_patches(depth_n, valid, np.random.default_rng(0), chance=1.0, most=0.5)
    lost = ((valid > 0) & (left == 0)).float().mean(dim=(1, 2, 3))
    assert 0.05 < lost.max() <= 0.5 and lost.min() < lost.max()
    assert torch.equal(few, depth_n * left) and set(left.unique().tolist()) == {0.0, 1.0}
    same = lose_patches(depth_n, valid, np.random.default_rng(0), chance=0.0)
    assert torch.equal(same[0], depth_n) and torch.equal(same[1], valid)


def test_lost_patches_are_patches_and_not_single_pixels():
    valid = torch.ones(4, 1, 96, 128)
    _, left = lose_patches(valid, valid, np.random.default_rng(1), chance=1.0)
    neighbours_differ = (left[..., 1:] != left[..., :-1]).float().mean()
    assert neighbours_differ < 0.05
