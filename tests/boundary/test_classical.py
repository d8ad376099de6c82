import cv2
import numpy as np
import pytest
from made_scenes import box_outline, plane, with_box

from ditr_lite.boundary import precision_recall_f
from ditr_lite.boundary.classical import ClassicalBoundary, drop_small, is_depth, spread_readings

# ---- depth


def test_a_slanted_plane_has_no_boundary():
    assert not ClassicalBoundary()(plane()).any()


def test_an_object_in_front_is_outlined_on_its_own_pixels():
    found = ClassicalBoundary()(with_box(plane()))
    true = box_outline()
    assert (found & ~true).sum() == 0
    assert (true & ~found).sum() <= 4  # the median rounds the corners


def test_the_border_of_a_hole_in_a_surface_is_no_boundary():
    depth = plane()
    depth[10:30, 20:40] = 0  # narrow enough to look across
    depth[40:55, 5:75] = 0  # too wide
    assert not ClassicalBoundary()(depth).any()


@pytest.mark.parametrize("shadow", [1, 6, 12])
def test_a_shadow_beside_an_object_does_not_move_its_boundary(shadow):
    depth = with_box(plane())
    depth[20:40, 50 : 50 + shadow] = 0  # what the camera could not see beside the box
    found = ClassicalBoundary()(depth)
    assert found[24:36, 49].all() and not found[:, 50:].any()


def test_a_jump_across_a_wide_hole_says_nothing():
    depth = np.full((20, 80), 0.5, np.float32)
    depth[:, 40:] = 1.0
    depth[:, 30:60] = 0
    assert not ClassicalBoundary(max_hole=24)(depth).any()
    assert ClassicalBoundary(max_hole=30)(depth)[:, 29].all()


def test_the_fingerprint_tells_settings_apart():
    plain = ClassicalBoundary().fingerprint
    assert plain == ClassicalBoundary(low=3.0).fingerprint
    changed = {"low": 2.0, "high": 9.0, "jump": 0.03, "slope": 0.02, "max_hole": 25, "min_length": 9}
    assert len({plain, *(ClassicalBoundary(**{k: v}).fingerprint for k, v in changed.items())}) == 7


def test_scattered_missing_pixels_and_noise_hardly_matter():
    rng = np.random.default_rng(0)
    depth = with_box(plane()) * rng.normal(1, 0.002, (60, 80)).astype(np.float32)
    depth[rng.random((60, 80)) < 0.2] = 0
    precision, recall, f = precision_recall_f(ClassicalBoundary()(depth), box_outline(), tolerance=1)
    assert precision > 0.95 and recall > 0.9 and 0.9 < f <= 1


def test_depth_boundaries_ignore_the_unit_of_length_and_mirror_with_the_image():
    found = ClassicalBoundary()(with_box(plane()))
    assert (ClassicalBoundary()(with_box(plane()) * 2) == found).all()
    assert (ClassicalBoundary()(np.ascontiguousarray(with_box(plane())[:, ::-1]))[:, ::-1] == found).all()


def test_empty_depth_has_no_boundary():
    assert not ClassicalBoundary()(np.zeros((8, 8), np.float32)).any()


# ---- colour


def picture(rng=None) -> np.ndarray:
    image = np.full((60, 80, 3), 120, np.uint8)
    image[20:40, 30:50] = (200, 60, 60)
    if rng is not None:
        image = np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)
    return image


def test_a_coloured_box_is_outlined():
    true = box_outline()
    for image in (picture(), picture(np.random.default_rng(0))):
        precision, recall, _ = precision_recall_f(ClassicalBoundary()(image), true, tolerance=1.5)
        assert precision > 0.95 and recall > 0.9


def test_a_uniform_image_and_equal_luminance():
    flat = np.full((60, 80, 3), 120, np.uint8)
    assert not ClassicalBoundary()(flat).any()
    lab = np.full((60, 80, 3), (60, 0, 0), np.float32)
    lab[20:40, 30:50] = (60, 50, 20)  # same lightness, another hue: a grey-level Canny sees nothing
    image = np.rint(np.clip(cv2.cvtColor(lab, cv2.COLOR_LAB2RGB), 0, 1) * 255).astype(np.uint8)
    assert precision_recall_f(ClassicalBoundary()(image), box_outline(), tolerance=1.5)[1] > 0.9


def test_short_pieces_are_dropped():
    depth = np.full((30, 30), 1.0, np.float32)
    depth[10:12, 10:12] = 0.5
    assert not ClassicalBoundary(min_length=8)(depth).any()


# ---- what the other backends use, too


def test_every_hole_takes_its_nearest_reading():
    depth = np.zeros((5, 9), np.float32)
    depth[2, 1], depth[2, 7] = 0.5, 0.9
    filled = spread_readings(depth)
    assert filled.dtype == np.float32 and filled[:, :4] == pytest.approx(0.5) and filled[:, 5:] == pytest.approx(0.9)
    assert not spread_readings(np.zeros((3, 3), np.float32)).any()


def test_pieces_count_as_one_across_a_corner():
    edges = np.zeros((6, 8), bool)
    edges[[0, 1, 2], [0, 1, 2]] = True  # three, diagonal
    edges[5, 6:] = True  # two
    assert (drop_small(edges, 3) == np.pad(np.eye(3, dtype=bool), ((0, 3), (0, 5)))).all()
    assert (drop_small(edges, 1) == edges).all() and not drop_small(edges, 4).any()


def test_colour_and_depth_are_told_apart():
    assert is_depth(np.zeros((3, 4), np.float32)) and not is_depth(np.zeros((3, 4, 3), np.uint8))


@pytest.mark.parametrize(
    "call",
    [
        lambda: ClassicalBoundary(low=5, high=2),
        lambda: ClassicalBoundary()(np.zeros((4, 4, 3))),
        lambda: ClassicalBoundary()(np.zeros((4, 4), np.uint16)),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(ValueError, match="expected"):
        call()
