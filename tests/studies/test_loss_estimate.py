"""Loss types without truth: each guess follows from one physical fact, and beats ignorance where it says it does."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import ditr_lite as dl
from ditr_lite.camera import Camera, Stereo, reproject
from ditr_lite.loss_types import Cause, LossType
from ditr_lite.studies.loss_estimate import confusion, estimate_cause, estimate_loss

CAMERA = Camera(190.0, 190.0, 79.5, 59.5, 160, 120)


def rig(x: float, baseline: float) -> Stereo:
    """RGB camera ``x`` metres to the right of the left infrared camera."""
    motion = np.eye(4)
    motion[0, 3] = -x
    return Stereo(CAMERA, baseline, tuple(map(tuple, motion)))


def test_inside_the_region_a_reading_is_believed_only_before_the_surroundings():
    depth = np.full((20, 30), 1.0, np.float32)
    region = np.zeros(depth.shape, bool)
    region[5:15, 5:25] = True
    depth[5:15, 5:10] = 0.9  # in front: the glass itself
    depth[5:15, 15:20] = 0  # lost
    depth[5:15, 20:25] = 1.2  # behind
    codes = estimate_loss(depth, region)
    assert (codes[~region] == LossType.OUTSIDE_FINE).all()
    kinds = (LossType.INSIDE_FINE, LossType.INSIDE_WRONG, LossType.INSIDE_MISSING, LossType.INSIDE_WRONG)
    for k, kind in enumerate(kinds):
        assert (codes[5:15, 5 + 5 * k : 10 + 5 * k] == kind).all()


def test_outside_the_region_readings_are_doubted_at_jumps_alone():
    depth = np.full((20, 30), 1.0, np.float32)
    depth[:, 15:] = 0.9
    depth[2, 2] = 0
    codes = estimate_loss(depth, np.zeros(depth.shape, bool))
    assert codes[2, 2] == LossType.OUTSIDE_MISSING and (codes == LossType.OUTSIDE_MISSING).sum() == 1  # no halo
    assert (codes[:, 13:17] == LossType.OUTSIDE_WRONG).all()
    assert (codes[5:, :13] == LossType.OUTSIDE_FINE).all() and (codes[:, 17:] == LossType.OUTSIDE_FINE).all()


def seen_by(stereo: Stereo, right: bool) -> np.ndarray:
    """A square before a wall in the RGB view, without what one infrared camera cannot see: reproject there and back."""
    depth = np.full((120, 160), 1.0, np.float32)
    depth[40:80, 60:100] = 0.5
    there = np.linalg.inv(stereo.motion())
    there[0, 3] -= stereo.baseline_m * right
    return reproject(reproject(depth, CAMERA, CAMERA, there), CAMERA, CAMERA, np.linalg.inv(there))


@pytest.mark.parametrize(
    "stereo, right, cause, side",
    [
        (rig(0.04, 0.05), False, Cause.PARALLAX, slice(100, 140)),
        (rig(0.0, 0.05), True, Cause.STEREO_OCCLUSION, slice(20, 60)),
    ],
)
def test_a_shadow_is_put_down_to_the_camera_that_could_not_see_it(stereo, right, cause, side):
    depth = seen_by(stereo, right)
    hole = np.zeros(depth.shape, bool)
    hole[45:75, side] = depth[45:75, side] == 0
    assert hole.sum() > 30 * 5
    guess = estimate_cause(depth, np.zeros(depth.shape, bool), CAMERA, stereo)
    assert np.isin(guess[hole], (Cause.PARALLAX, Cause.STEREO_OCCLUSION)).all()
    assert (guess[hole] == cause).mean() > 0.7  # the blurred outline claims two pixels at the edge for the left camera


def test_a_hole_in_a_wall_has_no_reason_and_the_border_is_out_of_view():
    depth = np.full((120, 160), 1.0, np.float32)
    depth[50:60, 70:80] = 0
    depth[:, 150:] = 0
    guess = estimate_cause(depth, np.zeros(depth.shape, bool), CAMERA, rig(0.05, 0.05))
    assert (guess[50:60, 70:80] == Cause.NO_MATCH).all()
    assert (guess[:, 152:] == Cause.OUT_OF_VIEW).all()  # the left camera's picture ends 9.5 pixels before
    depth[10] = 0  # a row without a reading
    guess = estimate_cause(depth, np.zeros(depth.shape, bool), CAMERA, rig(0.05, 0.05))
    assert (guess[10] == Cause.NO_MATCH).all()


@pytest.mark.parametrize("behind, cause", [(1.3, Cause.REFLECTION), (1.01, Cause.TRANSMISSION)])
def test_a_mirror_is_known_by_what_stands_behind_the_wall(behind, cause):
    depth = np.full((120, 160), 1.0, np.float32)
    region = np.zeros(depth.shape, bool)
    region[40:80, 60:100] = True
    depth[region], depth[40:60, 60:100] = behind, 0
    depth[70:80, 60:100] = 0.8  # readings in front, believed
    guess = estimate_cause(depth, region, CAMERA, rig(0.03, 0.05))
    assert (guess[40:70, 60:100] == cause).all()
    assert (guess[70:80, 60:100] == Cause.NONE).all() and (guess[~region] == Cause.NONE).all()


def test_guesses_on_rendered_scenes_keep_what_is_plain_and_carry_information():
    types, causes = np.zeros((6, 6), int), np.zeros((9, 9), int)
    for name in dl.list_samples("val")[::12]:
        s = dl.load_sample(name)
        types += confusion(s.loss, estimate_loss(s.depth, s.region), list(LossType)[:6])
        causes += confusion(s.cause, estimate_cause(s.depth, s.region, s.camera, s.stereo), Cause)
    assert types.sum() == causes.sum() > 0
    for kind in (LossType.OUTSIDE_MISSING, LossType.INSIDE_MISSING):  # plain to see
        assert types[kind, kind] == types[kind].sum() == types[:, kind].sum()
    assert not types[:3, 3:].any() and not types[3:, :3].any()
    wrong = types[1, 1] / types[1].sum(), types[0, 1] / types[0].sum()  # hits and false alarms
    assert wrong[0] > 5 * wrong[1]
    shadow = [Cause.PARALLAX, Cause.STEREO_OCCLUSION]
    hits = causes[shadow][:, shadow].sum() / causes[shadow].sum()
    alarms = causes[Cause.NO_MATCH, shadow].sum() / causes[Cause.NO_MATCH].sum()
    assert hits > 3 * alarms


@settings(deadline=None)
@given(arrays(np.uint8, (4, 5), elements=st.integers(0, 8)), arrays(np.uint8, (4, 5), elements=st.integers(0, 8)))
def test_confusion_counts_every_pixel_once(truth, guess):
    matrix = confusion(truth, guess, Cause)
    assert matrix.shape == (9, 9) and matrix.sum() == truth.size
    for k in range(9):
        assert matrix[k].sum() == (truth == k).sum() and matrix[:, k].sum() == (guess == k).sum()
        assert matrix[k, k] == ((truth == k) & (guess == k)).sum()


def test_confusion_by_hand_leaves_other_truths_out():
    truth, guess = np.array([0, 0, 1, 255]), np.array([0, 1, 1, 0])
    np.testing.assert_array_equal(confusion(truth, guess, [LossType(0), LossType(1)]), [[1, 1], [0, 1]])


def test_bad_input_is_refused_with_advice():
    depth, region = np.ones((4, 5), np.float32), np.zeros((4, 5), bool)
    with pytest.raises(ValueError, match="no reading outside"):
        estimate_loss(depth, ~region)
    with pytest.raises(ValueError, match="mask > 0"):
        estimate_loss(depth, region.astype(int))
    with pytest.raises(ValueError, match="same pixels"):
        confusion(np.zeros(3, int), np.zeros(4, int), Cause)
    with pytest.raises(ValueError, match="name every class"):
        confusion(np.zeros(3, int), np.full(3, 2), [Cause(0), Cause(1)])
