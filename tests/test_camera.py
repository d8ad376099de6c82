import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ditr_lite import camera as cam
from ditr_lite.camera import Camera, reproject, shadow_width_px

IR = Camera(190.0, 190.0, 79.5, 59.5, 160, 120)
CAMERA = Camera(92.0, 88.0, 7.2, 5.9, 16, 12)


@pytest.fixture
def depth():
    depth = np.random.default_rng(0).uniform(0.4, 0.9, (12, 16)).astype(np.float32)
    depth[2:4, 3:6] = 0
    return depth


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 15), st.integers(0, 11), st.floats(0.125, 60, width=32))
def test_projecting_a_point_gives_its_pixel_back(u, v, z):
    depth = np.zeros((12, 16), np.float32)
    depth[v, u] = z
    ((x, y, zz),) = cam.unproject(depth, CAMERA)
    assert zz == z
    assert np.isclose(x / z * CAMERA.fx + CAMERA.cx, u) and np.isclose(y / z * CAMERA.fy + CAMERA.cy, v)


def test_points_come_row_by_row_without_the_missing(depth):
    points = cam.unproject(depth, CAMERA)
    assert points.shape == ((depth > 0).sum(), 3) and points.dtype == np.float64
    np.testing.assert_array_equal(points[:, 2], depth[depth > 0])
    assert cam.unproject(np.zeros_like(depth), CAMERA).shape == (0, 3)


def test_unproject_refuses_another_size_and_other_units(depth):
    with pytest.raises(ValueError, match="use Camera.resized"):
        cam.unproject(depth[:6], CAMERA)
    with pytest.raises(ValueError, match="floating-point metres"):
        cam.unproject((depth * 1000).astype(np.uint16), CAMERA)


def test_a_scene_twice_as_large_and_as_far_gives_the_same_picture(depth):
    once, twice = cam.unproject(depth, CAMERA), cam.unproject(2 * depth, CAMERA)
    assert np.allclose(twice, 2 * once)  # every point moved along its own line of sight ...
    pixels = [points[:, :2] / points[:, 2:] for points in (once, twice)]
    assert np.allclose(*pixels)  # ... so no pixel of a colour image tells the two apart


def shift(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, 3] = x, y, z
    return motion


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


def plane_depth(camera: Camera, normal: list[float], distance: float, motion: np.ndarray) -> np.ndarray:
    """Depth of the plane normal . X = distance (source coordinates) in a camera at ``motion``, by ray intersection."""
    turned = motion[:3, :3] @ np.asarray(normal)
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return ((distance + turned @ motion[:3, 3]) / (rays @ turned)).astype(np.float32)


def test_bad_motion_and_depths_are_refused_with_advice():
    with pytest.raises(ValueError, match="4, 4"):
        reproject(np.ones((120, 160), np.float32), IR, IR, np.eye(3))
    with pytest.raises(ValueError, match="z_near"):
        shadow_width_px(1.0, 0.5, 0.05, 600.0)


def test_a_cropped_camera_sees_the_same_points():
    rng = np.random.default_rng(3)
    depth = rng.uniform(0.5, 1.5, (IR.height, IR.width)).astype(np.float32)
    rows, columns = slice(7, 20), slice(11, 30)
    part = IR.cropped(rows, columns)
    assert (part.height, part.width) == (13, 19)
    alone = np.zeros_like(depth)
    alone[rows, columns] = depth[rows, columns]
    np.testing.assert_allclose(cam.unproject(depth[rows, columns], part), cam.unproject(alone, IR), rtol=1e-12)


@pytest.mark.parametrize("rows", [slice(5, 5), slice(0, 10, 2), slice(9999, None)])
def test_a_crop_without_pixels_or_with_gaps_is_refused(rows):
    with pytest.raises(ValueError, match="slices that leave a part"):
        IR.cropped(rows, slice(None))
