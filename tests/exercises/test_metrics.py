"""The right answer passes; every planted mistake fails with a message that names it."""

import itertools

import numpy as np
from checker_cases import checker_tests

from ditr_lite.exercises import metrics as checks


def rel(pred, gt):
    known = gt > 0
    return (np.abs(pred[known] - gt[known]) / gt[known]).mean()


def delta(pred, gt, threshold):
    known = gt > 0
    ratio = pred[known] / gt[known]
    return 100 * ((ratio < threshold) & (1 / ratio < threshold)).mean()


def crps(ensemble, truth, weigh=lambda s: 1 / (s * (s - 1))):
    spread = sum(np.abs(a - b) for a, b in itertools.combinations(ensemble, 2))
    return (np.abs(ensemble - truth).mean(axis=0) - weigh(len(ensemble)) * spread).mean()


def interval(a, b, picks, at=(2.5, 97.5)):
    means = np.array([np.mean([a[k] - b[k] for k in row]) for row in picks])
    return np.percentile(means, at)


def impossible(rmse, mae, half):
    return mae - rmse > 2 * half


def weight(whole, inside, outside, power):
    return (whole**power - outside**power) / (inside**power - outside**power)


RIGHT = {
    checks.check_rel: rel,
    checks.check_delta: delta,
    checks.check_crps: crps,
    checks.check_interval: interval,
    checks.check_impossible: impossible,
    checks.check_weight: weight,
}


def known(formula):
    return lambda p, g, *t: formula(p[g > 0], g[g > 0], *t)


MISTAKES = [
    (checks.check_rel, known(lambda p, g: np.mean(np.abs(p - g) / p)), "relative to the truth"),
    (checks.check_rel, known(lambda p, g: np.mean(np.abs(p - g))), "mean absolute error"),
    (checks.check_rel, known(lambda p, g: np.abs(p - g).mean() / g.mean()), "average the ratios"),
    (checks.check_rel, known(lambda p, g: np.mean((p - g) / g)), "cancel"),
    (checks.check_rel, known(lambda p, g: np.median(np.abs(p - g) / g)), "median"),
    (checks.check_rel, known(lambda p, g: np.mean((p / g - 1) ** 2) ** 0.5), "squared"),
    (checks.check_rel, lambda p, g: 100 * rel(p, g), "per cent"),
    (checks.check_rel, lambda p, g: rel(p, g) * np.count_nonzero(g) / g.size, "all H W"),
    (checks.check_rel, lambda p, g: np.mean(np.abs(p - g) / g), "gt > 0 first"),
    (checks.check_delta, known(lambda p, g, t: 100 * np.mean(np.abs(p - g) / g < t - 1)), "wording"),
    (checks.check_delta, known(lambda p, g, t: 100 * np.mean(p / g < t)), "too far count"),
    (checks.check_delta, known(lambda p, g, t: 100 * np.mean(g / p < t)), "too near count"),
    (checks.check_delta, known(lambda p, g, t: 100 * np.mean(np.minimum(p / g, g / p) < t)), "never above 1"),
    (checks.check_delta, known(lambda p, g, t: 100 * np.mean(np.maximum(p / g, g / p) <= t)), "strict"),
    (checks.check_delta, lambda p, g, t: delta(p, g, t - 1), "is a factor"),
    (checks.check_delta, lambda p, g, t: delta(p, g, t) / 100, "per cent"),
    (checks.check_delta, lambda p, g, t: 100 - delta(p, g, t), "bad pixels"),
    (checks.check_delta, lambda p, g, t: delta(p, g, t) * np.count_nonzero(g) / g.size, "missing ground truth"),
    (checks.check_crps, lambda x, y: crps(x, y, lambda s: 0), "not rewarded"),
    (checks.check_crps, lambda x, y: crps(x, y, lambda s: 1 / s**2), "unfair"),
    (checks.check_crps, lambda x, y: crps(x, y, lambda s: 2 / (s * (s - 1))), "twice"),
    (checks.check_crps, lambda x, y: crps(x, y, lambda s: 0.5 / (s * (s - 1))), "half of it"),
    (checks.check_crps, lambda x, y: crps(x, y, lambda s: -1 / (s * (s - 1))), "taken away"),
    (checks.check_crps, lambda x, y: np.abs(x.mean(0) - y).mean(), "error of the mean"),
    (checks.check_crps, lambda x, y: crps(x, y) + (len(x) - 1) * np.abs(x - y).mean(), "summed"),
    (checks.check_crps, lambda x, y: crps(x, y) * len(y), "division by N"),
    (checks.check_interval, lambda a, b, k: -interval(a, b, k)[::-1], "a - b is wanted"),
    (checks.check_interval, lambda a, b, k: interval(a, 0 * b, k), "of a alone"),
    (checks.check_interval, lambda a, b, k: interval(a, b, k)[::-1], "before low"),
    (checks.check_interval, lambda a, b, k: interval(a, b, k, (5, 95)), "90 %"),
    (checks.check_interval, lambda a, b, k: interval(a, b, k, (0.025, 0.975)), "takes per cent"),
    (checks.check_interval, lambda a, b, k: np.percentile(a - b, (2.5, 97.5)), "single images"),
    (
        checks.check_interval,
        lambda a, b, k: np.percentile(a[k].mean(1) - b[k[::-1]].mean(1), (2.5, 97.5)),
        "belong together",
    ),
    (checks.check_interval, lambda a, b, k: np.percentile((a - b)[k].mean(0), (2.5, 97.5)), "axis 1"),
    (
        checks.check_interval,
        lambda a, b, k: np.mean(a - b) + np.array([-1.96, 1.96]) * np.std((a - b)[k].mean(1)),
        "normal approximation",
    ),
    (checks.check_interval, lambda a, b, k: np.mean(a - b), "shape"),
    (checks.check_impossible, lambda r, m, h: r < m, "not allowed for"),
    (checks.check_impossible, lambda r, m, h: m - r > h, "both were rounded"),
    (checks.check_impossible, lambda r, m, h: impossible(m, r, h), "wrong way round"),
    (checks.check_impossible, lambda r, m, h: m - h >= r + h, "equal is possible"),
    (checks.check_impossible, lambda r, m, h: ~impossible(r, m, h), "that can be"),
    (checks.check_impossible, lambda r, m, h: m - r > -2 * h, "in its favour"),
    (checks.check_impossible, lambda r, m, h: np.flatnonzero(impossible(r, m, h)), "shape"),
    (checks.check_impossible, lambda r, m, h: impossible(r, m, h).astype(int), "should be bool"),
    (checks.check_weight, lambda w, i, o, p: weight(w, i, o, 1), "averages squares"),
    (checks.check_weight, lambda w, i, o, p: 1 - weight(w, i, o, p), "of the outside"),
    (checks.check_weight, lambda w, i, o, p: 1 / weight(w, i, o, p), "upside down"),
    (checks.check_weight, lambda w, i, o, p: (w**p - o**p) / i**p, "denominator"),
    (checks.check_weight, lambda w, i, o, p: w**p / (i**p - o**p), "numerator"),
    (checks.check_weight, lambda w, i, o, p: ((w - o) / (i - o)) ** p, "the differences"),
    (checks.check_weight, lambda w, i, o, p: weight(w, i, o, p) ** (1 / p), "no root"),
    (checks.check_weight, lambda w, i, o, p: 100 * weight(w, i, o, p), "per cent"),
]


def test_rounding_of_a_tie_accuses_nobody(capsys):
    single = np.float32

    def in_float32(rmse, mae, half):
        return single(rmse) + single(half) < single(mae) - single(half)

    assert checks.check_impossible(in_float32), capsys.readouterr().out
    assert checks.check_impossible(lambda r, m, h: r < m - 2 * h), capsys.readouterr().out


(
    test_the_right_answer_passes,
    test_a_planted_mistake_is_named,
    test_a_stub_is_not_a_failure_of_the_notebook,
    test_every_checker_is_tested,
) = checker_tests(checks, RIGHT, MISTAKES)
