"""Many frames: how scores are averaged, how sure one can be of the mean, and the table that shows them.

Everything here is also found in ``metrics``, where the scores of one frame are taken.
"""

from collections.abc import Mapping, Sequence

import numpy as np

SETS = ("whole", "optical", "optical_valid", "geometric", "outside")
METRICS = ("rmse", "mae", "rel", "d105", "d110", "d125")
Scores = dict[str, float]  # one entry per METRICS, plus "n", the number of pixels


def average(results: Sequence[Mapping[str, Scores | None]]) -> dict[str, dict | None]:
    """Return the mean over images of what :func:`metrics.evaluate` gave for each, with the pooled value beside it.

    The mean leaves out images without such pixels. "pooled" is the score of all pixels of all images thrown together:
    it weighs an image by its pixels, and pooled RMSE averages squares before the root. Mixing the two within one table
    can put RMSE below MAE, which neither kind of average alone can do (as happens in the paper's Table V).

    Returns:
        One entry per set: {each metric: mean over images, "n": pixels, "images": images with such pixels,
        "pooled": {each metric: pooled value}}, or None where no image has such pixels.

    Raises:
        ValueError: for an empty list.
    """
    if not results:
        raise ValueError("nothing to average: give the list of evaluate(...) results, one per image")
    return {name: _average([r[name] for r in results if r[name] is not None]) for name in SETS}


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


def format_table(rows: Mapping[str, Mapping[str, Scores | None]], sets: Sequence[str] = SETS) -> str:
    """Return a plain-text table, one block per pixel set and one line per method; RMSE and MAE in millimetres.

    Args:
        rows: method name -> what :func:`metrics.evaluate` or :func:`average` returned.
        sets: the pixel sets to show, in order.
    """
    if not rows:
        raise ValueError("nothing to show: give a mapping from method name to evaluate(...) or average(...) result")
    width = max(len(name) for name in [*rows, "method"])
    header = "method".ljust(width) + "".join(title.rjust(9) for title, _, _ in _COLUMNS.values())
    lines: list[str] = []
    for key in sets:
        pixels = max((row[key]["n"] for row in rows.values() if row.get(key)), default=0)
        lines += [f"{key} ({pixels:,} pixels)", header]
        for name, row in rows.items():
            found = row.get(key) or {}
            cells = (
                f"{scale * found[m]:9.{digits}f}" if found else "-".rjust(9)
                for m, (_, scale, digits) in _COLUMNS.items()
            )
            lines.append(name.ljust(width) + "".join(cells))
        lines.append("")
    return "\n".join(lines)


_COLUMNS = {  # metric: title, factor, decimals
    "rmse": ("RMSE mm", 1000, 1),
    "mae": ("MAE mm", 1000, 1),
    "rel": ("REL", 1, 4),
    "d105": ("d1.05 %", 1, 2),
    "d110": ("d1.10 %", 1, 2),
    "d125": ("d1.25 %", 1, 2),
}


def _average(scores: list[Scores]) -> dict | None:
    if not scores:
        return None
    n = np.array([s["n"] for s in scores], dtype=np.float64)
    columns = {m: np.array([s[m] for s in scores]) for m in METRICS}
    total = max(n.sum(), 1)  # a protocol may count images that have no such pixels
    pooled = {m: float(n @ values / total) for m, values in columns.items()}
    pooled["rmse"] = float(np.sqrt(n @ columns["rmse"] ** 2 / total))
    means = {m: float(values.mean()) for m, values in columns.items()}
    return means | {"n": int(n.sum()), "images": len(scores), "pooled": pooled}
