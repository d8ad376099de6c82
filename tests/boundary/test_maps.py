import pickle
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from made_scenes import box_outline, plane, with_box

from ditr_lite.boundary import (
    BACKENDS,
    ClassicalBoundary,
    boundary_maps,
    depth_aware,
    get_backend,
    precision_recall_f,
    within,
)

MAPS = arrays(bool, (9, 11))


def picture() -> np.ndarray:
    image = np.full((60, 80, 3), 120, np.uint8)
    image[20:40, 30:50] = (200, 60, 60)
    return image


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


def test_backends_are_chosen_by_name():
    assert set(BACKENDS) == {"classical", "learned", "sam", "none"}
    assert isinstance(get_backend("classical"), ClassicalBoundary)


def test_nothing_heavy_is_loaded_before_a_backend_asks_for_it():
    code = "import sys, ditr_lite.boundary as b; b.get_backend('classical'); "
    code += "assert not {'torch', 'transformers'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_no_guide_at_all():
    backend = get_backend("none")
    assert not backend(picture()).any() and backend(picture()).shape == backend(plane()).shape == (60, 80)
    assert not np.any(boundary_maps(picture(), with_box(plane()), backend))
    assert not pickle.loads(pickle.dumps(backend))(picture()).any()  # as workers that are spawned get it


@pytest.mark.parametrize(
    "call",
    [
        lambda: get_backend("none", path="weights.safetensors"),
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
