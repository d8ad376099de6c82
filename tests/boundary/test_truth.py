import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite.boundary import (
    ExactBoundary,
    boundaries_from_labels,
    boundary_maps,
    depth_boundaries,
    precision_recall_f,
)

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


def test_scores_by_hand():
    pred, true = np.zeros((8, 8), bool), np.zeros((8, 8), bool)
    true[2, :] = True  # 8 pixels
    pred[3, :4] = pred[1, :2] = True  # 6 right at tolerance 1, near 4 of the true ones
    pred[7, :4] = True  # 4 wrong
    assert precision_recall_f(pred, true, 0) == (0, 0, 0)
    precision, recall, f = precision_recall_f(pred, true, 1)
    assert (precision, recall) == (0.6, 0.5) and f == pytest.approx(6 / 11)
    assert precision_recall_f(true, true, 0) == (1, 1, 1)


def test_scores_of_empty_maps():
    some, none = np.eye(5, dtype=bool), np.zeros((5, 5), bool)
    precision, recall, f = precision_recall_f(none, some)
    assert np.isnan(precision) and (recall, f) == (0, 0)
    assert np.isnan(precision_recall_f(none, none)).all()


def test_a_foot_on_the_table_is_an_outline_but_no_jump():
    labels, depth = np.zeros((6, 8), int), np.full((6, 8), 1.0)
    labels[1:5, 2:6] = 3
    depth[1:5, 2:6] = np.array([0.9, 0.93, 0.96, 0.995])[:, None]  # leans back: its lowest row touches
    found = depth_boundaries(labels, depth, jump=0.01)
    wanted = boundaries_from_labels(labels)
    wanted[4, 2:6] = False
    assert (found == wanted).all()
    assert depth_boundaries(labels, depth, jump=0.001)[4].sum() == 4
    assert not depth_boundaries(labels, np.zeros((6, 8))).any()  # unknown depth jumps nowhere


@given(arrays(int, (7, 8), elements=st.integers(0, 3)), arrays(float, (7, 8), elements=st.sampled_from([0, 0.5, 0.52])))
def test_jumps_agree_with_a_loop_and_mirror_with_the_image(labels, depth):
    found, h, w = depth_boundaries(labels, depth), *labels.shape
    assert not (found & ~boundaries_from_labels(labels)).any()
    assert (depth_boundaries(labels.T, depth.T).T == found).all()
    for y, x in np.ndindex(h, w):
        near = [(y + dy, x + dx) for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0))]
        near = [q for q in near if 0 <= q[0] < h and 0 <= q[1] < w and labels[q] != labels[y, x]]
        jump = any(depth[y, x] > 0 and depth[q] > 0 and abs(depth[q] - depth[y, x]) > 0.01 for q in near)
        assert found[y, x] == (labels[y, x] > 0 and jump)


def test_the_exact_backend_answers_with_the_truth():
    labels, depth = np.zeros((60, 80), int), np.full((60, 80), 0.9, np.float32)
    labels[20:40, 30:50] = 1
    raised = np.where(labels, np.float32(0.5), depth)
    colour, outline = np.zeros((60, 80, 3), np.uint8), boundaries_from_labels(labels)
    backend = ExactBoundary(labels, raised)
    assert outline.any() and (backend(colour) == outline).all() and (backend(depth) == outline).all()
    m_rgb, m_d, m_da = boundary_maps(colour, depth, ExactBoundary(labels, depth))  # painted, not raised
    assert (m_rgb == outline).all() and not m_d.any() and not m_da.any()


@pytest.mark.parametrize(
    "call",
    [
        lambda: boundaries_from_labels(np.zeros((4, 4))),
        lambda: ExactBoundary(np.ones((4, 4), int), np.ones((4, 4)))(np.zeros((4, 4, 3))),
        lambda: depth_boundaries(np.ones((4, 4), int), np.ones((4, 5))),
        lambda: depth_boundaries(np.ones((4, 4), int), np.ones((4, 4)), -1),
        lambda: precision_recall_f(np.zeros((4, 4)), np.zeros((4, 4), bool)),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(ValueError, match="expected"):
        call()
