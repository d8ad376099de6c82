import numpy as np
import pytest
from made_scenes import table

from ditr_lite.units import check_inputs, strays, without_strays

# --- what a caller hands in -------------------------------------------------------------------------------------------

RGB, DEPTH, MASK = np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), np.float32), np.zeros((4, 6), bool)


@pytest.mark.parametrize(
    ("rgb", "depth", "region", "samples", "message"),
    [
        (RGB[..., 0], DEPTH, None, 1, r"rgb: expected \(H, W, 3\) uint8, got \(4, 6\)"),
        (np.zeros((4, 6, 4), np.uint8), DEPTH, None, 1, "RGBA"),
        (RGB / 255.0, DEPTH, None, 1, "got .* float64"),
        (RGB, (DEPTH * 1000).astype(np.uint16), None, 1, "divide millimetres by 1000"),
        (RGB, DEPTH[None], None, 1, r"depth: expected \(H, W\)"),
        (RGB, DEPTH[:, :5], None, 1, "align depth to the RGB image"),
        (RGB, DEPTH, MASK[:3], 1, r"region: expected \(4, 6\) bool"),
        (RGB, DEPTH, MASK.astype(np.uint8), 1, "got .* uint8"),
        (RGB, DEPTH, MASK, 0, "samples: expected at least 1"),
        (RGB, 0 * DEPTH, None, 1, "holds no reading"),
        (RGB, np.nan * DEPTH, None, 1, "holds no reading"),
    ],
)
def test_bad_inputs_are_named(rgb, depth, region, samples, message):
    with pytest.raises(ValueError, match=message):
        check_inputs(rgb, depth, region, samples)


def test_lists_come_back_as_arrays():
    rgb, depth, region = check_inputs(RGB, DEPTH.tolist(), MASK.tolist(), 1)
    assert np.array_equal(rgb, RGB) and np.array_equal(depth, DEPTH) and depth.dtype == np.float32
    assert np.array_equal(region, MASK) and region.dtype == bool
    assert check_inputs(RGB, DEPTH, None, 1)[2] is None


def test_depth_is_cleaned_and_the_callers_array_left_alone():
    depth = np.array([[1.5, np.nan, np.inf], [-1, 65.5, 0.3]])
    rgb, clean, _ = check_inputs(np.zeros((2, 3, 3), np.uint8), depth, None, 1)
    assert clean.dtype == np.float32 and np.allclose(clean, [[1.5, 0, 0], [0, 0, 0.3]])
    assert np.isnan(depth[0, 1])


# --- strays -----------------------------------------------------------------------------------------------------------


def test_specks_far_from_their_surroundings_are_strays_and_surfaces_are_not():
    depth = table()
    assert not strays(depth).any()
    spoilt = depth.copy()
    for y, x, far in ((5, 5, 9.0), (20, 30, 0.2), (47, 63, 3.0)):
        spoilt[y, x] = far
    spoilt[30:32, 40:42] = 4.0
    found = strays(spoilt)
    assert found[[5, 20, 30, 31], [5, 30, 40, 41]].all() and (found <= (spoilt != depth)).all()
    step = np.where(np.arange(64) < 32, np.float32(0.6), np.float32(3.0)) * np.ones((48, 1), np.float32)
    step[:, 20:23] = 0.4  # a rod
    assert not strays(step).any()


def test_sparse_readings_cannot_be_judged():
    depth = np.zeros((40, 40), np.float32)
    depth[::4, ::4] = np.random.default_rng(0).uniform(0.3, 9, (10, 10))
    assert not strays(depth).any()


def test_networks_see_depth_without_strays_unless_there_is_nothing_else():
    depth = table()
    depth[10, 10] = 30.0
    seen = without_strays(depth)
    assert seen[10, 10] == 0 and np.array_equal(np.delete(seen.ravel(), 650), np.delete(depth.ravel(), 650))
    noise = np.random.default_rng(0).permutation(np.geomspace(0.01, 60, 400)).reshape(20, 20).astype(np.float32)
    assert without_strays(noise).any()
