"""What a fair ablation needs: the same scenes on both sides, an interval, and more than one training seed.

Paper: Sec. V-D and Table IV compare single runs by their means, in which the luck of the scenes and of the training is
not told apart from the effect. Below stand the paired interval over scenes, the seeds, and words for both.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


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
    rng, means = np.random.default_rng(seed), []
    for values in (a, b):
        mean, _, _ = bootstrap_mean(values, n=1)  # refuses what cannot be averaged
        values = np.asarray(values, np.float64)
        means.append((mean, values[rng.integers(0, len(values), (n, len(values)))].mean(axis=1)))
    low, high = np.percentile(means[0][1] - means[1][1], [2.5, 97.5])
    return means[0][0] - means[1][0], float(low), float(high)


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
    kept = np.array([v for v in values if v is not None], dtype=np.float64)
    if kept.ndim != 1 or kept.size == 0 or not np.isfinite(kept).all() or n < 1:
        raise ValueError(f"expected finite numbers, one per image, and n >= 1; got {kept.size} numbers, n = {n}")
    picks = np.random.default_rng(seed).integers(0, kept.size, size=(n, kept.size))
    low, high = np.percentile(kept[picks].mean(axis=1), [2.5, 97.5])
    return float(kept.mean()), float(low), float(high)


def paired_bootstrap(
    a: Sequence[float | None], b: Sequence[float | None], n: int = 2000, seed: int = 0
) -> tuple[float, float, float]:
    """Return (mean of a - b, low, high), 95 %, resampling images and keeping each image's two scores together.

    Args:
        a: one score per image of the first method; None leaves the image out for both.
        b: the same images' scores of the second method.
        n: resamples.
        seed: of the resampling.

    Raises:
        ValueError: for lists of different length or without a common image.
    """
    if len(a) != len(b):
        raise ValueError(f"a and b should score the same images, got {len(a)} and {len(b)} values")
    return bootstrap_mean([None if x is None or y is None else x - y for x, y in zip(a, b, strict=True)], n, seed)


def ratio_bootstrap(
    a: Sequence[float | None], b: Sequence[float | None], n: int = 2000, seed: int = 0
) -> tuple[float, float, float]:
    """Return (mean of a / mean of b, low, high), 95 %, resampling images and keeping each image's two scores together.

    Raises:
        ValueError: for lists of different length, without a common image, a mean of 0 in ``b``, or n below 1.
    """
    if len(a) != len(b):
        raise ValueError(f"a and b should score the same images, got {len(a)} and {len(b)} values")
    pairs = np.array([(x, y) for x, y in zip(a, b, strict=True) if x is not None and y is not None], np.float64)
    if not pairs.size or not pairs[:, 1].mean() > 0 or n < 1:
        raise ValueError(f"expected common images, positive scores in b, and n >= 1; got {len(pairs)} images, n = {n}")
    picks = np.random.default_rng(seed).integers(0, len(pairs), size=(n, len(pairs)))
    over, under = pairs[picks].mean(axis=1).T  # (n, images, 2) -> (n, 2)
    low, high = np.percentile(over / under, [2.5, 97.5])
    return float(pairs[:, 0].mean() / pairs[:, 1].mean()), float(low), float(high)


def format_interval(
    interval: Sequence[float] | None, factor: float = 1.0, style: str = "+.1f", missing: str = "-"
) -> str:
    """Return ``mean [low, high]``, each times ``factor`` and in the format ``style``; ``missing`` for None."""
    if interval is None:
        return missing
    mean, low, high = (format(factor * x, style) for x in interval)
    return f"{mean} [{low}, {high}]"
