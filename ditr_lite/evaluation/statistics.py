"""Intervals over images, paired differences, rank correlation, and what a fair ablation needs beside them: seeds.

Paper: Sec. V-D and Table IV compare single runs by their means, in which the luck of the scenes and of the training is
not told apart from the effect. Below stand the paired interval over scenes, the seeds, and words for both. All
intervals are percentile bootstraps (``scipy.stats.bootstrap``) at 95 %.

That is their name. Of a hundred scenes they hold the true mean a little less often, and clearly less often where a few
scenes have huge errors, as in rooms, or of eight scenes. Of three scenes an interval is their range, and holds the true
mean in three cases of four at best.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy import stats


class SeedComparison(NamedTuple):
    """How two variants differ that were each trained more than once.

    Attributes:
        mean: error of the first minus that of the second, over seeds and scenes.
        low, high: 95 % interval over scenes, paired: what other scenes could change.
        seeds: largest difference between the means of two seeds of one variant: what another training could change.
    """

    mean: float
    low: float
    high: float
    seeds: float

    @property
    def clear(self) -> bool:
        """Whether the interval excludes 0 and the difference exceeds that between seeds."""
        return not self.low <= 0 <= self.high and abs(self.mean) > self.seeds


def compare_seeds(a: Sequence[Sequence[float]], b: Sequence[Sequence[float]]) -> SeedComparison:
    """Compare two variants by the scenes' errors under every training seed.

    Args:
        a: (S, N) errors of the first variant, S training seeds by N scenes.
        b: (R, N) errors of the second on the same scenes; R may differ from S.

    Raises:
        ValueError: for arrays that are not seeds by scenes, or different scenes.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1] or 0 in (*a.shape, *b.shape):
        raise ValueError(f"expected errors (seeds, scenes) on the same scenes, got {a.shape} and {b.shape}")
    between = max(float(np.ptp(errors.mean(axis=1))) for errors in (a, b))
    return SeedComparison(*paired_bootstrap(list(a.mean(axis=0)), list(b.mean(axis=0))), between)


def unpaired_bootstrap(
    a: Sequence[float], b: Sequence[float], n: int = 2000, seed: int = 0
) -> tuple[float, float, float]:
    """Return (mean of a - mean of b, low, high), 95 %, resampling the two lists apart, as if of different scenes.

    Shown beside :func:`paired_bootstrap` to see what pairing is worth; use that one.

    Raises:
        ValueError: for an empty list.
    """
    a, b = _finite(a, n), _finite(b, n)
    return _bootstrap((a, b), lambda x, y, axis: x.mean(axis=axis) - y.mean(axis=axis), n, seed, paired=False)


def verdict(name: str, minus_m: Sequence[float] | None, other: str = "the default") -> str:
    """Return in words what an interval of a difference of errors in metres says.

    Args:
        name: what was measured.
        minus_m: (mean, low, high) of its error minus that of ``other``; None where there is none.
        other: what it was compared with.
    """
    if minus_m is None:
        return f"{name}: nothing to compare"
    mean, low, high = (1000 * x for x in minus_m)
    said = "a larger error than" if low > 0 else "a smaller error than" if high < 0 else "no measurable difference from"
    return f"{name}: {said} {other} ({mean:+.1f} mm [{low:+.1f}, {high:+.1f}])"


def sort_by_verdict(minus_m: Mapping[str, Sequence[float] | None]) -> dict[str, list[str]]:
    """Return which names have a lower error, which a higher one, and where the interval of the difference holds 0.

    Args:
        minus_m: name -> (mean, low, high) of the error minus that of what it is compared with; None is left out.
    """
    found: dict[str, list[str]] = {"lower": [], "higher": [], "not decided": []}
    for name, interval in minus_m.items():
        if interval is None:
            continue
        _, low, high = interval
        side = "lower" if high < 0 else "higher" if low > 0 else "not decided"
        found[side].append(name)
    return found


def seed_verdict(name: str, a: Sequence[Sequence[float]], b: Sequence[Sequence[float]], other: str) -> str:
    """Return :func:`verdict` of two variants that were trained more than once, and whether it beats the seeds.

    Args:
        name: of the first.
        a: its errors (S, N) in metres, see :func:`compare_seeds`.
        b: those of the second.
        other: its name.
    """
    gain = compare_seeds(a, b)
    said = "clear" if gain.clear else "not clear"
    return f"{verdict(name, gain[:3], other)}; seeds {1000 * gain.seeds:.1f} mm apart: {said}"


def bootstrap_mean(values: Sequence[float | None], n: int = 2000, seed: int = 0) -> tuple[float, float, float]:
    """Return (mean, low, high): the mean and its 95 % percentile-bootstrap interval over images.

    Args:
        values: one number per image; None (no such pixels) is left out.
        n: resamples.
        seed: of the resampling.

    Raises:
        ValueError: when no finite value is left.
    """
    return _bootstrap((_finite(values, n),), np.mean, n, seed)


def paired_bootstrap(
    a: Sequence[float | None], b: Sequence[float | None], n: int = 2000, seed: int = 0, among: int = 1
) -> tuple[float, float, float]:
    """Return (mean of a - b, low, high), 95 %, resampling images and keeping each image's two scores together.

    Args:
        a: one score per image of the first method; None leaves the image out for both.
        b: the same images' scores of the second method.
        n: resamples, for each of the comparisons.
        seed: of the resampling.
        among: comparisons that are looked at together, or of which one was picked by its result: 95 % are then those
            of all intervals together (Bonferroni), and each is wider.

    Raises:
        ValueError: for lists of different length or without a common image.
    """
    first, second = _common(a, b)
    return _bootstrap((_finite(first - second, n),), np.mean, n * among, seed, among=among)


def ratio_bootstrap(
    a: Sequence[float | None], b: Sequence[float | None], n: int = 2000, seed: int = 0
) -> tuple[float, float, float]:
    """Return (mean of a / mean of b, low, high), 95 %, resampling images and keeping each image's two scores together.

    Raises:
        ValueError: for lists of different length, without a common image, a mean of 0 in ``b``, or n below 1.
    """
    over, under = _common(a, b)
    if not over.size or not under.mean() > 0 or n < 1:
        raise ValueError(f"expected common images, positive scores in b, and n >= 1; got {over.size} images, n = {n}")
    return _bootstrap((over, under), lambda x, y, axis: x.mean(axis=axis) / y.mean(axis=axis), n, seed)


def spearman(x: Sequence[float], y: Sequence[float]) -> float:
    """Return Spearman's rank correlation, -1 to 1: Pearson's of the ranks, equal values sharing their mean rank.

    Raises:
        ValueError: for fewer than two pairs, or for values that are all alike.
    """
    x, y = (np.asarray(values, np.float64) for values in (x, y))
    if x.shape != y.shape or x.size < 2 or np.ptp(x) == 0 or np.ptp(y) == 0:
        raise ValueError(f"expected two lists of at least 2 numbers that are not all alike, got {x.shape}, {y.shape}")
    return float(stats.spearmanr(x, y).statistic)


def spearman_bootstrap(
    x: Sequence[float | None],
    y: Sequence[float | None],
    n: int = 2000,
    seed: int = 0,
    held: Sequence[float | None] | None = None,
) -> tuple[float, float, float]:
    """Return (rho, low, high): Spearman's correlation and its 95 % percentile-bootstrap interval over images.

    Args:
        x: one value an image; None leaves the image out.
        y: likewise.
        n: resamples; those in which all values are alike have no correlation and are left out.
        seed: of the resampling.
        held: a third value an image that is held fixed: rho is then the partial correlation of the ranks, what is left
            of it once a straight line in the ranks of ``held`` is taken off both.

    Raises:
        ValueError: for lists of different lengths, and as :func:`spearman`, of each two of the lists.
    """
    columns = _common(*(values for values in (x, y, held) if values is not None))
    for pair in combinations(columns, 2):
        spearman(*pair)  # refuses what has no correlation

    def correlation(*drawn: np.ndarray, axis: int) -> np.ndarray:
        ranks = [stats.rankdata(values, axis=axis) for values in drawn]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", stats.ConstantInputWarning)
            rho, *other = (stats.pearsonr(*pair, axis=axis).statistic for pair in combinations(ranks, 2))
        if not other:
            return rho
        with np.errstate(divide="ignore", invalid="ignore"):  # a resample in which two of them rise together
            return (rho - other[0] * other[1]) / np.sqrt((1 - other[0] ** 2) * (1 - other[1] ** 2))

    return _bootstrap(columns, correlation, n, seed)


def interval(estimate: Callable, *columns: Sequence[float | None], digits: int | None = None) -> list[float] | None:
    """Return [estimate, low, high] for a results file; None where no image has all the scores.

    Args:
        estimate: one of the bootstraps above.
        columns: what it takes, one score per image and column.
        digits: round to so many decimals; None keeps them all.

    Raises:
        ValueError: as ``estimate`` does.
    """
    complete = [row for row in zip(*columns, strict=True) if None not in row]
    if not complete:
        return None
    return [value if digits is None else round(value, digits) for value in estimate(*columns)]


def mean_known(values: Sequence[float | None]) -> float | None:
    """Return the mean of the scores that are not None; None where all are."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def format_interval(
    interval: Sequence[float] | None, factor: float = 1.0, style: str = "+.1f", missing: str = "-"
) -> str:
    """Return ``mean [low, high]``, each times ``factor`` and in the format ``style``; ``missing`` for None."""
    if interval is None:
        return missing
    mean, low, high = (format(factor * x, style) for x in interval)
    return f"{mean} [{low}, {high}]"


def _finite(values: Sequence[float | None], n: int) -> np.ndarray:
    kept = np.array([v for v in values if v is not None], dtype=np.float64)
    if kept.ndim != 1 or kept.size == 0 or not np.isfinite(kept).all() or n < 1:
        raise ValueError(f"expected finite numbers, one per image, and n >= 1; got {kept.size} numbers, n = {n}")
    return kept


def _common(*columns: Sequence[float | None]) -> tuple[np.ndarray, ...]:
    """Return the scores of the images that have all of them."""
    counts = [len(column) for column in columns]
    if len(set(counts)) > 1:
        raise ValueError(f"all should score the same images, got {' and '.join(map(str, counts))} values")
    complete = [row for row in zip(*columns, strict=True) if None not in row]
    return tuple(np.array(complete, np.float64).reshape(-1, len(columns)).T)


def _bootstrap(
    data: tuple[np.ndarray, ...], statistic: Callable, n: int, seed: int, paired: bool = True, among: int = 1
) -> tuple[float, float, float]:
    """Return (statistic, low, high), with 2.5 % / ``among`` of the resamples (that have a value) on either side."""
    found = float(statistic(*data, axis=0))
    if min(len(column) for column in data) < 2:  # nothing to resample
        return found, found, found
    paired = paired and len(data) > 1
    how = {"n_resamples": n, "paired": paired, "method": "percentile", "vectorized": True}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        drawn = stats.bootstrap(data, statistic, rng=np.random.default_rng(seed), **how).bootstrap_distribution
    low, high = np.nanpercentile(drawn, [2.5 / among, 100 - 2.5 / among])
    return found, float(low), float(high)
