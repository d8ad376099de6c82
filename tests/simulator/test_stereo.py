from dataclasses import replace

import cv2
import numpy as np
import pytest

from ditr_lite.camera import Camera, Stereo
from ditr_lite.data import OPAQUE, REFLECTIVE, TRANSPARENT
from ditr_lite.loss_types import Cause, LossType
from ditr_lite.simulator import stereo as sensor
from ditr_lite.simulator.stereo import (
    Matcher,
    causes,
    dot_pattern,
    dropouts,
    expose,
    match,
    random_matcher,
    raw_depth,
    visible_from,
)

HEIGHT, WIDTH = 96, 200
CAMERA = Camera(250.0, 250.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
STEREO = Stereo(CAMERA, 0.06, tuple(map(tuple, np.eye(4).tolist())))  # the RGB camera is the left infrared camera
CLEAN = Matcher(edge=0, holes=0, noise=0)


def pair(disparity, seed=0):
    """Return a random-dot pair (uint8) of a fronto-parallel plane: right(u) = left(u + disparity)."""
    dots = dot_pattern(np.random.default_rng(seed), size=320, share=0.06)[:HEIGHT] * 200 + 20
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    views = [cv2.remap(dots, u + 40 + shift, v, cv2.INTER_CUBIC) for shift in (0, disparity)]
    return [np.clip(np.rint(view), 0, 255).astype(np.uint8) for view in views]


@pytest.mark.parametrize("disparity", [6.0, 12.25, 20.5, 31.7])
def test_match_recovers_a_constant_disparity_to_a_twentieth_of_a_pixel(disparity):
    found = match(*pair(disparity), CLEAN)[8:-8, 48:-8]  # what lies left of the disparity has no partner
    assert (found > 0).mean() > 0.9
    error = found[found > 0] - disparity
    assert abs(np.median(error)) < 0.05 and np.abs(error).mean() < 0.05


def test_match_is_silent_where_there_is_nothing_to_match():
    left, right = pair(12.0)
    left[:, 90:150] = right[:, 78:138] = 90  # a blank wall
    found = match(left, right, CLEAN)
    assert (found[:, 105:135] > 0).mean() < 0.05 and (found[10:-10, 50:80] > 0).mean() > 0.9


def test_match_never_points_outside_the_right_image():
    found = match(*pair(25.0), CLEAN)
    assert (np.arange(WIDTH) - found >= 0).all()


def test_a_match_must_beat_the_second_best_by_its_uniqueness():
    left, right = pair(12.0)[0], pair(12.0, seed=1)[1]  # two walls that have nothing to do with each other
    found = [(match(left, right, replace(CLEAN, uniqueness=share)) > 0).mean() for share in (0, 20, 60)]
    assert found[0] > 1.5 * found[1] > 0.01 and found[2] < 0.005


def test_raw_depth_is_focal_length_times_baseline_over_disparity():
    depth, dropped = raw_depth(*pair(15.0), STEREO, CAMERA, CLEAN, np.random.default_rng(0))
    seen = depth[10:-10, 50:-10]
    assert np.allclose(np.median(seen[seen > 0]), 250 * 0.06 / 15.0, rtol=0.005) and not dropped.any()


def test_raw_depth_reports_what_its_own_filters_took():
    holes = Matcher(edge=0, noise=0, holes=0.2)
    depth, dropped = raw_depth(*pair(15.0), STEREO, CAMERA, holes, np.random.default_rng(0))
    assert 0.05 < dropped.mean() < 0.35 and (depth[dropped] == 0).all()


def test_raw_depth_ends_at_four_metres():
    depth, _ = raw_depth(*pair(3.0), STEREO, CAMERA, CLEAN, np.random.default_rng(0))  # 5 m away
    assert (depth > 4).sum() == 0 and (depth > 0).mean() < 0.2


def test_exposure_sets_the_97th_percentile_and_saturates():
    radiance = np.tile(np.linspace(0, 1, 100), (100, 1))
    image = expose(radiance, CLEAN, np.random.default_rng(0))
    assert image.dtype == np.uint8 and abs(float(np.percentile(image, 97)) - 200) < 8
    assert (expose(radiance, Matcher(gain=2.0), np.random.default_rng(0)) == 255).mean() > 0.2
    flat = np.full((100, 100), 1.0)
    noisy = expose(flat, Matcher(noise=6.0), np.random.default_rng(0)).astype(float)
    assert abs(noisy.std() - np.sqrt(6.0**2 + 0.1 * 200)) < 0.3  # read noise and shot noise


def test_dropouts_lie_at_jumps_and_fill_the_share_of_holes():
    depth = np.full((200, 200), 0.5)
    depth[:, 100:] = 1.0
    edges = dropouts(depth, Matcher(edge=2, holes=0), np.random.default_rng(0))
    assert edges[:, 98:102].all() and not edges[:, :96].any() and not edges[:, 104:].any()
    holes = dropouts(depth, Matcher(edge=0, holes=0.1), np.random.default_rng(0))
    assert abs(holes.mean() - 0.1) < 0.005
    assert not dropouts(depth, Matcher(edge=0, holes=0), np.random.default_rng(0)).any()


@pytest.mark.parametrize(
    ("near", "step", "dropped"), [(1.0, 0.039, False), (1.0, 0.045, True), (0.1, 0.0075, False), (0.1, 0.0085, True)]
)
def test_a_jump_is_four_per_cent_of_the_depth_of_at_least_20_cm(near, step, dropped):
    depth = np.where(np.arange(60) < 30, near, near + step) * np.ones((40, 1))
    assert dropouts(depth, Matcher(edge=1, holes=0), np.random.default_rng(0)).any() == dropped


def test_dot_pattern_holds_its_share_of_dots():
    dots = dot_pattern(np.random.default_rng(0), 300, share=0.04)
    assert dots.shape == (300, 300) and dots.dtype == np.float32 and dots.min() == 0 and dots.max() == 1
    assert dots.mean() > dot_pattern(np.random.default_rng(0), 300, share=0.02).mean()


def test_random_matcher_follows_from_its_generator_and_varies():
    draws = [random_matcher(np.random.default_rng(seed)) for seed in range(50)]
    assert draws[3] == random_matcher(np.random.default_rng(3))
    assert {d.block for d in draws} == {9, 11, 13, 15} and {d.edge for d in draws} == {0, 1, 2, 3, 4}
    assert all(0 <= d.holes <= 0.35 and 0.6 <= d.gain <= 2 for d in draws)


def test_a_near_plate_hides_the_far_wall_behind_it_and_nothing_else():
    view = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    view[30:60, 80:120] = 0.5  # a plate before a wall, as the camera sees it
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    ray = np.stack([(u - CAMERA.cx) / 250, (v - CAMERA.cy) / 250, np.ones(u.shape)], axis=-1)
    inside, clear = visible_from(ray * 1.0, view, CAMERA, np.eye(4))  # all points of the wall
    assert inside.all() and not clear[32:58, 82:118].any() and clear[:28].all() and clear[:, :78].all()
    moved = np.eye(4)
    moved[0, 3] = 0.3
    inside, _ = visible_from(ray, view, CAMERA, moved)  # 0.3 m to the right: 75 pixels leave on the left
    assert not inside[:, :74].any() and inside[:, 76:].all()


def test_causes_name_the_strongest_reason():
    loss = np.array([[0, 2, 2, 2, 2, 2, 1, 4, 5, 4, 3, 255]], np.uint8)
    glass, mirror = TRANSPARENT, REFLECTIVE
    material = np.array([[OPAQUE] * 7 + [glass, glass, mirror, mirror, OPAQUE]], np.uint8)
    dropped, inside, left, right = (np.full(loss.shape, value) for value in (False, True, True, True))
    right[0, [2, 3, 4, 5]] = False
    left[0, [3, 4, 5]] = False
    inside[0, [4, 5]] = False
    dropped[0, 5] = True
    found = causes(loss, material, dropped, (inside, left), (inside, right))
    expected = [Cause.NONE, Cause.NO_MATCH, Cause.STEREO_OCCLUSION, Cause.PARALLAX, Cause.OUT_OF_VIEW, Cause.DROPOUT]
    expected += [Cause.MISMATCH, Cause.TRANSMISSION, Cause.TRANSMISSION, Cause.REFLECTION, Cause.NONE, Cause.NONE]
    assert found.dtype == np.uint8 and found[0].tolist() == expected
    assert LossType(255) is LossType.UNKNOWN


def test_a_steep_plane_is_no_depth_jump_and_a_step_is():
    v = np.arange(120)[:, None] + np.zeros(160)
    plane = 1 / (0.4 + 0.012 * v)  # a floor seen from low down: inverse depth is linear
    assert not sensor.depth_jumps(plane, 4).any()
    step = np.where(np.arange(160) < 80, 1.0, 1.3) * np.ones((120, 1))
    columns = np.unique(np.nonzero(sensor.depth_jumps(step, 3))[1])
    assert columns.min() >= 76 and columns.max() <= 83 and len(columns) >= 6


def test_strays_are_as_many_and_as_far_off_as_drawn():
    depth = np.full((240, 320), 0.8, np.float32)
    for blob in (0.0, 3.0):
        out = sensor.stray(depth, sensor.Strays(share=0.004, blob=blob, near=0.5), np.random.default_rng(1))
        moved = out != depth
        assert 0.003 < moved.mean() < 0.006
        ratio = out[moved] / 0.8
        assert ((ratio < 0.33) | (ratio > 1.4)).all() and (ratio < 1).any() and (ratio > 1).any() and out.max() <= 65
    assert np.array_equal(sensor.stray(depth, sensor.Strays(), np.random.default_rng(1)), depth)


def test_strays_of_a_deep_room_end_at_65_metres():
    depth = np.full((60, 80), 20.0, np.float32)
    out = sensor.stray(depth, sensor.Strays(share=0.05, near=0.0), np.random.default_rng(1))
    assert out.max() == 65 and (out == 65).sum() > 10


def test_half_of_the_scenes_have_no_strays_and_none_more_than_half_a_per_cent():
    drawn = [sensor.random_strays(np.random.default_rng(seed)) for seed in range(400)]
    assert 0.4 < np.mean([d.share == 0 for d in drawn]) < 0.6 and max(d.share for d in drawn) <= 0.005
