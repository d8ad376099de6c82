import warnings

import cv2
import numpy as np
import pytest
from made_scenes import table

from ditr_lite.data import list_samples, load_sample
from ditr_lite.units import check_inputs, looks_bgr, looks_inverse, looks_swapped, strays, without_strays

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
        (DEPTH, RGB, None, 1, "rgb: expected .* the two are swapped"),
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


# --- mistakes that leave a frame which can be completed ---------------------------------------------------------------


@pytest.fixture(scope="module")
def rendered():
    names = [*list_samples("val"), *list_samples("rooms_val")[::4], *list_samples("test")[::8]]
    return [load_sample(name) for name in names]


def disparity(depth, factor=0.3, offset=0.0):
    """Return factor / depth + offset, 0 staying 0."""
    return np.where(depth > 0, factor / np.maximum(depth, 0.01) + offset, 0).astype(np.float32)


def test_no_rendered_frame_shows_a_mistake(rendered):
    for s in rendered:
        assert not looks_bgr(s.rgb), s.name
        assert not looks_inverse(s.depth) and not looks_inverse(s.depth_gt), s.name
        assert not looks_swapped(s.depth, s.depth_gt, s.region), s.name


def test_mistakes_of_rendered_frames_are_seen_where_they_can_be(rendered):
    assert np.mean([looks_bgr(s.rgb[..., ::-1]) for s in rendered]) > 0.9
    assert np.mean([looks_swapped(s.depth_gt, s.depth, s.region) for s in rendered]) > 0.8
    for factor, offset in ((0.3, 0), (100, 20)):  # of a stereo pair; of a network whose output has no unit
        assert np.mean([looks_inverse(disparity(s.depth, factor, offset)) for s in rendered]) > 0.5


def test_a_slanted_plane_tells_depth_from_its_inverse_and_a_plane_face_on_does_not():
    rows = np.linspace(1.0, 1.6, 48)[:, None] + np.linspace(0, 0.3, 64)  # of 1 / metre: linear in the pixel
    assert looks_inverse(rows) and looks_inverse(rows[:, ::-1].T) and not looks_inverse(1 / rows)
    level = np.random.default_rng(0).normal(0.6, 0.001, (48, 64))
    assert not looks_inverse(level) and not looks_inverse(1 / level)
    assert not looks_inverse(np.full((48, 64), 0.6)) and not looks_inverse(np.zeros((48, 64)))
    assert not looks_inverse(np.where(np.arange(64) < 6, rows, 0))  # too few readings
    assert looks_inverse(np.round(rows, 3)) and not looks_inverse(np.round(50 * rows) / 50)  # too coarse
    one_row = np.zeros((48, 400))
    one_row[3] = np.linspace(1, 2, 400)
    assert not looks_inverse(one_row)  # no plane follows from one row


def test_colours_of_a_jpeg_tell_their_order():
    smooth = np.stack([*np.meshgrid(np.arange(30, 230, 2), np.arange(40, 200, 2)), np.full((80, 100), 60)], axis=2)
    turned = cv2.imdecode(cv2.imencode(".jpg", smooth.astype(np.uint8))[1], cv2.IMREAD_COLOR)
    assert looks_bgr(turned) and not looks_bgr(turned[..., ::-1])
    among_grey = np.full((300, 300, 3), 128, np.uint8)
    among_grey[:80, :100] = turned
    assert looks_bgr(among_grey)


def test_colours_as_such_prove_nothing():
    rng = np.random.default_rng(0)
    for blue in ((40, 60, 200), (200, 60, 40)):
        noisy = np.clip(rng.normal(blue, 20, (60, 80, 3)), 0, 255).astype(np.uint8)
        assert not looks_bgr(noisy) and not looks_bgr(noisy[..., ::-1])
    grey = np.repeat(rng.integers(0, 255, (60, 80, 1), np.uint8), 3, axis=2)
    assert not looks_bgr(grey)


def test_a_region_of_few_pixels_or_without_loss_says_nothing_of_swapped_files():
    truth, region = np.full((40, 40), 0.6, np.float32), np.ones((40, 40), bool)
    raw = np.where(np.arange(40) < 20, 0, truth).astype(np.float32)
    assert looks_swapped(truth, raw, region) and not looks_swapped(raw, truth, region)
    assert looks_swapped(truth, truth * 1.05, region) and not looks_swapped(truth, truth * 1.005, region)
    assert not looks_swapped(truth, truth, region)
    region[7:] = False
    assert not looks_swapped(truth, raw, region)


def test_mistakes_of_a_rendered_frame_are_warned_of_and_not_refused():
    scene = load_sample("val_00000")
    inverse = disparity(scene.depth)
    with pytest.warns(UserWarning, match="looks like disparity"):
        assert np.array_equal(check_inputs(scene.rgb, inverse, None, 1)[1], inverse)
    with pytest.warns(UserWarning, match="looks like BGR"):
        check_inputs(scene.rgb[..., ::-1], scene.depth, None, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_inputs(scene.rgb, scene.depth, scene.region, 1)
