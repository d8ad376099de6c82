"""Parallax shadows: the measurement agrees with the closed form where it must, and can tell a wrong form from it."""

import numpy as np
import pytest

import ditr_lite as dl
from ditr_lite.camera import Camera
from ditr_lite.studies.shadows import Shadows, measure_scenes, measure_shadows

CAMERA = Camera(200.0, 200.0, 99.5, 31.5, 200, 64)
OFFSETS = (0.01, 0.02, 0.04, 0.08)


def step(width: int = 60, far: float = 1.0) -> np.ndarray:
    depth = np.full((CAMERA.height, CAMERA.width), far, np.float32)
    depth[:, 80 : 80 + width] = 0.5
    return depth


@pytest.mark.parametrize("offset", OFFSETS)
def test_a_step_casts_the_shadow_of_the_closed_form(offset):
    found = measure_shadows(step(), CAMERA, offset)
    assert found.measured_px.shape == (4,)  # rows 8, 24, 40, 56; the right-hand edge does not count
    np.testing.assert_allclose(found.predicted_px, 200 * offset * (1 / 0.5 - 1 / 1.0))
    np.testing.assert_allclose(found.measured_px, found.predicted_px, atol=0.3)  # a quarter pixel is the raster
    assert found.clear.all() and (found.offset_m == offset).all()


def test_an_object_thinner_than_its_shadow_is_not_clear_for_the_background_shines_in_behind_it():
    found = measure_shadows(step(width=4), CAMERA, 0.08)  # 16 pixels predicted
    assert not found.clear.any()
    np.testing.assert_array_equal(found.measured_px, 0)


def test_a_surface_that_ends_within_the_gap_is_not_clear():
    depth = step()
    depth[:, 70:76] = 0.7
    found = measure_shadows(depth, CAMERA, 0.08)
    assert not found.clear[np.isclose(found.predicted_px, 16)].any()


def test_edges_whose_gap_leaves_the_picture_are_left_out_and_nothing_is_found_on_a_plane():
    depth = step()
    depth[:, :80] = 0.5  # far on the right only
    assert measure_shadows(depth, CAMERA, 0.04).measured_px.size == 0
    shifted = np.roll(step(), -75, axis=1)  # the edge is in column 5
    assert measure_shadows(shifted, CAMERA, 0.08).measured_px.size == 0


def test_closed_form_holds_on_rendered_truth_and_a_constant_does_not():
    scenes = [dl.load_sample(name) for name in dl.list_samples("test")[::16]]
    every = measure_scenes(scenes, OFFSETS)
    clear = every.only(every.clear)
    assert clear.measured_px.size > 100 and clear.measured_px.size > 0.7 * every.measured_px.size
    assert clear.within() >= 0.95
    assert clear.within(clear.best_constant()) < 0.9
    assert clear.within(clear.predicted_px * 2) < 0.9  # the test notices a wrong factor, too


def test_share_within_and_best_constant_by_hand():
    found = Shadows(
        np.array([1.0, 2, 3, 9]), np.array([1.5, 2, 5, 9]), np.full(4, 0.05), np.array([True] * 3 + [False])
    )
    assert found.within() == 0.75 and found.within(tolerance_px=0.4) == 0.5
    assert found.best_constant() == 2.0 and found.within(2.0) == 0.75
    assert found.only(found.clear).measured_px.tolist() == [1, 2, 3]


def test_bad_input_is_refused_with_advice():
    with pytest.raises(ValueError, match="offset > 0"):
        measure_shadows(step(), CAMERA, 0.0)
    with pytest.raises(ValueError, match="depth_gt should have shape"):
        measure_shadows(step()[:-1], CAMERA, 0.05)
    with pytest.raises(ValueError, match="no edges"):
        measure_shadows(np.ones((64, 200), np.float32), CAMERA, 0.05).within()
