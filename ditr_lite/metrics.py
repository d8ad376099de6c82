"""Scores of one frame: RMSE, MAE, REL, delta and CRPS, and where they are taken; masks; averages of many frames.

Depth is in metres. Ground truth of 0 means unknown and is never scored. Shares are in per cent, REL is a plain ratio.
The printed formulas (Paper: Sec. III, Eq. 4-6) divide by H x W; like the paper's experiments, and everybody else's,
these divide by the number of pixels that have ground truth. :func:`expected_error` is what to state without any.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from .config import StdConfig
from .units import check_depth, check_mask

SETS = ("whole", "optical", "optical_valid", "geometric", "outside")
METRICS = ("rmse", "mae", "rel", "d105", "d110", "d125")
Scores = dict[str, float]  # one entry per METRICS, plus "n", the number of pixels

__all__ = [
    "METRICS",
    "SETS",
    "Scores",
    "area_ratio",
    "average",
    "crps",
    "delta",
    "evaluate",
    "expected_error",
    "format_table",
    "iou",
    "mae",
    "miss_rate",
    "pixel_sets",
    "rel",
    "rmse",
]


def rmse(pred: np.ndarray, gt: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the root mean square error in metres.

    Paper: Sec. III, Eq. 4.

    Args:
        pred: (...) metres, positive everywhere.
        gt: (...) metres, 0 = unknown, not scored.
        mask: (...) bool, the pixels to score; None for all.

    Returns:
        Metres, over the pixels with ground truth inside the mask.

    Raises:
        ValueError: for shapes that differ, a prediction with holes, or no pixel to score.
    """
    p, g = _scored(pred, gt, mask)
    return float(np.sqrt(np.mean((p - g) ** 2)))


def mae(pred: np.ndarray, gt: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean absolute error in metres; arguments and errors as in :func:`rmse`.

    Paper: Sec. III, Eq. 5.
    """
    p, g = _scored(pred, gt, mask)
    return float(np.mean(np.abs(p - g)))


def rel(pred: np.ndarray, gt: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean of |error| / ground truth, a ratio; arguments and errors as in :func:`rmse`.

    Paper: Sec. III, Eq. 6.
    """
    p, g = _scored(pred, gt, mask)
    return float(np.mean(np.abs(p - g) / g))


def delta(pred: np.ndarray, gt: np.ndarray, threshold: float = 1.05, mask: np.ndarray | None = None) -> float:
    """Return the share of pixels, in per cent, with ``max(pred / gt, gt / pred) < threshold``.

    Paper: Sec. V-B words it as "relative loss less than n %", which is |pred - gt| / gt < n %. This is the field's
    definition, strict as in ClearGrasp's code; it is the only one that the paper's own tables do not contradict.

    Args:
        pred: (...) metres, positive everywhere.
        gt: (...) metres, 0 = unknown, not scored.
        threshold: above 1, e.g. 1.05, 1.10 or 1.25.
        mask: (...) bool, the pixels to score; None for all.

    Raises:
        ValueError: as :func:`rmse`, and for a threshold that is not above 1.
    """
    if not threshold > 1:
        raise ValueError(f"threshold should be a ratio above 1 such as 1.05, got {threshold}; 5 per cent is 1.05")
    p, g = _scored(pred, gt, mask)
    return float(100.0 * np.mean(np.maximum(p / g, g / p) < threshold))


def crps(ensemble: np.ndarray, gt: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the continuous ranked probability score of an ensemble, in metres, averaged over pixels.

    Per pixel, with members x_i and truth y: mean_i |x_i - y| - sum_{i<j} |x_i - x_j| / (S (S - 1)). Dividing by
    S (S - 1) rather than S^2 makes it fair: its expectation does not depend on S, so ensembles of different size
    compare. It rewards spread that is honest, which RMSE punishes. A single member scores its MAE.

    Args:
        ensemble: (S, ...) metres, positive everywhere.
        gt: (...) metres, 0 = unknown, not scored.
        mask: (...) bool, the pixels to score; None for all.

    Raises:
        ValueError: for shapes that do not fit, members with holes, or no pixel to score.
    """
    ensemble, gt = np.asarray(ensemble), np.asarray(gt)
    if ensemble.ndim != gt.ndim + 1 or len(ensemble) == 0:
        raise ValueError(f"ensemble should be (S, *{gt.shape}) with S >= 1, got {ensemble.shape}; stack along axis 0")
    pairs = [_scored(member, gt, mask) for member in ensemble]
    members, truth = np.sort([p for p, _ in pairs], axis=0), pairs[0][1]  # (S, N), (N,)
    size = len(members)
    error = np.abs(members - truth).mean(axis=0)
    # over sorted members the sum of all pairwise distances is a weighted sum: rank k counts 2k - (S - 1) times
    weights = 2 * np.arange(size) - (size - 1)
    spread = weights @ members / max(size * (size - 1), 1)
    return float(np.mean(error - spread))


def pixel_sets(
    gt: np.ndarray, region: np.ndarray | None = None, raw: np.ndarray | None = None
) -> dict[str, np.ndarray | None]:
    """Return the pixels of each of SETS as (H, W) bool masks, None where the input that they need is not given.

    whole: everywhere; optical: inside the region; optical_valid: inside it and raw > 0; geometric: outside it and
    raw = 0, what a completion has to fill; outside: everything outside the region. All have ground truth.
    """
    known = np.asarray(gt) > 0
    sets: dict[str, np.ndarray | None] = dict.fromkeys(SETS)
    sets["whole"] = known
    if region is not None:
        sets |= {"optical": known & region, "outside": known & ~region}
        if raw is not None:
            sets |= {"optical_valid": known & region & (raw > 0), "geometric": known & ~region & (raw == 0)}
    return sets


def evaluate(
    pred: np.ndarray, gt: np.ndarray, region: np.ndarray | None = None, raw: np.ndarray | None = None
) -> dict[str, Scores | None]:
    """Score a dense depth map on every pixel set.

    Paper: Sec. V-B (metrics), Table V (breakdown by kind of loss).

    Args:
        pred: (H, W) metres, positive everywhere.
        gt: (H, W) metres, 0 = unknown.
        region: (H, W) bool, the true transparent or reflective region.
        raw: (H, W) metres, the raw sensor, 0 = missing.

    Returns:
        {"whole": {"rmse", "mae", "rel", "d105", "d110", "d125", "n"}, "optical": ..., "optical_valid": ...,
        "geometric": ..., "outside": ...}: metres, per cent for d*, n pixels. None where a set is empty or its input
        was not given.

    Raises:
        ValueError: for arrays that are not (H, W) or differ in shape, a region that is not bool, a prediction that
            is not positive and finite everywhere, a ground truth or raw depth that is negative or not finite.
    """
    gt = check_depth("gt", gt)
    pred = _dense(pred, gt.shape)
    if region is not None:
        region = check_mask("region", region, gt.shape)
    if raw is not None:
        raw = check_depth("raw", raw, gt.shape)
    return {name: _score(pred, gt, mask) for name, mask in pixel_sets(gt, region, raw).items()}


def iou(pred: np.ndarray, true: np.ndarray) -> float | None:
    """Return intersection over union of two bool masks, in 0 to 1; None where both are empty."""
    pred, true = _masks(pred, true)
    return _ratio((pred & true).sum(), (pred | true).sum())


def miss_rate(pred: np.ndarray, true: np.ndarray) -> float | None:
    """Return the share, 0 to 1, of the true mask that the predicted one leaves out; None where the true one is empty.

    What refinement is for: a missed pixel keeps its wrong depth, a pixel too many is only estimated once more.
    """
    pred, true = _masks(pred, true)
    return _ratio((true & ~pred).sum(), true.sum())


def area_ratio(pred: np.ndarray, true: np.ndarray) -> float | None:
    """Return predicted area over true area: the price of a low miss rate; None where the true mask is empty."""
    pred, true = _masks(pred, true)
    return _ratio(pred.sum(), true.sum())


def _score(pred: np.ndarray, gt: np.ndarray, mask: np.ndarray | None) -> Scores | None:
    if mask is None or not mask.any():
        return None
    pred, gt = pred[mask], gt[mask]
    scores = {"rmse": rmse(pred, gt), "mae": mae(pred, gt), "rel": rel(pred, gt)}
    scores |= {f"d{round(100 * t)}": delta(pred, gt, t) for t in (1.05, 1.10, 1.25)}
    return scores | {"n": int(mask.sum())}


def _scored(pred: np.ndarray, gt: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return float64 (N,) predictions and truths of the pixels that count."""
    gt = np.asarray(gt)
    pred = _dense(pred, gt.shape)
    if not (np.isfinite(gt) & (gt >= 0)).all():
        raise ValueError("gt has negative or non-finite values; call units.clean_depth first (0 means unknown)")
    chosen = gt > 0 if mask is None else (gt > 0) & check_mask("mask", mask, gt.shape)
    if not chosen.any():
        raise ValueError("no pixel to score: the ground truth is 0 (unknown) everywhere in the mask")
    return pred[chosen].astype(np.float64), gt[chosen].astype(np.float64)


def _dense(pred: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    pred = np.asarray(pred)
    if pred.shape != shape or not np.issubdtype(pred.dtype, np.floating):
        raise ValueError(
            f"pred should be floating-point metres {shape} like gt, got {pred.dtype} {pred.shape}; resize it"
        )
    bad = int((~(np.isfinite(pred) & (pred > 0))).sum())
    if bad:
        raise ValueError(
            f"pred should be dense: {bad} of {pred.size} pixels are zero, negative or not finite; "
            "fill them first, e.g. with a function from baselines.REGISTRY"
        )
    return pred


def _masks(pred: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    true = check_mask("true", true, np.shape(true))
    return check_mask("pred", pred, true.shape), true


def _ratio(part: int, whole: int) -> float | None:
    return float(part / whole) if whole else None


def average(results: Sequence[Mapping[str, Scores | None]]) -> dict[str, dict | None]:
    """Return the mean over images of what :func:`metrics.evaluate` gave for each, with the pooled value beside it.

    The mean leaves out images without such pixels. "pooled" is the score of all pixels of all images thrown together:
    it weighs an image by its pixels, and pooled RMSE averages squares before the root. Mixing the two within one table
    can put RMSE below MAE, which neither kind of average alone can do (as happens in the paper's Tables I and II).

    Returns:
        One entry per set: {each metric: mean over images, "n": pixels, "images": images with such pixels,
        "pooled": {each metric: pooled value}}, or None where no image has such pixels.

    Raises:
        ValueError: for an empty list.
    """
    if not results:
        raise ValueError("nothing to average: give the list of evaluate(...) results, one per image")
    return {name: _average([r[name] for r in results if r[name] is not None]) for name in SETS}


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


def expected_error(
    spread: np.ndarray,
    depth: np.ndarray,
    kept: np.ndarray,
    region: np.ndarray,
    doubt: np.ndarray,
    config: StdConfig,
) -> np.ndarray:
    """Return the error to expect: the spread of samples, scaled, and what no spread shows.

    Samples of one denoiser agree where it has learnt to be wrong: their spread alone understates the error. Per branch
    sqrt((base * depth)^2 + (factor * spread)^2). A reading that was kept is as good as the sensor, unless stage one
    has missed glass: sqrt((kept * depth)^2 + p (missed * depth)^2), p being its probability of glass. The constants
    are fitted on validation scenes by ``tools/calibrate.py``.

    Args:
        spread: (H, W) metres, standard deviation over samples; 0 of a single one.
        depth: (H, W) metres, their mean.
        kept: (H, W) bool, pixels that were not painted.
        region: (H, W) bool, painted by the optical branch.
        doubt: (H, W) in [0, 1], stage one's probability of glass; 0 where the region was given.
        config: the constants.

    Returns:
        (H, W) float32 metres.
    """
    share = np.where(region, *config.base)
    times = np.where(region, *config.factor)
    painted = np.hypot(share * depth, times * spread)
    left = depth * np.sqrt(config.kept**2 + doubt * config.missed**2)
    return np.where(kept, left, painted).astype(np.float32)
