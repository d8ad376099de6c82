"""Checkers of the exercises on scores: REL, delta, CRPS, a paired interval, and the audit of tables."""

import numpy as np

from .. import metrics
from ..paper.audit import implied_weight
from .checker import Function, check


def _maps(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a prediction and its truth, (6, 8) float64 metres; a quarter of the truth is unknown."""
    rng = np.random.default_rng(seed)
    gt = rng.uniform(0.4, 0.9, (6, 8))
    pred = gt * rng.uniform(0.85, 1.18, gt.shape)
    gt[rng.random(gt.shape) < 0.25] = 0
    return pred, gt


def check_rel(attempt: Function) -> bool:
    """Check ``attempt(pred, gt) -> float``, Eq. 6 over the pixels with ground truth (gt > 0); both are (H, W)."""

    def of(formula, known=True):
        return lambda p, g: formula(p[g > 0], g[g > 0]) if known else formula(p, g)

    mistakes = {
        "the error is divided by the prediction; REL is relative to the truth": of(
            lambda p, g: np.mean(abs(p - g) / p)
        ),
        "that is the mean absolute error: divide each pixel's error by its depth": of(lambda p, g: np.mean(abs(p - g))),
        "that is mean error over mean depth; average the ratios instead": of(lambda p, g: abs(p - g).sum() / g.sum()),
        "the absolute value is missing: too near and too far cancel": of(lambda p, g: np.mean((p - g) / g)),
        "that is the median over pixels (as TranspareNet's code takes it)": of(lambda p, g: np.median(abs(p - g) / g)),
        "the ratios are squared; REL takes their absolute value": of(lambda p, g: np.sqrt(np.mean(((p - g) / g) ** 2))),
        "that is per cent; a plain ratio is wanted": lambda p, g: 100 * metrics.rel(p, g),
        "the sum over known pixels is divided by all H W pixels": lambda p, g: metrics.rel(p, g) * (g > 0).mean(),
        "missing ground truth (0) is divided by: choose the pixels with gt > 0 first": of(
            lambda p, g: np.mean(abs(p - g) / g), known=False
        ),
    }
    return check("REL", attempt, metrics.rel, [_maps(1), _maps(2)], mistakes)


def check_delta(attempt: Function) -> bool:
    """Check ``attempt(pred, gt, threshold) -> per cent`` of known pixels with max(p / g, g / p) < threshold."""

    def of(inside):
        def wrong(p, g, t):
            known = g > 0
            return 100 * np.mean(inside(p[known], g[known], t))

        return wrong

    exact = np.array([[0.5, 0.525, 0.55, 1.25]]), np.array([[0.5, 0.5, 0.5, 1.0]])  # the last lies on 1.25 exactly
    mistakes = {
        "that is the paper's wording, |p - g| / g < n %: pixels that are too near pass too easily": of(
            lambda p, g, t: abs(p - g) / g < t - 1
        ),
        "only pixels that are too far count as bad: take the larger of p / g and g / p": of(lambda p, g, t: p / g < t),
        "only pixels that are too near count as bad: take the larger of p / g and g / p": of(lambda p, g, t: g / p < t),
        "the smaller of the two ratios is taken: it is never above 1": of(lambda p, g, t: np.minimum(p / g, g / p) < t),
        "the comparison is strict: a pixel on the threshold is out": of(lambda p, g, t: np.maximum(p / g, g / p) <= t),
        "the threshold is a factor such as 1.05: compare the ratio with it as it is": of(
            lambda p, g, t: np.maximum(p / g, g / p) < t - 1
        ),
        "that is a share of 0 to 1; per cent is wanted": lambda p, g, t: metrics.delta(p, g, t) / 100,
        "that is the share of bad pixels; the good ones are wanted": lambda p, g, t: 100 - metrics.delta(p, g, t),
        "missing ground truth (0) counts as a bad pixel": lambda p, g, t: metrics.delta(p, g, t) * (g > 0).mean(),
    }
    cases = [(*_maps(1), 1.05), (*_maps(2), 1.10), (*exact, 1.25)]
    return check("delta", attempt, metrics.delta, cases, mistakes)


def check_crps(attempt: Function) -> bool:
    """Check ``attempt(ensemble (S, N), truth (N,)) -> float``: the fair CRPS, mean over N.

    Per pixel: mean_i |x_i - y| - sum over pairs i < j of |x_i - x_j| / (S (S - 1)).
    """

    def with_spread(factor):
        def wrong(x, y):
            size = len(x)
            pairs = np.abs(x[:, None] - x[None]).sum(axis=(0, 1)) / 2  # every pair once
            return np.mean(np.abs(x - y).mean(axis=0) - factor(size) * pairs)

        return wrong

    rng = np.random.default_rng(3)
    cases = [(rng.normal(0.6, 0.05, (s, 7)), rng.normal(0.6, 0.05, 7)) for s in (4, 5)]
    mistakes = {
        "that is the mean absolute error of the members: the spread is not rewarded": with_spread(lambda s: 0),
        "that is the unfair CRPS: divide by S (S - 1), not by S^2": with_spread(lambda s: 1 / s**2),
        "every pair is counted twice, or divided by the number of pairs": with_spread(lambda s: 2 / (s * (s - 1))),
        "the spread is added; it must be taken away": with_spread(lambda s: -1 / (s * (s - 1))),
        "that is the error of the mean; average the members' errors": lambda x, y: np.mean(np.abs(x.mean(axis=0) - y)),
        "the members' errors are summed: average them over S": lambda x, y: (
            metrics.crps(x, y) + (len(x) - 1) * np.mean(np.abs(x - y))
        ),
        "the sum over pixels is missing its division by N": lambda x, y: y.size * metrics.crps(x, y),
        "that is half of it per pair: each unordered pair weighs 1 / (S (S - 1))": with_spread(
            lambda s: 0.5 / (s * (s - 1))
        ),
    }
    return check("CRPS", attempt, lambda x, y: metrics.crps(x, y), cases, mistakes)


def check_interval(attempt: Function) -> bool:
    """Check ``attempt(a, b, picks) -> (low, high)``: the paired 95 % interval of mean(a - b).

    ``a`` and ``b`` are the scores (N,) of two methods on the same images; ``picks`` (B, N) the images of B resamples.
    """

    def percentiles(values, at=(2.5, 97.5)):
        return np.percentile(values, at)

    def right(a, b, picks):
        return percentiles((a - b)[picks].mean(axis=1))

    rng = np.random.default_rng(5)
    hard = rng.uniform(0.02, 0.2, (2, 30))
    cases = [(h + rng.normal(0.003, 0.004, 30), h, rng.integers(0, 30, (400, 30))) for h in hard]
    mistakes = {
        "the two methods are resampled apart: an image's two scores belong together": lambda a, b, k: percentiles(
            a[k].mean(axis=1) - b[k[::-1]].mean(axis=1)
        ),
        "that is b - a; a - b is wanted": lambda a, b, k: -right(a, b, k)[::-1],
        "that is the interval of a alone; that of a - b is wanted": lambda a, b, k: percentiles(a[k].mean(axis=1)),
        "high stands before low": lambda a, b, k: right(a, b, k)[::-1],
        "that interval holds 90 %: take the 2.5th and the 97.5th percentile": lambda a, b, k: percentiles(
            (a - b)[k].mean(axis=1), (5, 95)
        ),
        "np.percentile takes per cent: 2.5 and 97.5, not 0.025 and 0.975": lambda a, b, k: percentiles(
            (a - b)[k].mean(axis=1), (0.025, 0.975)
        ),
        "that is the spread of single images; the interval of the mean is wanted": lambda a, b, k: percentiles(a - b),
        "that is a normal approximation; use the resamples": lambda a, b, k: (
            (a - b).mean() + 1.96 * (a - b)[k].mean(axis=1).std() * np.array([-1, 1])
        ),
        "the mean runs over the resamples; average within each, axis 1": lambda a, b, k: percentiles(
            (a - b)[k].mean(axis=0)
        ),
    }
    return check("paired interval", attempt, right, cases, mistakes)


def check_impossible(attempt: Function) -> bool:
    """Check ``attempt(rmse, mae, half) -> (N,) bool``: entries that cannot be, however their last place was rounded.

    ``rmse`` and ``mae`` are arrays (N,), ``half`` a number: each printed number may be off by it at most, in either
    direction. RMSE equal to MAE is possible.
    """
    rmse = np.array([0.057, 0.040, 0.0305, 0.024, 0.024, 0.019, 0.031, 0.050])
    mae = np.array([0.059, 0.031, 0.0305, 0.0244, 0.0252, 0.012, 0.0335, 0.0507])

    equal = np.array([0.25, 0.5]), np.array([0.5, 0.875])  # binary fractions: rounding leaves the first exactly equal

    def right(rmse, mae, half):
        return rmse + half < mae - half

    mistakes = {
        "equal is possible: where all errors are alike, RMSE is MAE": lambda r, m, h: r + h <= m - h,
        "rounding is not allowed for: .024 may stand for .0244": lambda r, m, h: r < m,
        "only one of the two numbers may be off: both were rounded": lambda r, m, h: r + h < m,
        "the inequality is the wrong way round: RMSE below MAE cannot be": lambda r, m, h: m + h < r - h,
        "that marks the entries that can be": lambda r, m, h: ~right(r, m, h),
        "rounding is held against the table: it must be in its favour": lambda r, m, h: r - h < m + h,
    }
    cases = [(rmse, mae, 0.0005), (rmse, mae, 0.0009), (*equal, 0.125)]
    return check("impossible entries", attempt, right, cases, mistakes, rtol=0)


def check_weight(attempt: Function) -> bool:
    """Check ``attempt(whole, inside, outside, power) -> w`` with whole^p = w inside^p + (1 - w) outside^p, numbers."""

    def right(whole, inside, outside, power):
        return implied_weight(whole, inside, outside, power)[1]

    mistakes = {
        "RMSE averages squares: raise all three to the power": lambda w, i, o, p: right(w, i, o, 1),
        "that is the weight of the outside": lambda w, i, o, p: right(w, o, i, p),
        "that is upside down": lambda w, i, o, p: 1 / right(w, i, o, p),
        "the outside must be taken from the denominator, too": lambda w, i, o, p: (w**p - o**p) / i**p,
        "the outside must be taken from the numerator, too": lambda w, i, o, p: w**p / (i**p - o**p),
        "the differences are raised to the power, not the scores": lambda w, i, o, p: (w - o) ** p / (i - o) ** p,
        "the weight itself needs no root": lambda w, i, o, p: right(w, i, o, p) ** (1 / p),
        "that is per cent; 0 to 1 is wanted": lambda w, i, o, p: 100 * right(w, i, o, p),
    }
    cases = [(0.025, 0.030, 0.015, 2), (0.021, 0.022, 0.014, 1), (0.019, 0.022, 0.013, 2)]
    return check("implied weight", attempt, right, cases, mistakes)
