"""Checkers of the exercises on boundary maps: each prints a check mark, or a cross with the reason, and never raises.

The right answers come from ``boundary``, the files that the pipeline draws its guides with and that hold their truth.
"""

import numpy as np

from ..boundary import boundaries_from_labels, depth_aware, depth_boundaries, precision_recall_f, within
from ..boundary.sam import outlines, suppress
from .checker import Function, check

LABELS = np.zeros((9, 12), int)  # two objects that touch, one of them behind both sides of the frame; a small one
LABELS[2:6, 0:4], LABELS[2:4, 11], LABELS[3:7, 4:8], LABELS[7:9, 10] = 1, 1, 2, 3
DEPTH = np.where(LABELS > 0, 1.0 - 0.03 * LABELS, 1.0)  # metres: nearer by 3, 6 and 9 cm
DEPTH[5, 1:3], DEPTH[6, 6] = 0.995, 0.0  # a foot that touches the table; an unknown pixel
LINE, SHIFTED = np.zeros((2, 12, 14), bool)
LINE[3, 2:12], LINE[6:11, 4] = True, True
SHIFTED[4, 3:9], SHIFTED[1, 11], SHIFTED[9:12, 7] = True, True, True
MASKS = np.zeros((5, 8, 12), bool)  # the table, an object twice, a part of it, a neighbour
MASKS[0], MASKS[1, 2:7, 1:7], MASKS[2, 2:7, 1:8] = True, True, True
MASKS[3, 3:5, 3:5], MASKS[4, 1:6, 5:11] = True, True
SCORES = np.array([0.90, 0.93, 0.95, 0.91, 0.99])


def _differs(labels: np.ndarray, axis: int, shift: int, edge: str = "edge") -> np.ndarray:
    """Return where a pixel's label differs from that of its neighbour on one side."""
    padded = np.pad(labels, 1, mode=edge)
    near = np.roll(padded, shift, axis)[1:-1, 1:-1]
    return labels != near


def _sides(labels: np.ndarray, edge: str = "edge") -> np.ndarray:
    return np.any([_differs(labels, axis, shift, edge) for axis in (0, 1) for shift in (1, -1)], axis=0)


def check_outline(attempt: Function) -> bool:
    """Check ``attempt(labels) -> (H, W) bool``: object pixels with a 4-neighbour of another label."""

    def diagonal(labels):
        padded = np.pad(labels, 1, mode="edge")
        h, w = labels.shape
        shifts = [padded[y : y + h, x : x + w] for y in range(3) for x in range(3)]
        return np.any([s != labels for s in shifts], axis=0) & (labels > 0)

    mistakes = {
        "background pixels beside an object are marked, too: a boundary belongs to the object": _sides,
        "the picture's frame counts as another label": lambda a: _sides(a, "constant") & (a > 0),
        "neighbours wrap round the frame (np.roll): pad first": lambda a: (
            np.any([a != np.roll(a, s, axis) for axis in (0, 1) for s in (1, -1)], axis=0) & (a > 0)
        ),
        "diagonal neighbours count, too: four neighbours are asked for": diagonal,
        "only the neighbours to the left and right are compared": lambda a: (
            (_differs(a, 1, 1) | _differs(a, 1, -1)) & (a > 0)
        ),
        "one side is missing: compare with all four neighbours": lambda a: (
            (_differs(a, 1, 1) | _differs(a, 0, 1)) & (a > 0)
        ),
        "objects that touch have a boundary between them, too": lambda a: boundaries_from_labels((a > 0).astype(int)),
    }
    return check("outlines", attempt, boundaries_from_labels, [(LABELS,), (LABELS.T.copy(),)], mistakes)


def check_depth_aware(attempt: Function) -> bool:
    """Check ``attempt(m_rgb, m_d, tolerance) -> m_da``: the pixels of M_RGB with one of M_D within the tolerance."""

    def square(a, b, t):
        k, (h, w) = int(t), a.shape
        padded = np.pad(b, k)
        shifts = [padded[y : y + h, x : x + w] for y in range(2 * k + 1) for x in range(2 * k + 1)]
        return a & np.any(shifts, axis=0)

    mistakes = {
        "that is the plain intersection, nearly empty: M_D must be grown by the tolerance": lambda a, b, t: a & b,
        "M_RGB was grown and pixels of M_D returned: the result must be part of M_RGB": lambda a, b, t: depth_aware(
            b, a, t
        ),
        "the grown M_D is returned without asking where M_RGB is": lambda a, b, t: within(b, t),
        "that is what depth does not confirm; keep what it does": lambda a, b, t: a & ~within(b, t),
        "that is the union of the maps": lambda a, b, t: a | b,
        "both maps are grown: lines become thick": lambda a, b, t: within(a, t) & within(b, t),
        "distance is counted along rows and columns; it should be Euclidean": square,
        "a distance equal to the tolerance counts as near, too": lambda a, b, t: depth_aware(a, b, max(t - 0.5, 0)),
    }
    cases = [(LINE, SHIFTED, 2), (SHIFTED, LINE, 1), (LINE, SHIFTED, 0)]
    return check("depth-aware map", attempt, depth_aware, cases, mistakes)


def check_scores(attempt: Function) -> bool:
    """Check ``attempt(pred, true, tolerance) -> (precision, recall, f)``."""

    def right(pred, true, tolerance):
        return np.array(precision_recall_f(pred, true, tolerance))

    def one_sided(pred, true, tolerance):
        hits = (pred & within(true, tolerance)).sum()
        p, r = hits / pred.sum(), hits / true.sum()
        return np.array([p, r, 2 * p * r / (p + r)])

    def with_f(change):
        def wrong(pred, true, tolerance):
            p, r, _ = right(pred, true, tolerance)
            return np.array([p, r, change(p, r)])

        return wrong

    mistakes = {
        "precision and recall are swapped": lambda a, b, t: right(b, a, t),
        "the tolerance is not used": lambda a, b, t: right(a, b, 0),
        "recall counts predicted pixels; it is the share of true pixels with a prediction near": one_sided,
        "F is the harmonic mean, not the ordinary one": with_f(lambda p, r: (p + r) / 2),
        "F is the harmonic mean, not the geometric one": with_f(lambda p, r: (p * r) ** 0.5),
        "F lacks its factor 2": with_f(lambda p, r: p * r / (p + r)),
        "these are per cent; shares from 0 to 1 are asked for": lambda a, b, t: 100 * right(a, b, t),
    }
    met = SHIFTED.copy()
    met[3, 11] = True  # one common pixel: without the tolerance F is no 0 / 0
    return check("precision, recall, F", attempt, right, [(LINE, met, 1), (met, LINE, 2)], mistakes)


def check_suppress(attempt: Function) -> bool:
    """Check ``attempt(masks (N, H, W), scores (N,), max_overlap) -> list of indices`` that survive, best first.

    A mask is dropped when its overlap with a kept one is larger than ``max_overlap``; equal is not larger. All scores
    differ.
    """

    def greedy(masks, scores, limit, by=None, dropped_count=False, equal_stays=True):
        kept, seen = [], []
        for i in np.argsort(-scores, kind="stable"):
            rivals = seen if dropped_count else kept
            values = []
            for k in rivals:
                both = (masks[i] & masks[k]).sum()
                values.append(both / (by(masks[i], masks[k]) if by else (masks[i] | masks[k]).sum()))
            if all(v < limit or (equal_stays and v == limit) for v in values):
                kept.append(int(i))
            seen.append(i)
        return kept

    mistakes = {
        "the worst mask comes first: sort by falling score": lambda m, s, t: suppress(m, -s, t),
        "the indices are sorted by number; the best mask comes first": lambda m, s, t: sorted(suppress(m, s, t)),
        "nothing is dropped": lambda m, s, t: suppress(m, s, 1.0),
        "the overlap is divided by the smaller mask: a part of an object then falls to the object": lambda m, s, t: (
            greedy(m, s, t, by=lambda a, b: min(a.sum(), b.sum()))
        ),
        "the overlap is divided by one mask alone; take the union": lambda m, s, t: greedy(
            m, s, t, by=lambda a, b: a.sum()
        ),
        "a mask that was dropped itself still drops others": lambda m, s, t: greedy(m, s, t, dropped_count=True),
        "an overlap equal to max_overlap does not exceed it: such a mask is kept": lambda m, s, t: greedy(
            m, s, t, equal_stays=False
        ),
        "that keeps what overlaps; drop it": lambda m, s, t: [k for k in range(len(m)) if k not in suppress(m, s, t)],
    }
    chain = np.array([np.arange(12) // 3 == 9] * 3)  # three masks, each overlapping the next
    chain[0, 0:8], chain[1, 2:10], chain[2, 4:12] = True, True, True
    chain = chain[:, None]
    half = np.zeros((3, 1, 12), bool)  # overlaps of exactly 0.5 and 0.25
    half[0, 0, :8], half[1, 0, :4], half[2, 0, 6:8] = True, True, True
    cases = [(MASKS, SCORES, 0.7), (MASKS, SCORES[::-1].copy(), 0.7), (chain, np.array([0.9, 0.8, 0.7]), 0.5)]
    cases.append((half, np.array([0.7, 0.9, 0.8]), 0.5))
    return check("non-maximum suppression", attempt, suppress, cases, mistakes)


def check_mask_outlines(attempt: Function) -> bool:
    """Check ``attempt(masks) -> (H, W) bool``: our rule by which SAM's masks become one boundary map."""

    def rank(masks, sign=-1):
        owner = np.zeros(masks.shape[1:], int)
        for k, i in enumerate(np.argsort(sign * masks.sum(axis=(1, 2)), kind="stable"), start=1):
            owner[masks[i]] = k
        return owner

    def framed(masks):
        return np.any([_sides(np.pad(m, 1).astype(int))[1:-1, 1:-1] & m for m in masks], axis=0)

    mistakes = {
        "each mask's own outline, all thrown together: where a smaller mask lies in front, they are hidden": lambda m: (
            np.any([_sides(a.astype(int)) & a for a in m], axis=0)
        ),
        "the picture's frame is no boundary": framed,
        "both sides of a border are marked; only the smaller mask's pixel should be": lambda m: _sides(rank(m)),
        "masks are painted in the order in which they come: sort by size, small ones in front": lambda m: outlines_of(
            (m * np.arange(1, len(m) + 1)[:, None, None]).max(axis=0)
        ),
        "where masks overlap, the smaller one is in front": lambda m: outlines_of(rank(m, 1)),
        "the larger mask's side is marked; take the smaller one's": lambda m: outlines_of(-rank(m)),
    }

    def outlines_of(owner):
        padded, (h, w) = np.pad(owner, 1, mode="edge"), owner.shape
        near = [padded[y : y + h, x : x + w] for y, x in ((0, 1), (2, 1), (1, 0), (1, 2))]
        return np.any([owner > n for n in near], axis=0)

    cases = [(MASKS[[0, 2, 3, 4]],), (MASKS[[3, 4, 2]],)]
    return check("masks to boundaries", attempt, outlines, cases, mistakes)


def check_jumps(attempt: Function) -> bool:
    """Check ``attempt(labels, depth_gt, jump) -> (H, W) bool``: outlines at which true depth jumps; 0 is unknown.

    A jump is a difference of more than ``jump`` metres.
    """

    def wrong(labels, depth, jump, known=True, own=True, signed=False, other=True, equal=False):
        padded_l, padded_d, (h, w) = np.pad(labels, 1, mode="edge"), np.pad(depth, 1, mode="edge"), labels.shape
        found = np.zeros(labels.shape, bool)
        for y, x in ((0, 1), (2, 1), (1, 0), (1, 2)):
            label, near = padded_l[y : y + h, x : x + w], padded_d[y : y + h, x : x + w]
            step = (near - depth) if signed else np.abs(near - depth)
            jumps = (step > jump) | (equal & (step == jump))
            found |= ((label != labels) | (not other)) & jumps & ((near > 0) & (depth > 0) | (not known))
        return found & (labels > 0) if own else found

    mistakes = {
        "unknown depth (0) counts as a jump": lambda a, d, j: wrong(a, d, j, known=False),
        "background pixels are marked, too": lambda a, d, j: wrong(a, d, j, own=False),
        "jumps inside an object count, too: compare only with neighbours of another label": lambda a, d, j: wrong(
            a, d, j, other=False
        ),
        "those are all outlines, whether depth jumps or not": lambda a, d, j: boundaries_from_labels(a),
        "the jump is in metres, not in millimetres": lambda a, d, j: wrong(a, 1000 * d, j),
        "a difference equal to the jump does not exceed it": lambda a, d, j: wrong(a, d, j, equal=True),
        "only the nearer side is marked; a jump has two": lambda a, d, j: wrong(a, d, j, signed=True),
    }
    quarter = np.where(LABELS > 0, 1.0 - 0.25 * LABELS, 1.0)  # numbers that a computer holds exactly
    cases = [(LABELS, DEPTH, 0.01), (LABELS, DEPTH, 0.04), (LABELS, quarter, 0.25)]
    return check("depth jumps", attempt, depth_boundaries, cases, mistakes)
