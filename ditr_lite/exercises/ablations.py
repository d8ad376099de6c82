"""Checkers of the exercises on ablations: pairing, choosing, seeds, rank correlation, overlap, calibration."""

import numpy as np
from scipy.stats import rankdata

from ..evaluation.statistics import compare_seeds, spearman
from ..evaluation.uncertainty import reliability
from ..studies import failures
from .checker import Function, check


def check_paired_mean(attempt: Function) -> bool:
    """Check ``attempt(a, b) -> float``: mean of a - b over the scenes that both could be scored on (error 0: not)."""

    def both(formula):
        return lambda a, b: formula(a[(a > 0) & (b > 0)], b[(a > 0) & (b > 0)])

    right = both(lambda a, b: (a - b).mean())
    rng = np.random.default_rng(1)
    cases = []
    for size in (9, 14):
        b = rng.uniform(0.02, 0.2, size)
        a = b + rng.normal(0.002, 0.006, size)
        a[[1, 4]], b[[4, 6]] = 0, 0
        cases.append((a, b))
    mistakes = {
        "the means are over different scenes: leave out, for both, each scene that either lacks": lambda a, b: (
            a[a > 0].mean() - b[b > 0].mean()
        ),
        "a scene that was not scored counts as no error: leave it out": lambda a, b: (a - b).mean(),
        "a scene that was not scored counts as no difference: leave it out of the number, too": lambda a, b: (
            right(a, b) * ((a > 0) & (b > 0)).mean()
        ),
        "a scene is left out only where both lack it": lambda a, b: (a - b)[(a > 0) | (b > 0)].mean(),
        "only the first method's missing scenes are left out": lambda a, b: (a - b)[a > 0].mean(),
        "only the second method's missing scenes are left out": lambda a, b: (a - b)[b > 0].mean(),
        "that is b - a; a - b is wanted": lambda a, b: -right(a, b),
        "that is the median; the mean is wanted": both(lambda a, b: np.median(a - b)),
        "the sign is lost: average the differences, not their sizes": both(lambda a, b: np.abs(a - b).mean()),
        "that is a share of b; metres are wanted": both(lambda a, b: ((a - b) / b).mean()),
    }
    return check("paired mean", attempt, right, cases, mistakes)


def check_choose(attempt: Function) -> bool:
    """Check ``attempt(val, test) -> float``: the test error to report of several settings (K,), chosen fairly."""

    def right(val, test):
        return test[np.argmin(val)]

    val, test = np.array([0.045, 0.038, 0.039, 0.046]), np.array([0.035, 0.043, 0.037, 0.047])
    mistakes = {
        "that is the lowest test error: the test split has done the choosing": lambda v, t: t.min(),
        "that is the validation error; it is too good, because it was chosen for": lambda v, t: v.min(),
        "that is the setting with the largest validation error": lambda v, t: t[np.argmax(v)],
        "that is the place of the setting; its test error is wanted": lambda v, t: np.argmin(v),
        "the two splits are averaged before choosing: the test split helps to choose": lambda v, t: t[np.argmin(v + t)],
        "that is the mean over settings; one of them is to be reported": lambda v, t: t.mean(),
    }
    return check("choice", attempt, right, [(val, test), (test[::-1].copy(), val)], mistakes)


def check_seeds(attempt: Function) -> bool:
    """Check ``attempt(a, b) -> (difference, noise)`` of errors (S, N): S training seeds by N scenes.

    ``difference``: mean of a - b. ``noise``: the largest difference between the means of two seeds of one variant.
    """

    def right(a, b):
        found = compare_seeds(a, b)
        return found.mean, found.seeds

    def with_noise(noise):
        return lambda a, b: (a.mean() - b.mean(), noise(a, b))

    def span(x):
        return np.ptp(x.mean(axis=1))

    rng = np.random.default_rng(2)
    scenes = rng.uniform(0.02, 0.2, 12)
    a = scenes + rng.normal(0.005, 0.003, (3, 12)) + np.array([[0.004], [0], [-0.003]])
    b = scenes + rng.normal(0, 0.003, (3, 12)) + np.array([[0.001], [0], [-0.001]])
    mistakes = {
        "both variants have seeds: take the larger of the two spans": with_noise(lambda a, b: span(a)),
        "both variants have seeds: look at the first one's, too": with_noise(lambda a, b: span(b)),
        "the smaller of the two spans hides the noise of the other": with_noise(lambda a, b: min(span(a), span(b))),
        "average over the scenes (axis 1) first: that is the spread between scenes": with_noise(
            lambda a, b: max(np.ptp(a.mean(axis=0)), np.ptp(b.mean(axis=0)))
        ),
        "that is the span of single scenes' errors; the seeds' means are wanted": with_noise(
            lambda a, b: max(np.ptp(a), np.ptp(b))
        ),
        "that is a standard deviation; largest minus smallest is wanted": with_noise(
            lambda a, b: max(a.mean(axis=1).std(), b.mean(axis=1).std())
        ),
        "that is the span of the differences: a lucky seed of either variant is hidden": with_noise(
            lambda a, b: span(a - b)
        ),
        "neighbouring seeds are compared: take the largest difference of any two": with_noise(
            lambda a, b: max(np.abs(np.diff(x.mean(axis=1))).max() for x in (a, b))
        ),
        "the first seed is compared with the last: take the largest difference of any two": with_noise(
            lambda a, b: max(np.abs(x[0].mean() - x[-1].mean()) for x in (a, b))
        ),
        "seeds of both variants are mixed: compare seeds of the same variant": with_noise(
            lambda a, b: span(np.concatenate([a, b]))
        ),
        "that is b - a; a - b is wanted": lambda a, b: (-right(a, b)[0], right(a, b)[1]),
        "the best seed of each is compared: average over all": lambda a, b: (
            a.mean(axis=1).min() - b.mean(axis=1).min(),
            right(a, b)[1],
        ),
    }
    return check("seeds", attempt, right, [(a, b), (b + 0.002, a[[1, 0, 2]])], mistakes)


def check_spearman(attempt: Function) -> bool:
    """Check ``attempt(x, y) -> float``: Spearman's rank correlation, equal values sharing their mean rank."""

    def pearson(x, y):
        return np.corrcoef(x, y)[0, 1]

    rng = np.random.default_rng(3)
    x = rng.integers(0, 5, 12).astype(float)
    y = x**3 + rng.integers(0, 40, 12)
    mistakes = {
        "that is Pearson's correlation of the values; take their ranks": pearson,
        "argsort says where each rank stands, not which rank each value has: apply it twice": lambda x, y: pearson(
            np.argsort(x, kind="stable"), np.argsort(y, kind="stable")
        ),
        "equal values get different ranks: let them share the mean rank": lambda x, y: pearson(
            *(np.argsort(np.argsort(v, kind="stable"), kind="stable") for v in (x, y))
        ),
        "equal values get the lowest of their ranks: let them share the mean rank": lambda x, y: pearson(
            *(rankdata(v, "min") for v in (x, y))
        ),
        "the short formula with squared differences holds only without equal values": lambda x, y: (
            1 - 6 * ((rankdata(x) - rankdata(y)) ** 2).sum() / (len(x) ** 3 - len(x))
        ),
        "the sign is the wrong way round": lambda x, y: -spearman(x, y),
        "that is its square; the correlation has a sign": lambda x, y: spearman(x, y) ** 2,
    }
    return check("rank correlation", attempt, spearman, [(x, y), (y, -x)], mistakes)


def check_overlap(attempt: Function) -> bool:
    """Check ``attempt(instances, region) -> float``: the share of the region's outline that borders another object."""

    def pairs(count, directions=2, outline=None):
        """Return a wrong overlap: ``count`` and ``outline`` say which pairs of pixels count."""

        def wrong(ids, region):
            both = all_pairs = 0
            for one, other in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:]))[:directions]:
                near = ids[one], ids[other], region[one], region[other]
                apart = (near[0] != near[1]) & (near[2] | near[3])
                all_pairs += (apart if outline is None else outline(*near)).sum()
                both += (apart & count(*near)).sum()
            return both / all_pairs

        return wrong

    def objects(i, j, r, s):
        return (i > 0) & (j > 0)

    ids = np.zeros((9, 12), int)
    ids[2:6, 2:6], ids[3:8, 6:9], ids[6:8, 3:5], ids[0:2, 10:] = 1, 2, 3, 4
    region = np.isin(ids, (1, 2))
    mistakes = {
        "only pairs of two glass or metal objects count; an opaque neighbour overlaps, too": pairs(
            lambda i, j, r, s: r & s
        ),
        "only pairs above each other are counted; look sideways, too": pairs(objects, directions=1),
        "that is 1 in every frame: outline is where at least one side is in the region, shared is where neither is 0": (
            pairs(lambda i, j, r, s: i != j)
        ),
        "outlines of opaque objects count: at least one side must be in the region": pairs(
            objects, outline=lambda i, j, r, s: i != j
        ),
        "that is the share of all neighbouring pairs; only those that differ are outline": pairs(
            objects, outline=lambda i, j, r, s: r | s
        ),
        "that is shared over unshared outline; shared over all is wanted": lambda i, r: (
            failures.overlap(i, r) / (1 - failures.overlap(i, r))
        ),
        "that is the share that borders the background": lambda i, r: 1 - failures.overlap(i, r),
    }
    turned = (np.ascontiguousarray(ids.T), np.ascontiguousarray(region.T))
    return check("overlap", attempt, failures.overlap, [(ids, region), turned], mistakes)


def check_reliability(attempt: Function) -> bool:
    """Check ``attempt(spread, error, bins) -> (2, bins)``: RMS spread and RMS error of bins of equal count.

    Pixels are sorted by spread, smallest first, and cut into ``bins`` of equal size.
    """

    def binned(sort, mean_spread, mean_error):
        def curve(spread, error, bins):
            order = sort(spread, error)
            parts = [v[order].reshape(bins, -1) for v in (spread, error)]
            return np.stack([mean_spread(parts[0]), mean_error(parts[1])])

        return curve

    def rms(x):
        return np.sqrt((x**2).mean(axis=1))

    def by_spread(s, e):
        return np.argsort(s, kind="stable")

    right = reliability
    rng = np.random.default_rng(4)
    spread = rng.uniform(0.002, 0.03, 60)
    case = (spread, rng.normal(0, 1.5 * spread), 6)
    mistakes = {
        "sort by the spread, not by the error: who looks at the error finds it calibrated": binned(
            lambda s, e: np.argsort(np.abs(e)), rms, rms
        ),
        "spread and error are sorted apart: a pixel's two values belong together": lambda s, e, b: np.stack(
            [rms(np.sort(v).reshape(b, -1)) for v in (s, np.abs(e))]
        ),
        "the bins are not sorted": binned(lambda s, e: np.arange(len(s)), rms, rms),
        "the largest spread comes first; the smallest is wanted": lambda s, e, b: right(s, e, b)[:, ::-1],
        "errors of both signs cancel in a mean: take the root of the mean square": binned(
            by_spread, rms, lambda x: x.mean(axis=1)
        ),
        "a spread is a standard deviation: compare it with the root mean square error, not the mean absolute": binned(
            by_spread, rms, lambda x: np.abs(x).mean(axis=1)
        ),
        "the mean of the spreads is not their root mean square: average the variances": binned(
            by_spread, lambda x: x.mean(axis=1), rms
        ),
        "the root is missing: those are variances": lambda s, e, b: right(s, e, b) ** 2,
        "error and spread are exchanged: the spread comes first": lambda s, e, b: right(s, e, b)[::-1],
    }
    return check("reliability", attempt, right, [case, (*case[:2], 4)], mistakes)
