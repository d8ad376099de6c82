"""Loss types: labels, the paper's partition, and the geometry of parallax."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite.data import Camera
from ditr_lite.loss_types import LossType, label, partition, reproject, shadow_width_px

IR = Camera(190.0, 190.0, 79.5, 59.5, 160, 120)


def shift(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, 3] = x, y, z
    return motion


def plane_depth(camera: Camera, normal: list[float], distance: float, motion: np.ndarray) -> np.ndarray:
    """Depth of the plane normal . X = distance (source coordinates) in a camera at ``motion``, by ray intersection."""
    turned = motion[:3, :3] @ np.asarray(normal)
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return ((distance + turned @ motion[:3, 3]) / (rays @ turned)).astype(np.float32)


# label


def test_label_names_each_kind_and_uses_both_thresholds():
    depth = np.array([[1.0, 1.019, 1.021, 0.0], [0.309, 0.311, 0.5, 0.0]], np.float32)
    truth = np.array([[1.0, 1.0, 1.0, 1.0], [0.3, 0.3, 0.0, 0.3]], np.float32)
    region = np.array([[False] * 4, [True] * 4])
    expected = [
        [LossType.OUTSIDE_FINE, LossType.OUTSIDE_FINE, LossType.OUTSIDE_WRONG, LossType.OUTSIDE_MISSING],
        [LossType.INSIDE_FINE, LossType.INSIDE_WRONG, LossType.UNKNOWN, LossType.INSIDE_MISSING],
    ]
    codes = label(depth, truth, region)
    assert codes.dtype == np.uint8
    np.testing.assert_array_equal(codes, expected)


def test_label_of_the_truth_itself_is_fine():
    truth = np.random.default_rng(0).uniform(0.3, 2.0, (6, 7)).astype(np.float32)
    region = truth > 1
    np.testing.assert_array_equal(label(truth, truth, region), np.where(region, 3, 0))


# partition (Eq. 1, 2)


@settings(deadline=None)
@given(
    arrays(np.uint8, (5, 6, 3)), arrays(np.float32, (5, 6), elements=st.floats(0, 4, width=32)), arrays(bool, (5, 6))
)
def test_partition_is_complete_and_disjoint(rgb, depth, region):
    parts = partition(rgb, depth, region)
    whole_rgb, whole_depth = parts.union()
    np.testing.assert_array_equal(whole_rgb, rgb)
    np.testing.assert_array_equal(whole_depth, depth)
    assert not ((parts.depth_op > 0) & (parts.depth_geo > 0)).any()
    assert not parts.rgb_op[~region].any() and not parts.rgb_geo[region].any()
    assert not parts.depth_op[~region].any() and not parts.depth_geo[region].any()
    assert parts.rgb_op.dtype == rgb.dtype and parts.depth_op.dtype == np.float32


# reproject


def test_reproject_with_no_motion_returns_the_map_itself():
    depth = np.random.default_rng(0).uniform(0.4, 1.5, (IR.height, IR.width)).astype(np.float32)
    depth[40:50, 20:60] = 0
    np.testing.assert_allclose(reproject(depth, IR, IR, np.eye(4)), depth, rtol=1e-6)


@pytest.mark.parametrize("normal", [[0, 0, 1], [0.5, -1, 1], [-1.7, 0, 1], [1.7, 0.3, 1]])
@pytest.mark.parametrize("zoom", [0.8, 1.0, 1.5])
def test_reproject_keeps_a_plane_a_plane_without_holes(normal, zoom):
    camera = IR.resized(round(IR.width * zoom), round(IR.height * zoom))
    motion = shift(0.025, 0.001, 0.003)
    depth = plane_depth(IR, normal, 0.6, np.eye(4))
    out = reproject(np.where((depth > 0.1) & (depth < 2), depth, 0), IR, camera, motion)
    truth = plane_depth(camera, normal, 0.6, motion)
    near = (truth > 0.15) & (truth < 1.4)
    column, row = round(0.15 * camera.width), 3
    inner = np.zeros(out.shape, bool)
    inner[row:-row, column:-column] = True  # leaves out what the source camera did not see
    assert (out[inner & near] > 0).all()
    np.testing.assert_allclose(out[near & (out > 0)], truth[near & (out > 0)], rtol=4e-3)


def test_reproject_follows_a_rotation():
    angle = np.deg2rad(3.0)
    motion = shift(0.02)
    motion[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    out = reproject(plane_depth(IR, [0.3, -0.5, 1], 0.7, np.eye(4)), IR, IR, motion)
    inner = (slice(4, -4), slice(25, -25))
    np.testing.assert_allclose(out[inner], plane_depth(IR, [0.3, -0.5, 1], 0.7, motion)[inner], rtol=3e-3)


def foreground_square() -> np.ndarray:
    depth = np.full((IR.height, IR.width), 1.0, np.float32)
    depth[40:80, 60:100] = 0.4
    return depth


def test_shadow_has_the_predicted_width():
    motion = shift(0.03)  # the target camera sits to the left, so near points move right
    out = reproject(foreground_square(), IR, IR, motion)
    shadow = (out[45:75, 20:140] == 0).sum(axis=1)
    assert np.abs(shadow - shadow_width_px(0.4, 1.0, 0.03, IR.fx)).max() <= 1.0


@pytest.mark.parametrize("zoom", [0.8, 1.0, 1.5])
def test_foreground_covers_the_background_and_does_not_bleed(zoom):
    camera = IR.resized(round(IR.width * zoom), round(IR.height * zoom))
    out = reproject(foreground_square(), IR, camera, shift(0.03))
    near = (out > 0) & (out < 0.7)
    rows, columns = np.nonzero(near)
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert near.sum() == height * width  # solid: no background shines through
    for size in (height, width):
        assert 40 * zoom - 1 <= size <= 40 * zoom + 1
    values = np.unique(np.round(out[out > 0], 4))
    np.testing.assert_allclose(values, [0.4, 1.0], atol=1e-4)  # surfaces are never mixed across the edge


def test_reproject_drops_what_is_behind_the_target_camera():
    camera = Camera(190.0, 190.0, 80.0, 60.0, 160, 120)
    finer = Camera(285.0, 285.0, 120.0, 90.0, 240, 180)  # samples the optical axis itself, which stays in the picture
    assert not reproject(np.full((120, 160), 0.5, np.float32), camera, finer, shift(z=-0.6)).any()


def test_reproject_of_nothing_is_nothing():
    assert not reproject(np.zeros((120, 160), np.float32), IR, IR, shift(0.03)).any()


def test_shadow_width_by_hand():
    assert shadow_width_px(0.5, 1.0, 0.05, 600.0) == pytest.approx(30.0)
    assert shadow_width_px(0.5, 0.5, 0.05, 600.0) == 0


# bad input


def test_bad_input_is_refused_with_advice():
    depth, region = np.ones((4, 5), np.float32), np.zeros((4, 5), bool)
    with pytest.raises(ValueError, match="millimetres"):
        label(np.ones((4, 5), np.uint16), depth, region)
    with pytest.raises(ValueError, match="clean_depth"):
        label(np.full((4, 5), np.nan, np.float32), depth, region)
    with pytest.raises(ValueError, match="mask > 0"):
        label(depth, depth, region.astype(np.uint8))
    with pytest.raises(ValueError, match="depth_gt should have shape"):
        label(depth, depth.T, region)
    with pytest.raises(ValueError, match="rgb should be"):
        partition(np.zeros((4, 5), np.uint8), depth, region)
    with pytest.raises(ValueError, match="4, 4"):
        reproject(np.ones((120, 160), np.float32), IR, IR, np.eye(3))
    with pytest.raises(ValueError, match="z_near"):
        shadow_width_px(1.0, 0.5, 0.05, 600.0)
