"""The right answer passes; every planted mistake fails with a message that names it.

Answers and mistakes are written here as a learner would write them, not taken from the checkers.
"""

import cv2
import numpy as np
from checker_cases import checker_tests

from ditr_lite.exercises import region as checks


def growth(dilate, iterations):
    return iterations * (dilate // 2)


def miss_and_area(found, true):
    return (true & ~found).sum() / true.sum(), found.sum() / true.sum()


def learning_rate(epoch, epochs, peak, fall):
    p = epoch / epochs
    return peak * np.cos(np.pi * p / 2) ** 2 * np.exp(-fall * p)  # half-angle formula


def dice(p, t):
    return 1 - (2 * (p * t).sum() + 1) / (p.sum() + t.sum() + 1)


def sigmoid(x):
    return (1 + np.tanh(x / 2)) / 2


def fusion(rgb, depth, w_rgb, w_depth):
    return rgb * sigmoid(w_rgb @ depth) + depth * sigmoid(w_depth @ rgb)


def gradient(m, optical, kept, truth):
    return 2 / len(m) * (m * optical + (1 - m) * kept - truth) * (optical - kept)


def vote(x, k):
    return sigmoid(k * (cv2.blur(x, (3, 3), borderType=cv2.BORDER_REPLICATE) - 0.5))


def soft_refine(p, k):
    return cv2.dilate(vote(sigmoid(k * (p - 0.5)), k), np.ones((3, 3)))


def soft_with_border(p, k, border):
    mean = cv2.blur(sigmoid(k * (p - 0.5)), (3, 3), borderType=border)
    return cv2.dilate(sigmoid(k * (mean - 0.5)), np.ones((3, 3)))


RIGHT = {
    checks.check_growth: growth,
    checks.check_miss_and_area: miss_and_area,
    checks.check_learning_rate: learning_rate,
    checks.check_dice: dice,
    checks.check_fusion: fusion,
    checks.check_region_gradient: gradient,
    checks.check_soft_refine: soft_refine,
}

MISTAKES = [
    (checks.check_growth, lambda d, n: d * n, "half the kernel"),
    (checks.check_growth, lambda d, n: 2 * growth(d, n), "both sides"),
    (checks.check_growth, lambda d, n: n * (d // 2 + 1), "its middle does not count"),
    (checks.check_growth, lambda d, n: d // 2, "multiply"),
    (checks.check_growth, lambda d, n: 2 * growth(d, n) + 1, "one kernel"),
    (checks.check_growth, lambda d, n: 7, "expected"),
    (checks.check_miss_and_area, lambda f, t: miss_and_area(f, t)[::-1], "swapped"),
    (checks.check_miss_and_area, lambda f, t: 100 * np.array(miss_and_area(f, t)), "per cent"),
    (checks.check_miss_and_area, lambda f, t: ((t & ~f).sum() / f.sum(), miss_and_area(f, t)[1]), "by the found area"),
    (checks.check_miss_and_area, lambda f, t: ((f & ~t).sum() / t.sum(), miss_and_area(f, t)[1]), "false alarms"),
    (checks.check_miss_and_area, lambda f, t: ((t & f).sum() / t.sum(), miss_and_area(f, t)[1]), "was found"),
    (checks.check_miss_and_area, lambda f, t: (miss_and_area(f, t)[0], t.sum() / f.sum()), "upside down"),
    (checks.check_miss_and_area, lambda f, t: ((t & ~f).mean(), miss_and_area(f, t)[1]), "whole picture"),
    (checks.check_learning_rate, lambda e, n, p, f: learning_rate(e, n, p, 0), "exponential factor is missing"),
    (checks.check_learning_rate, lambda e, n, p, f: p * np.exp(-f * e / n), "cosine factor is missing"),
    (checks.check_learning_rate, lambda e, n, p, f: 2 * learning_rate(e, n, p, f), "half is missing"),
    (checks.check_learning_rate, lambda e, n, p, f: learning_rate(2 * e, n, p, f / 2), "whole period"),
    (
        checks.check_learning_rate,
        lambda e, n, p, f: (learning_rate(e, n, p, 0) + p * np.exp(-f * e / n)) / 2,
        "multiplied, not added",
    ),
    (checks.check_learning_rate, lambda e, n, p, f: learning_rate(e, n, p, -f), "sign"),
    (checks.check_learning_rate, lambda e, n, p, f: learning_rate(e, n, p, 0) * 10 ** (-e / n), "place of ln 10"),
    (checks.check_learning_rate, lambda e, n, p, f: learning_rate(e, n, p, f * n), "divide by epochs"),
    (
        checks.check_learning_rate,
        lambda e, n, p, f: p * np.cos(np.pi * e / n) * np.exp(-f * e / n),
        "shifted by 1",
    ),
    (checks.check_dice, lambda p, t: 1 - dice(p, t), "1 minus it"),
    (checks.check_dice, lambda p, t: 1 - ((p * t).sum() + 1) / (p.sum() + t.sum() + 1), "2 is missing"),
    (checks.check_dice, lambda p, t: 1 - 2 * (p * t).sum() / (p.sum() + t.sum()), "+ 1 is missing"),
    (
        checks.check_dice,
        lambda p, t: 1 - ((p * t).sum() + 1) / (p.sum() + t.sum() - (p * t).sum() + 1),
        "intersection over union",
    ),
    (checks.check_dice, lambda p, t: dice(p > 0.5, t), "thresholded"),
    (checks.check_dice, lambda p, t: 1 - (2 * (p * t).mean() + 1) / (p.mean() + t.mean() + 1), "means instead"),
    (checks.check_fusion, lambda r, d, w, v: r * sigmoid(w @ r) + d * sigmoid(v @ d), "its own modality"),
    (checks.check_fusion, lambda r, d, w, v: r * (w @ d) + d * (v @ r), "sigmoid is missing"),
    (checks.check_fusion, lambda r, d, w, v: fusion(r, d, v, w), "gates are swapped"),
    (checks.check_fusion, lambda r, d, w, v: r + d, "plain addition"),
    (checks.check_fusion, lambda r, d, w, v: r * sigmoid(w @ d) + d * (1 - sigmoid(w @ d)), "a gate of its own"),
    (
        checks.check_fusion,
        lambda r, d, w, v: np.concatenate([r * sigmoid(w @ d), d * sigmoid(v @ r)]),
        "not concatenated",
    ),
    (checks.check_fusion, lambda r, d, w, v: fusion(r, d, w.T, v.T), "transposed"),
    (checks.check_fusion, lambda r, d, w, v: fusion(r, d, w, v) / 2, "halved"),
    (checks.check_region_gradient, lambda *a: -gradient(*a), "sign of the inner"),
    (checks.check_region_gradient, lambda m, o, k, y: 2 / 6 * (m * o + (1 - m) * k - y), "optical - kept is missing"),
    (checks.check_region_gradient, lambda m, o, k, y: 2 / 6 * (m * o + (1 - m) * k - y) * o, "kept falls"),
    (checks.check_region_gradient, lambda *a: gradient(*a) / 2, "2 of the square"),
    (checks.check_region_gradient, lambda *a: gradient(*a) * 6, "divides by N"),
    (checks.check_region_gradient, lambda *a: gradient(*a).mean(), "a derivative of its own"),
    (checks.check_soft_refine, lambda p, k: cv2.dilate(vote(p, k), np.ones((3, 3))), "first threshold"),
    (
        checks.check_soft_refine,
        lambda p, k: cv2.dilate(
            cv2.blur(sigmoid(k * (p - 0.5)), (3, 3), borderType=cv2.BORDER_REPLICATE), np.ones((3, 3))
        ),
        "a mean is no majority",
    ),
    (checks.check_soft_refine, lambda p, k: cv2.dilate(sigmoid(k * (p - 0.5)), np.ones((3, 3))), "vote is left out"),
    (checks.check_soft_refine, lambda p, k: vote(sigmoid(k * (p - 0.5)), k), "dilation is left out"),
    (
        checks.check_soft_refine,
        lambda p, k: vote(cv2.dilate(sigmoid(k * (p - 0.5)), np.ones((3, 3))), k),
        "comes before the vote",
    ),
    (
        checks.check_soft_refine,
        lambda p, k: cv2.erode(vote(sigmoid(k * (p - 0.5)), k), np.ones((3, 3))),
        "minimum, which shrinks",
    ),
    (checks.check_soft_refine, lambda p, k: soft_refine(p, 1.0), "steepness is not used"),
    (checks.check_soft_refine, lambda p, k: soft_with_border(p, k, cv2.BORDER_DEFAULT), "cv2.blur mirrors"),
    (checks.check_soft_refine, lambda p, k: soft_with_border(p, k, cv2.BORDER_CONSTANT), "not 0 beyond"),
    (checks.check_soft_refine, lambda p, k: (soft_refine(p, 1e4) > 0.5) * 1.0, "no gradient"),
    (
        checks.check_soft_refine,
        lambda p, k: cv2.dilate(
            sigmoid(k * cv2.blur(sigmoid(k * p), (3, 3), borderType=cv2.BORDER_REPLICATE)), np.ones((3, 3))
        ),
        "not at 0",
    ),
]


(
    test_the_right_answer_passes,
    test_a_planted_mistake_is_named,
    test_a_stub_is_not_a_failure_of_the_notebook,
    test_every_checker_is_tested,
) = checker_tests(checks, RIGHT, MISTAKES)
