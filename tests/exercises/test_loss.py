"""The right answer passes; every planted mistake fails with a message that names it.

Answers and mistakes are written here as a learner would write them, not taken from the checkers.
"""

import math

import numpy as np
import pytest

from ditr_lite.exercises import loss as checks


def match(left, right, row, column, half, largest):
    def window(image, c):
        return image[row - half : row + half + 1, c - half : c + half + 1].astype(int)

    costs = [abs(window(left, column) - window(right, column - d)).sum() for d in range(largest + 1)]
    return costs.index(min(costs))


def match_uint8(left, right, row, column, half, largest):
    def window(image, c):
        return image[row - half : row + half + 1, c - half : c + half + 1]

    return np.argmin([abs(window(left, column) - window(right, column - d)).sum() for d in range(largest + 1)])


def match_plus(left, right, row, column, half, largest):
    return match(left[:, ::-1], right[:, ::-1], row, left.shape[1] - 1 - column, half, largest)


def match_signed(left, right, row, column, half, largest):
    rows = slice(row - half, row + half + 1)
    w = left[rows, column - half : column + half + 1].astype(int)
    return np.argmin([(w - right[rows, column - d - half : column - d + half + 1]).sum() for d in range(largest + 1)])


def match_even(left, right, row, column, half, largest):
    def window(image, c):
        return image[row - half : row + half, c - half : c + half].astype(int)

    return np.argmin([abs(window(left, column) - window(right, column - d)).sum() for d in range(largest + 1)])


def match_by(cost, window=lambda half: half, first=0, last=False):
    def attempt(left, right, row, column, half, largest):
        high = window(half)
        best, found = np.inf, None
        for d in range(first, largest + 1):
            total = 0
            for v in range(row - high, row + high + 1):
                for u in range(column - half, column + half + 1):
                    total += cost(int(left[v, u]) - int(right[v, u - d]))
            if total < best or (last and total == best):
                best, found = total, d
        return found

    return attempt


def refract(angle, n_from, n_to):
    return np.degrees(np.arcsin(n_from * np.sin(np.radians(angle)) / n_to))


def label(depth, truth, region):
    off = abs(depth - truth)
    wrong = (off > 0.01) & (off > 0.02 * truth)
    codes = np.zeros(depth.shape, int)
    codes[wrong] = 1
    codes[depth == 0] = 2
    return codes + 3 * region


def label_with(wrong):
    def attempt(depth, truth, region):
        codes = wrong(depth, truth).astype(int)
        codes[depth == 0] = 2
        return codes + 3 * region

    return attempt


def partition(depth, region):
    return depth * region, depth * ~region


def smallest_offset(near, far, fx, width):
    return width / (fx / near - fx / far)


def precision_recall(truth, guess):
    hits = (truth & guess).sum()
    return hits / guess.sum(), hits / truth.sum()


def todo(*_):
    raise NotImplementedError


RIGHT = {
    checks.check_match: match,
    checks.check_refract: refract,
    checks.check_label: label,
    checks.check_partition: partition,
    checks.check_smallest_offset: smallest_offset,
    checks.check_precision_recall: precision_recall,
}

WRONG = [
    (checks.check_match, match_uint8, "wrap around"),
    (checks.check_match, match_plus, "column - d"),
    (checks.check_match, match_signed, "absolute values"),
    (checks.check_match, lambda *c: c[3] - match(*c), "the disparity is the shift"),
    (checks.check_match, lambda *c: match(*c[:4], 0, c[5]), "whole window"),
    (checks.check_match, lambda *c: match(*c) + 1, "one too large"),
    (checks.check_match, lambda *c: None, "return"),
    (checks.check_match, lambda *c: match(*c[:5], c[5] - 1), "range(largest + 1)"),
    (checks.check_match, lambda *c: match(*c[:4], 2 * c[4], c[5]), "its whole side"),
    (checks.check_match, lambda *c: match(*c[:4], 2 * c[4] + 1, c[5]), "its whole side"),
    (checks.check_match, match_by(abs, first=1), "disparity 0 takes part"),
    (checks.check_match, match_by(abs, last=True), "not with <="),
    (checks.check_match, match_by(abs, window=lambda half: 0), "one row is not enough"),
    (checks.check_match, match_even, "last row and column"),
    (checks.check_refract, lambda a, n, m: refract(a, m, n), "indices are swapped"),
    (checks.check_refract, lambda a, n, m: np.radians(refract(a, n, m)), "radians"),
    (checks.check_refract, lambda a, n, m: np.degrees(np.arcsin(n * np.sin(a) / m)), "takes radians"),
    (checks.check_refract, lambda a, n, m: a * n / m, "small angles"),
    (checks.check_refract, lambda a, n, m: np.sin(np.radians(a)) * n / m, "arcsine"),
    (checks.check_label, lambda d, g, r: 1 * (abs(d - g) > np.maximum(0.01, 0.02 * g)) + 3 * r, "test for them first"),
    (checks.check_label, label_with(lambda d, g: (abs(d - g) > 0.01) | (abs(d - g) > 0.02 * g)), "both thresholds"),
    (checks.check_label, label_with(lambda d, g: abs(d - g) > 0.01), "2 %"),
    (checks.check_label, label_with(lambda d, g: abs(d - g) > 0.02 * g), "10 mm"),
    (checks.check_label, label_with(lambda d, g: (abs(d - g) > 10) & (abs(d - g) > 0.02 * g)), "in metres"),
    (checks.check_label, label_with(lambda d, g: (abs(d - g) > 0.01) & (abs(d - g) / g > 2)), "2 % is 0.02"),
    (checks.check_label, label_with(lambda d, g: (abs(d - g) > 0.01) & (abs(d - g) > 0.2 * g)), "values differ"),
    (checks.check_label, label_with(lambda d, g: (d - g > 0.01) & (d - g > 0.02 * g)), "absolute difference"),
    (checks.check_label, lambda d, g, r: label(d, g, ~r), "swapped"),
    (checks.check_partition, lambda d, r: partition(d, ~r), "swapped"),
    (checks.check_partition, lambda d, r: (d, d * ~r), "optical part holds everything"),
    (checks.check_partition, lambda d, r: (d * r, d), "geometric part holds everything"),
    (checks.check_partition, lambda d, r: (r.astype(float), (~r).astype(float)), "masks"),
    (checks.check_partition, lambda d, r: (d[r], d[~r]), "cut short"),
    (checks.check_smallest_offset, lambda *c: 1000 * smallest_offset(*c), "millimetres"),
    (checks.check_smallest_offset, lambda n, f, x, w: smallest_offset(f, n, x, w), "negative"),
    (checks.check_smallest_offset, lambda n, f, x, w: smallest_offset(n, f, 1, w), "focal length"),
    (checks.check_smallest_offset, lambda n, f, x, w: w * n / x, "near surface alone"),
    (checks.check_smallest_offset, lambda n, f, x, w: (x / n - x / f) / w, "upside down"),
    (checks.check_smallest_offset, lambda n, f, x, w: w * (x / n - x / f), "not the offset"),
    (checks.check_precision_recall, lambda t, g: precision_recall(g, t), "swapped"),
    (checks.check_precision_recall, lambda t, g: ((t & g).mean(), (t & g).mean()), "not by all"),
    (checks.check_precision_recall, lambda t, g: ((t == g).mean(), (t == g).mean()), "agree"),
    (checks.check_precision_recall, lambda t, g: (g.mean(), t.mean()), "count the hits"),
    (checks.check_precision_recall, lambda t, g: 100 * np.array(precision_recall(t, g)), "per cent"),
    (checks.check_precision_recall, lambda t, g: precision_recall(~t, ~g), "other class"),
    (checks.check_smallest_offset, lambda *c: math.nan, "expected"),
]


@pytest.mark.parametrize("checker", RIGHT, ids=lambda c: c.__name__)
def test_the_right_answer_passes_and_an_unsolved_one_does_not(checker, capsys):
    assert checker(RIGHT[checker])
    assert capsys.readouterr().out.startswith("✓")
    assert not checker(todo)
    assert "not attempted" in capsys.readouterr().out


@pytest.mark.parametrize("checker, wrong, message", WRONG, ids=lambda v: getattr(v, "__name__", v))
def test_a_mistake_is_named(checker, wrong, message, capsys):
    assert not checker(wrong)
    out = capsys.readouterr().out
    assert out.startswith("✗") and message in out


@pytest.mark.parametrize("checker", RIGHT, ids=lambda c: c.__name__)
def test_a_checker_never_raises(checker, capsys):
    for nonsense in (lambda: 1, lambda *_: "text", lambda *_: None, lambda *_: np.zeros((3, 3, 3))):
        assert not checker(nonsense)
        assert "✗" in capsys.readouterr().out
