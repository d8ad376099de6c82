"""Few steps or many, one sample or the mean of many: what RMSE says, and what it hides.

Paper: Sec. V-B states 1,000 steps and no number of samples. A sample is one possible depth, with edges; the mean of
samples is the better bet by RMSE and a worse depth map. One step from pure noise returns nearly the mean already.
The paper scores one map per frame by its distance to the truth, for which a mean is the best answer. Draws can be asked
more: whether surfaces keep their edges, whether the truth lies among them.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from .. import metrics
from ..data import Sample
from ..evaluation.statistics import bootstrap_mean, format_interval, mean_known, paired_bootstrap
from ..pipeline import Ditr

SETS = ("optical", "geometric")
# steps -> (frames, members drawn for each): many steps are dear, so fewer frames are asked; rows say how many
PLAN = {1: (8, 8), 2: (8, 8), 4: (8, 8), 10: (8, 8), 50: (4, 8), 250: (3, 4), 1000: (2, 2)}
MEASURES = {  # of a frame's members -> what it is called
    "single": "RMSE of a draw",
    "mean": "RMSE of their mean",
    "crps": "CRPS",
    "spread": "spread",
    "flying_single": "flying in a draw",
    "flying_mean": "flying in their mean",
}

JUMP_M, CLEAR_M = 0.04, 0.01  # what is a depth edge, and how far from both surfaces a pixel must hang to fly
SCORES = {  # name -> what it says, and whether less is better
    "mean_mm": ("optical RMSE of the draws' mean, mm", True),
    "single_mm": ("of a single draw, mm", True),
    "crps_mm": ("CRPS, mm", True),
    "flying_mean": ("pixels at depth edges that fly, mean, %", True),
    "flying_single": ("the same of a single draw, %", True),
    "coverage": ("truths between lowest and highest draw, %", False),
}


def draw_frame(ditr: Ditr, sample: Sample, steps: int, count: int = 4, seed: int = 0) -> np.ndarray:
    """Return ``count`` completions of a frame with its true region, (S, H, W) metres, one seed after the other.

    Raises:
        ValueError: for a frame without a region.
    """
    if sample.region is None:
        raise ValueError(f"{sample.name} has no true region: draws are compared where it is known")
    given = (sample.rgb, sample.depth, sample.region)
    return np.stack([ditr(*given, steps=steps, samples=1, seed=seed + k).depth for k in range(count)])


def flying_share(depth: np.ndarray, truth: np.ndarray, region: np.ndarray) -> float | None:
    """Return what share, in per cent, of the region's pixels at depth edges hang between the two surfaces.

    Args:
        depth: (H, W) metres.
        truth: (H, W) metres.
        region: (H, W) bool.

    Returns:
        None for a region without a depth edge of :data:`JUMP_M` within two pixels.
    """
    near, far = (extreme(truth, np.ones((5, 5), np.uint8)) for extreme in (cv2.erode, cv2.dilate))
    edge = (far - near > JUMP_M) & region & (near > 0)
    between = (depth > near + CLEAR_M) & (depth < far - CLEAR_M) & (np.abs(depth - truth) > CLEAR_M)
    return float(100 * between[edge].mean()) if edge.any() else None


def draw_scores(members: np.ndarray, sample: Sample) -> dict[str, float | None]:
    """Return the figures of :data:`SCORES` of draws (S, H, W) of a frame, inside its region."""
    truth, region, mean = sample.depth_gt, sample.region, members.mean(axis=0)
    known = region & (truth > 0)
    covered = (members.min(axis=0) <= truth) & (truth <= members.max(axis=0))
    flying = [flying_share(m, truth, region) for m in members]
    return {
        "mean_mm": 1000 * metrics.rmse(mean, truth, region),
        "single_mm": 1000 * float(np.mean([metrics.rmse(m, truth, region) for m in members])),
        "crps_mm": 1000 * metrics.crps(members, truth, region),
        "flying_mean": flying_share(mean, truth, region),
        "flying_single": None if None in flying else float(np.mean(flying)),
        "coverage": float(100 * covered[known].mean()),
    }


def format_draws(scores: Mapping[int, Sequence[Mapping[str, float | None]]], seconds: Mapping[int, float]) -> str:
    """Return a table of :data:`SCORES`, a column for each number of steps, and which number is best by each score.

    Args:
        scores: steps -> what :func:`draw_scores` returned, frame by frame.
        seconds: steps -> seconds a frame.
    """
    lines = [" " * 45 + "".join(f"{n:6} step{'s' if n > 1 else ' '}" for n in scores) + "  best"]
    lines.append(f"{'seconds a frame':45}" + "".join(f"{seconds[n]:12.2f}" for n in scores))
    for key, (says, less) in SCORES.items():
        means = {n: mean_known([row[key] for row in rows]) for n, rows in scores.items()}
        known = {n: mean for n, mean in means.items() if mean is not None}
        best = (min if less else max)(known, key=known.get) if known else "-"
        cells = "".join(f"{mean:12.1f}" if mean is not None else f"{'-':>12}" for mean in means.values())
        lines.append(f"{says:45}{cells}{best:>6}")
    return "\n".join(lines)


def score_members(members: Sequence[np.ndarray], sample: Sample) -> dict[str, Any]:
    """Score an ensemble of one frame's completions.

    Args:
        members: (H, W) metres each.
        sample: with truth and region.

    Returns:
        ``single``, ``mean``: set -> RMSE in metres, of a single member on average and of the mean of 1, 2, 4, ...
        members (by their number); ``crps``, ``spread``: set -> metres, the latter the root mean square of the pixels'
        standard deviations, as an error is one; ``flying_single``, ``flying_mean``: per cent of
        the region's pixels at depth edges, None without such.
    """
    stack = np.stack(members)
    pixels = metrics.pixel_sets(sample.depth_gt, sample.region, sample.depth)
    counts = [2**k for k in range(len(members).bit_length()) if 2**k <= len(members)]
    out: dict[str, Any] = {"single": {}, "mean": {str(n): {} for n in counts}, "crps": {}, "spread": {}}
    for key in SETS:
        where = pixels[key]
        if where is None or not where.any():
            continue
        each = [metrics.rmse(m, sample.depth_gt, where) for m in members]
        out["single"][key] = float(np.mean(each))
        for n in counts:  # of disjoint groups, so that every member counts once
            groups = [stack[i : i + n].mean(0) for i in range(0, len(members) - n + 1, n)]
            out["mean"][str(n)][key] = float(np.mean([metrics.rmse(g, sample.depth_gt, where) for g in groups]))
        out["crps"][key] = metrics.crps(stack, sample.depth_gt, where)
        out["spread"][key] = float(np.sqrt(stack.var(0, ddof=int(len(members) > 1))[where].mean()))
    singles = [flying_share(m, sample.depth_gt, sample.region) for m in members]
    out["flying_single"] = None if None in singles else float(np.mean(singles))
    out["flying_mean"] = flying_share(stack.mean(0), sample.depth_gt, sample.region)
    return out


def run_plan(
    draw: Callable[[Sample, int, int], np.ndarray],
    samples: Sequence[Sample],
    plan: Mapping[int, tuple[int, int]] = PLAN,
    save: Callable[[dict], None] = lambda rows: None,
) -> dict[str, list[dict[str, Any]]]:
    """Return steps -> one :func:`score_members` result a frame.

    Args:
        draw: (frame, steps, seed) -> one completion (H, W).
        samples: frames, at least as many as the plan asks for.
        plan: see :data:`PLAN`.
        save: called with the rows so far after every number of steps.
    """
    rows: dict[str, list[dict[str, Any]]] = {}
    for steps, (frames, count) in plan.items():
        rows[str(steps)] = [
            score_members([draw(sample, steps, seed) for seed in range(count)], sample) for sample in samples[:frames]
        ]
        save(rows)
    return rows


def against_one(
    rows: Mapping[str, Sequence[Mapping[str, Any]]], steps: str, key: str
) -> dict[str, tuple[float, float, float] | None]:
    """Return what more steps change: measure of :data:`MEASURES` -> (mean, low, high) minus the fewest steps.

    Both sides are of the same frames and the same number of members, which the rows of :data:`PLAN` are not. A single
    draw, CRPS and spread are averages over all members there are, which a number of members does not favour.
    Metres, flying pixels in percentage points; None where no frame has such pixels, or where the pixels that fly in a
    mean are known of other numbers of members only.
    """
    first, more = next(iter(rows.values())), rows[steps]
    count, start = (max(map(int, side[0]["mean"])) for side in (more, first))
    out = {}
    for name in MEASURES:
        if name == "flying_mean" and count != start:
            out[name] = None
            continue
        sides = [[_value(row, name, key, count) for row in side] for side in (more, first[: len(more)])]
        paired = [(a, b) for a, b in zip(*sides, strict=True) if a is not None and b is not None]
        out[name] = paired_bootstrap(*zip(*paired, strict=True)) if paired else None
    return out


def format_steps(rows: Mapping[str, Sequence[Mapping[str, Any]]], key: str = "optical") -> str:
    """Return the table of a pixel set in mm: the fewest steps, then what each number of steps changes on its frames."""
    start, first = next(iter(rows.items()))
    count = max(map(int, first[0]["mean"]))
    names = [name for name in MEASURES if not name.startswith("flying")]
    levels = {n: 1000 * bootstrap_mean([_value(row, n, key, count) for row in first])[0] for n in names}
    lines = [f"{key}, {start} step{'s' * (start != '1')}, {len(first)} frames, {count} draws: "]
    lines[0] += ", ".join(f"{MEASURES[n]} {mm:.1f} mm" for n, mm in levels.items())
    lines.append("minus that, same frames" + "".join(MEASURES[n].rjust(23) for n in names))
    for steps, frames in list(rows.items())[1:]:
        gaps = against_one(rows, steps, key)
        lines.append(
            f"{steps:>5} steps, {len(frames)} frames".ljust(23)
            + "".join(format_interval(gaps[n], 1000).rjust(23) for n in names)
        )
    return "\n".join(lines)


def format_flying(rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the share of flying pixels at the region's depth edges, in %, and what each number of steps changes."""
    start, first = next(iter(rows.items()))
    names = [name for name in MEASURES if name.startswith("flying")]
    levels = [f"{MEASURES[n]} {bootstrap_mean([row[n] for row in first])[0]:.1f} %" for n in names]
    lines = [f"pixels at depth edges, {start} step{'s' * (start != '1')}: " + ", ".join(levels)]
    lines.append("minus that, points     " + "".join(MEASURES[n].rjust(23) for n in names))
    for steps, frames in list(rows.items())[1:]:
        gaps = against_one(rows, steps, "optical")
        lines.append(
            f"{steps:>5} steps, {len(frames)} frames".ljust(23)
            + "".join(format_interval(gaps[n]).rjust(23) for n in names)
        )
    return "\n".join(lines)


def verdicts(rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Say whether more steps buy what they promise: less CRPS, fewer flying pixels, draws that differ as they err.

    Of the numbers of steps that saw all frames, the largest is set beside the smallest.
    """
    start, first = next(iter(rows.items()))
    steps = [s for s, frames in rows.items() if len(frames) == len(first)][-1]
    key = "optical"
    gaps, count = against_one(rows, steps, key), max(map(int, rows[steps][0]["mean"]))
    lines = [f"{steps} steps against {start}, {key}, {len(first)} frames:"]
    for name, says in MEASURES.items():
        gap = gaps[name]
        if name == "spread" or gap is None:
            continue
        said = "worse" if gap[1] > 0 else "better" if gap[2] < 0 else "no measurable difference"
        unit, factor = ("points", 1) if name.startswith("flying") else ("mm", 1000)
        lines.append(f"  {says:22} {said} ({format_interval(gap, factor)} {unit})")
    spread, error = (
        1000 * bootstrap_mean([_value(r, n, key, count) for r in rows[steps]])[0] for n in ("spread", "mean")
    )
    ratio = error / spread / np.sqrt(1 + 1 / count)  # the mean of honest draws errs more than one of them spreads
    fits = "about right" if 0.8 < ratio < 1.25 else "too small" if ratio > 1 else "too large"
    lines.append(f"  spread of the draws    {spread:.1f} mm, error of their mean {error:.1f} mm: the spread is {fits}")
    return "\n".join(lines)


def _value(row: Mapping[str, Any], name: str, key: str, count: int) -> float | None:
    """Return one measure of one frame; ``mean`` is that of ``count`` members."""
    if name.startswith("flying"):
        return row[name]
    return (row["mean"][str(count)] if name == "mean" else row[name]).get(key)
