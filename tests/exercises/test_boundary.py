"""Each checker of the boundary exercises passes the right answer and names planted mistakes."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from ditr_lite import boundary
from ditr_lite.boundary import sam
from ditr_lite.exercises import boundary as checks


def shifts(array, **pad):
    padded, (h, w) = np.pad(array, 1, **(pad or {"mode": "edge"})), array.shape
    return [padded[y : y + h, x : x + w] for y, x in ((0, 1), (2, 1), (1, 0), (1, 2))]


def outline(labels):
    return np.any([n != labels for n in shifts(labels)], axis=0) & (labels > 0)


def near(mask, tolerance):
    return distance_transform_edt(~mask) <= tolerance if mask.any() else mask


def keep_confirmed(a, b, t):
    return a & near(b, t)


def scores(pred, true, t):
    p, r = (pred & near(true, t)).sum() / pred.sum(), (true & near(pred, t)).sum() / true.sum()
    return p, r, 2 * p * r / (p + r)


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


def nms(masks, values, limit):
    kept = []
    for i in np.argsort(-values):
        if all(iou(masks[i], masks[k]) <= limit for k in kept):
            kept.append(int(i))
    return kept


def owner(masks, sign=-1):
    rank = np.zeros(masks.shape[1:], int)
    for k, i in enumerate(np.argsort(sign * masks.sum(axis=(1, 2)), kind="stable"), 1):
        rank[masks[i]] = k
    return rank


def as_they_come(masks):
    return (masks * np.arange(1, len(masks) + 1)[:, None, None]).max(axis=0)


def drawn(rank):
    return np.any([rank > n for n in shifts(rank)], axis=0)


def draw(masks):
    return drawn(owner(masks))


def jumps(labels, depth, jump):
    found = np.zeros(labels.shape, bool)
    for label, z in zip(shifts(labels), shifts(depth), strict=True):
        found |= (label != labels) & (labels > 0) & (z > 0) & (depth > 0) & (np.abs(z - depth) > jump)
    return found


SOLVED = [
    (checks.check_outline, outline, boundary.boundaries_from_labels),
    (checks.check_depth_aware, keep_confirmed, boundary.depth_aware),
    (checks.check_scores, scores, boundary.precision_recall_f),
    (checks.check_suppress, nms, sam.suppress),
    (checks.check_mask_outlines, draw, sam.outlines),
    (checks.check_jumps, jumps, boundary.depth_boundaries),
]


@pytest.mark.parametrize(("check", "mine", "reference"), SOLVED, ids=lambda f: getattr(f, "__name__", ""))
def test_right_answers_pass(check, mine, reference, capsys):
    assert check(mine) and check(reference)
    assert capsys.readouterr().out.count("✓") == 2


MISTAKES = [
    (checks.check_outline, lambda a: np.any([n != a for n in shifts(a)], axis=0), "belongs to the object"),
    (
        checks.check_outline,
        lambda a: np.any([n != a for n in shifts(a, constant_values=0)], axis=0) & (a > 0),
        "picture's frame",
    ),
    (
        checks.check_outline,
        lambda a: (a > 0) & np.any([np.roll(a, s, k) != a for s in (1, -1) for k in (0, 1)], axis=0),
        "wrap round",
    ),
    (checks.check_outline, lambda a: outline((a > 0).astype(int)), "objects that touch"),
    (checks.check_outline, lambda a: (a > 0) & np.any([n != a for n in shifts(a)[2:]], axis=0), "left and right"),
    (checks.check_depth_aware, lambda a, b, t: a & b, "plain intersection, nearly empty"),
    (checks.check_depth_aware, lambda a, b, t: b & near(a, t), "must be part of M_RGB"),
    (checks.check_depth_aware, lambda a, b, t: a & ~near(b, t), "does not confirm"),
    (checks.check_depth_aware, lambda a, b, t: a | b, "union"),
    (checks.check_depth_aware, lambda a, b, t: near(b, t), "without asking"),
    (checks.check_scores, lambda a, b, t: scores(b, a, t), "swapped"),
    (checks.check_scores, lambda a, b, t: boundary.precision_recall_f(a, b, 0), "tolerance is not used"),
    (checks.check_scores, lambda a, b, t: scores(a, b, 0), "tolerance is not used"),
    (checks.check_scores, lambda a, b, t: (*scores(a, b, t)[:2], sum(scores(a, b, t)[:2]) / 2), "harmonic mean"),
    (checks.check_scores, lambda a, b, t: np.array(scores(a, b, t)) * 100, "per cent"),
    (checks.check_suppress, lambda m, s, t: nms(m, -s, t), "falling score"),
    (checks.check_suppress, lambda m, s, t: sorted(nms(m, s, t)), "sorted by number"),
    (checks.check_suppress, lambda m, s, t: nms(m, s, 1), "nothing is dropped"),
    (checks.check_suppress, lambda m, s, t: nms(m, s, t - 1e-9), "equal to max_overlap"),
    (checks.check_mask_outlines, lambda m: np.any([outline(a.astype(int)) for a in m], axis=0), "thrown together"),
    (
        checks.check_mask_outlines,
        lambda m: np.any([owner(m) != n for n in shifts(owner(m))], axis=0),
        "both sides of a border",
    ),
    (
        checks.check_mask_outlines,
        lambda m: np.any([owner(m) < n for n in shifts(owner(m))], axis=0),
        "larger mask's side",
    ),
    (
        checks.check_mask_outlines,
        lambda m: np.any([owner(m, 1) > n for n in shifts(owner(m, 1))], axis=0),
        "smaller one is in front",
    ),
    (checks.check_mask_outlines, lambda m: drawn(as_they_come(m)), "order in which they come"),
    (checks.check_jumps, lambda a, d, j: jumps(a, d, j - 1e-9), "equal to the jump"),
    (checks.check_jumps, lambda a, d, j: outline(a), "whether depth jumps or not"),
    (checks.check_jumps, lambda a, d, j: jumps(a, d * 1000, j), "not in millimetres"),
    (checks.check_jumps, lambda a, d, j: jumps(a, np.where(d > 0, d, 1e-9), j), "unknown depth"),
]


@pytest.mark.parametrize(("check", "attempt", "message"), MISTAKES)
def test_planted_mistakes_are_named(check, attempt, message, capsys):
    assert not check(attempt)
    out = capsys.readouterr().out
    assert out.startswith("✗") and message in out


def test_overlap_with_the_smaller_mask_is_named(capsys):
    def wrong(masks, values, limit):
        kept = []
        for i in np.argsort(-values):
            shares = [(masks[i] & masks[k]).sum() / min(masks[i].sum(), masks[k].sum()) for k in kept]
            if all(s <= limit for s in shares):
                kept.append(int(i))
        return kept

    assert not checks.check_suppress(wrong)
    assert "divided by the smaller mask" in capsys.readouterr().out


def test_dropped_masks_that_still_drop_others_are_named(capsys):
    def wrong(masks, values, limit):
        order = list(np.argsort(-values))
        return [int(i) for n, i in enumerate(order) if all(iou(masks[i], masks[k]) <= limit for k in order[:n])]

    assert not checks.check_suppress(wrong)
    assert "dropped itself" in capsys.readouterr().out


def stops(*args):
    raise RuntimeError("boom")


def todo(*args):
    raise NotImplementedError


@pytest.mark.parametrize("check", [row[0] for row in SOLVED], ids=lambda f: f.__name__)
def test_a_checker_never_raises(check, capsys):
    for attempt, message in ((stops, "boom"), (todo, "not attempted"), (lambda *args: None, "returns nothing")):
        assert not check(attempt)
        assert message in capsys.readouterr().out
