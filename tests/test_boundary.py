import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite.boundary import (
    BACKENDS,
    ClassicalBoundary,
    boundaries_from_labels,
    boundary_maps,
    depth_aware,
    get_backend,
    precision_recall_f,
    within,
)

MAPS = arrays(bool, (9, 11))


def plane(height=60, width=80, near=0.6, far=0.9) -> np.ndarray:
    """Depth of a table that rises towards the top of the image: a plane is linear in 1 / z."""
    row = 1 / np.linspace(1 / far, 1 / near, height, dtype=np.float32)
    return np.repeat(row[:, None], width, axis=1)


def with_box(depth, z=0.5):
    depth = depth.copy()
    depth[20:40, 30:50] = z
    return depth


def box_outline(shape=(60, 80)) -> np.ndarray:
    labels = np.zeros(shape, int)
    labels[20:40, 30:50] = 1
    return boundaries_from_labels(labels)


# ---- labels


def test_label_boundaries_by_hand():
    labels = np.zeros((5, 6), np.uint8)
    labels[1:4, 1:5] = 1
    expected = labels.astype(bool)
    expected[2, 2:4] = False
    assert (boundaries_from_labels(labels) == expected).all()


def test_touching_objects_are_both_marked_and_background_never():
    labels = np.array([[0, 1, 1, 1, 2, 2, 2, 0]] * 3)
    assert boundaries_from_labels(labels)[1].tolist() == [False, True, False, True, True, False, True, False]


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


# ---- I4


@given(MAPS, MAPS)
def test_the_printed_formula_is_an_intersection(a, b):
    complement = ~b
    difference = a & ~complement  # A \ complement(B)
    assert (difference == (a & b)).all()
    assert (depth_aware(a, b, tolerance=0) == (a & b)).all()


@settings(deadline=None)
@given(MAPS, MAPS, st.lists(st.floats(0, 6), min_size=2, max_size=2).map(sorted))
def test_more_tolerance_never_loses_a_pixel(a, b, tolerances):
    low, high = (depth_aware(a, b, t) for t in tolerances)
    assert not (low & ~high).any() and not (high & ~a).any()
    if b.any():
        assert (depth_aware(a, b, 20) == a).all()
    assert not depth_aware(a, np.zeros_like(b), 20).any()


@given(MAPS, st.sampled_from([0, 1, 1.5, 2, 2.3, 3, 5]))
def test_within_agrees_with_all_pairs(mask, tolerance):
    ys, xs = np.nonzero(mask)
    grid_y, grid_x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    squared = (grid_y[..., None] - ys) ** 2 + (grid_x[..., None] - xs) ** 2
    assert (within(mask, tolerance) == (squared <= tolerance**2 + 1e-9).any(axis=2)).all()


def test_a_shift_of_one_pixel_empties_the_exact_intersection():
    a, b = np.zeros((20, 20), bool), np.zeros((20, 20), bool)
    a[:, 10] = b[:, 11] = True
    assert depth_aware(a, b, 0).sum() == 0 and (depth_aware(a, b, 1) == a).all()


# ---- maps, backends, scores


def test_printed_texture_is_in_the_colour_map_and_not_in_the_depth_aware_one():
    image = picture()
    image[50:58, 5:25] = (30, 30, 200)  # painted on the table
    m_rgb, m_d, m_da = boundary_maps(image, with_box(plane()), get_backend("classical"))
    assert m_rgb[48:, :28].any() and not m_d[48:, :28].any() and not m_da[48:, :28].any()
    assert precision_recall_f(m_da, box_outline(), tolerance=2)[2] > 0.95
    assert all(m.dtype == bool and m.shape == (60, 80) for m in (m_rgb, m_d, m_da))


def test_scores_by_hand():
    pred, true = np.zeros((8, 8), bool), np.zeros((8, 8), bool)
    true[2, :] = True  # 8 pixels
    pred[3, :4] = True  # 4 right at tolerance 1
    pred[7, :4] = True  # 4 wrong
    assert precision_recall_f(pred, true, 0) == (0, 0, 0)
    precision, recall, f = precision_recall_f(pred, true, 1)
    assert (precision, recall) == (0.5, 0.5) and f == pytest.approx(0.5)
    assert precision_recall_f(true, true, 0) == (1, 1, 1)


def test_scores_of_empty_maps():
    some, none = np.eye(5, dtype=bool), np.zeros((5, 5), bool)
    precision, recall, f = precision_recall_f(none, some)
    assert np.isnan(precision) and (recall, f) == (0, 0)
    assert np.isnan(precision_recall_f(none, none)).all()


def test_the_classical_backend_is_registered():
    assert "classical" in BACKENDS and isinstance(get_backend("classical"), ClassicalBoundary)


@pytest.mark.parametrize(
    "call",
    [
        lambda: boundaries_from_labels(np.zeros((4, 4))),
        lambda: ClassicalBoundary(low=5, high=2),
        lambda: ClassicalBoundary()(np.zeros((4, 4, 3))),
        lambda: ClassicalBoundary()(np.zeros((4, 4), np.uint16)),
        lambda: depth_aware(np.zeros((4, 4), bool), np.zeros((4, 5), bool)),
        lambda: depth_aware(np.zeros((4, 4)), np.zeros((4, 4), bool)),
        lambda: depth_aware(np.zeros((4, 4), bool), np.zeros((4, 4), bool), -1),
        lambda: boundary_maps(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 5), np.float32)),
        lambda: get_backend("no such"),
        lambda: get_backend("classical", path="weights.safetensors"),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(ValueError, match="expected|unknown|no weights"):
        call()
