"""Few steps or many, one sample or the mean of many: what RMSE says, and what it hides.

Paper: Sec. V-B states 1,000 steps and no number of samples. A sample is one possible depth, with edges; the mean of
samples is the better bet by RMSE and a worse depth map. One step from pure noise returns nearly the mean already.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ditr_lite import metrics
from ditr_lite.data import Sample
from ditr_lite.draws import flying_share
from ditr_lite.summaries import bootstrap_mean, paired_bootstrap

SETS = ("optical", "geometric")
# steps -> (frames, members drawn for each): many steps are dear, so fewer frames are asked; rows say how many
PLAN = {1: (8, 8), 2: (8, 8), 4: (8, 8), 10: (8, 8), 50: (4, 8), 250: (3, 4), 1000: (2, 2)}


def score_members(members: Sequence[np.ndarray], sample: Sample) -> dict[str, Any]:
    """Score an ensemble of one frame's completions.

    Args:
        members: (H, W) metres each.
        sample: with truth and region.

    Returns:
        ``single``, ``mean``: set -> RMSE in metres, of a single member on average and of the mean of 1, 2, 4, ...
        members (by their number); ``crps``, ``spread``: set -> metres; ``flying_single``, ``flying_mean``: per cent of
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
        out["spread"][key] = float(stack.std(0, ddof=int(len(members) > 1))[where].mean())
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


def format_steps(rows: Mapping[str, Sequence[Mapping[str, Any]]], key: str = "optical") -> str:
    """Return the table of a pixel set: a row for each number of steps, millimetres and percent.

    The last column pairs frames: RMSE of a single member minus that of one-step members, of the frames that both have.
    """
    heads = ("single", "mean of all", "CRPS", "spread", "flying 1", "flying mean")
    lines = ["steps frames" + "".join(h.rjust(13) for h in heads) + "   single, minus one step"]
    first = [r["single"].get(key) for r in next(iter(rows.values()))]
    for steps, frames in rows.items():
        most = str(max(map(int, frames[0]["mean"])))
        columns = [[r["single"].get(key) for r in frames], [r["mean"][most].get(key) for r in frames]]
        columns += [[r[name].get(key) for r in frames] for name in ("crps", "spread")]
        cells = [f"{1000 * bootstrap_mean(c)[0]:13.1f}" for c in columns]
        cells += [f"{bootstrap_mean([r[name] for r in frames])[0]:12.1f}%" for name in ("flying_single", "flying_mean")]
        gain = [1000 * v for v in paired_bootstrap(columns[0], first[: len(frames)])]
        lines.append(f"{steps:>5} {len(frames):6}" + "".join(cells) + "   {:+.1f} [{:+.1f}, {:+.1f}]".format(*gain))
    return "\n".join(lines)
