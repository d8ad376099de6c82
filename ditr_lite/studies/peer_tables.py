"""Tables of DITR beside learned peers at equal training time, of its ablation, and of what its error is due to.

Paper: Tables I to III (compared systems) and IV (ablation: BB, +DP, +RR). ``tools/train_peers.py`` trains the arms,
``tools/peer_study.py`` scores all of them on the same frames, with the same region from stage one, on the same pixels.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from ..baselines import REGISTRY
from ..data import SAMPLES, Sample, load_sample
from ..evaluation.statistics import bootstrap_mean, format_interval, interval, paired_bootstrap, ratio_bootstrap
from ..files import read_depth
from ..paper.tables import T1, T4, T5
from ..store import WEIGHTS

RESULTS = WEIGHTS / "results_peers.json"
PICTURES = SAMPLES / "peers"  # what each peer painted where it failed
SETS = ("optical", "geometric", "whole")
SHIPPED, EQUAL = "ditr", "ditr, equal time"
PAPERS = "+RR, seed 0"  # two branches as in the paper's DITR, at equal time: what peers are held against
ORACLES = {  # what is put in the place of one part of the shipped system
    "true region": "stage one never errs",
    "no detail network": "the branches as decoded",
    "truth through the autoencoder": "denoisers never err",
    "one sample": "no averaging",
    "sixteen samples": "four times the averaging",
}
EQUAL_ORACLES = {  # the same of DITR at equal time
    "equal time, true region": "stage one never errs",
    "equal time, no detail network": "the branches as decoded",
    "truth at the working size": "no painter ever errs",
}
IDEAS = {  # peer -> its idea, and the systems of Tables I to III that have it
    "regression": "one U-Net from colour and raw depth to depth (DFNet)",
    "rgb_only": "depth from colour alone (DenseDepth)",
    "rgb_only_aligned": "the same, scaled and shifted to the readings outside (MiDaS)",
    "normals_optimisation": "predict orientation and edges, then solve for depth (DeepCompletion, ClearGrasp)",
    "two_stream_confidence": "a prediction and the sensor, blended by learnt confidence (SwinDRNet)",
    "implicit_rays": "ask points along each ray whether it ends there (LIDF)",
    "point_completion": "lift to points, complete them, project (TranspareNet)",
    "adversarial": "a critic tells painted depth from true depth (DepthGrasp)",
    "self_supervised": "colour alone, taught and scaled by the sensor's readings (SRD)",
    "single_latent_diffusion": "one latent denoiser for all, no region (LDM)",
}
PAPER = {  # pixel set -> the paper's RMSE of DITR over that of DFNet, and the table that it is from; both are rounded
    "optical": (T5.records()["DITR"]["optical.rmse"] / T5.records()["DFNet"]["optical.rmse"], "Table V, optical"),
    "whole": (T1.records()["DITR"]["rmse"] / T1.records()["DFNet"]["rmse"], "Table I, overall"),
}
LADDER = (("BB", "+DP"), ("+DP", "+RR"))
Scores = Mapping[str, Mapping[str, Mapping[str, float | None]]]  # frame -> method -> pixel set -> RMSE in metres


def summarise_peers(scores: Scores) -> dict[str, Any]:
    """Return means, ratios and differences with 95 % intervals over frames.

    Args:
        scores: frame -> method -> pixel set -> RMSE in metres, None for an empty set.

    Returns:
        ``frames``: their number; ``mean``: method -> set -> [mean, low, high] in metres; ``ratio``: method -> set ->
        mean of the paper's DITR at equal time (:data:`PAPERS`) over that of the method; ``minus_ditr``: method -> set
        -> [difference to the shipped system], if that was scored; ``minus_equal``: the same to :data:`EQUAL`, DITR with
        our final step; ``ablation``: seed -> step -> set -> [relative change of the mean].
    """
    names = list(next(iter(scores.values())))
    column = {n: {k: [frame[n][k] for frame in scores.values()] for k in SETS} for n in names}
    out: dict[str, Any] = {"frames": len(scores)}
    out["mean"] = {n: {k: interval(bootstrap_mean, column[n][k]) for k in SETS} for n in names}
    if PAPERS in names:
        methods = [n for n in names if n not in (*ORACLES, *EQUAL_ORACLES)]  # an oracle may err nowhere
        out["ratio"] = {n: {k: ratio_bootstrap(column[PAPERS][k], column[n][k]) for k in SETS} for n in methods}
    for key, against in (("minus_ditr", SHIPPED), ("minus_equal", EQUAL)):
        if against in names:
            out[key] = {n: {k: paired_bootstrap(column[n][k], column[against][k]) for k in SETS} for n in names}
    seeds = [n.removeprefix("BB, seed ") for n in names if n.startswith("BB, seed ")]
    out["ablation"] = {seed: _steps(column, seed) for seed in seeds if f"+RR, seed {seed}" in names}
    return out


def _steps(column: Mapping[str, Mapping[str, Sequence[float | None]]], seed: str) -> dict[str, dict[str, Any]]:
    steps = {}
    for before, after in LADDER:
        one, other = column[f"{after}, seed {seed}"], column[f"{before}, seed {seed}"]
        steps[after] = {k: ratio_bootstrap(one[k], other[k]) for k in SETS}
    return steps


def load_results(path: Path | str = RESULTS) -> dict[str, Any]:
    """Read what ``tools/peer_study.py`` wrote: ``trained``, ``splits`` (name -> scores and summary), ``real``."""
    return json.loads(Path(path).read_text(encoding="utf-8"))


def by_seed(report: Mapping[str, Any], step: str, key: str) -> np.ndarray:
    """Return the errors (S, N) in metres of a step of the ablation: its training seeds by frames that hold such pixels.

    Args:
        report: of one split.
        step: ``BB``, ``+DP`` or ``+RR``.
        key: pixel set.
    """
    names = [f"{step}, seed {seed}" for seed in report["ablation"]]
    rows = [[frame[n][key] for n in names] for frame in report["rmse_m"].values()]
    return np.array([row for row in rows if None not in row]).T


def best_peer(report: Mapping[str, Any], key: str = "optical") -> str:
    """Return the peer with the smallest mean error of a split on the pixel set ``key``."""
    mean = report["mean"]
    return min((n for n in IDEAS if n in mean and mean[n][key]), key=lambda n: mean[n][key][0])


def ratio_verdict(report: Mapping[str, Any]) -> str:
    """Say how the error of :data:`PAPERS` compares with that of regression, the paper's DFNet, and of the best peer.

    Like is set beside like: regression's *whole* beside the paper's overall ratio to DFNet, its *optical* beside the
    optical one (:data:`PAPER`). Another peer stands for another system: the paper's ratio says nothing of it.
    Last comes what the paper claims of the holes: DITR's error is the smallest.

    Args:
        report: of one split, with the scores of its frames as ``rmse_m``.
    """
    lines = []
    pairs = [("regression", key) for key in PAPER]
    pairs += [(best_peer(report, key), key) for key in PAPER]
    for name, key in dict.fromkeys(pairs):
        paper, table = PAPER[key]
        middle, low, high = report["ratio"][name][key]
        told = "smaller" if high < 1 else "larger" if low > 1 else "not measurably different"
        line = f"+RR's {key} error is {told}: {middle:.2f} [{low:.2f}, {high:.2f}] times that of {name}"
        if name == "regression":
            lies = "below" if paper < low else "above" if paper > high else "inside"
            line += f"; the paper's {paper:.2f} to DFNet ({table}) lies {lies} our interval"
        else:
            line += ", the best of the peers at that on these very frames: chosen by them, it is flattered"
        lines.append(line)
    return "\n".join([*lines, holes_verdict(report)])


def holes_verdict(report: Mapping[str, Any]) -> str:
    """Say which methods fill the holes better than :data:`PAPERS`.

    All are asked on the same frames, and only those that come out best are named, so the intervals are those of all
    comparisons together: one picked interval would be too narrow.

    Args:
        report: of one split, with the scores of its frames as ``rmse_m``.
    """
    scores = list(report["rmse_m"].values())
    column = {n: [frame[n]["geometric"] for frame in scores] for n in scores[0]}
    others = [n for n in (*IDEAS, *REGISTRY) if n in column and report["mean"][n]["geometric"]]
    gaps = {n: paired_bootstrap(column[n], column[PAPERS], among=len(others)) for n in others}
    smaller = sorted((n for n in others if gaps[n][2] < 0), key=lambda n: gaps[n][0])
    named = smaller or [min(others, key=lambda n: gaps[n][0])]
    texts = [
        f"{n}{' (a baseline)' if n in REGISTRY else ''} {format_interval(gaps[n], 1000, '+.1f')} mm" for n in named
    ]
    said = f"{len(smaller) or 'none'} of {len(others)} other methods {'have' if len(smaller) > 1 else 'has'}"
    return (
        f"In the holes {said} an error measurably smaller than +RR's, all intervals together at 95 %: "
        f"{'' if smaller else 'the lowest is '}{', '.join(texts)}"
    )


def minutes_each(study: Mapping[str, Any]) -> float:
    """Return the minutes of processor time that every arm of a study was given."""
    given: dict[str, float] = {}
    for part in study["trained"].values():
        if part["seed"] == 0:
            given[part["arm"]] = given.get(part["arm"], 0.0) + part["minutes"]
    (each,) = {round(minutes, 1) for minutes in given.values()}
    return each


def minutes_spent(study: Mapping[str, Any]) -> str:
    """Return the least and the most minutes of processor time that a training took, in words."""
    spent: dict[tuple[str, int], float] = {}
    for part in study["trained"].values():
        key = part["arm"], part["seed"]
        spent[key] = spent.get(key, 0.0) + part["cpu_seconds"] / 60
    return f"{min(spent.values()):.1f} to {max(spent.values()):.1f}"


def training_command(study: Mapping[str, Any]) -> str:
    """Return the command that trains the arms of a study."""
    return f"python tools/train_peers.py --minutes {minutes_each(study):g}"


def format_training(study: Mapping[str, Any], shipped: tuple[int, int]) -> str:
    """Return how long each arm was trained, in minutes of processor time, and how this differs from the shipped system.

    Args:
        study: what :func:`load_results` returns.
        shipped: working size (height, width) of the shipped system.
    """
    seeds: dict[str, set[int]] = {}
    ours = detail = 0.0
    for name, part in study["trained"].items():
        seeds.setdefault(part["arm"], set()).add(part["seed"])
        if part["arm"] == "ditr" and part["seed"] == 0:
            ours += part["cpu_seconds"]
            detail += part["cpu_seconds"] * name.startswith("ditr_detail")
    twice = [arm for arm, used in seeds.items() if len(used) > 1]
    size = "{1} x {0}".format(*study["settings"]["size"])
    lines = [f"{len(seeds)} arms, {minutes_spent(study)} minutes of processor time for each training"]
    lines.append(f"trained twice, with two seeds: {', '.join(twice) or 'none'}")
    if detail:
        lines.append(f"the detail network took {detail / ours:.0%} of the time of 'ditr, equal time'")
    lines.append(f"working size {size} pixels; the shipped system works at {shipped[1]} x {shipped[0]}")
    return "\n".join(lines)


def format_peers(report: Mapping[str, Any]) -> str:
    """Return the table of a split: RMSE in mm of DITR, peers and baselines, and the paper's DITR over each.

    ``+RR`` is the paper's DITR, which has no finer final step, so that its two branches train longer. Of the final step
    the trust in readings was chosen for cameras, which is not what peers are scored on.
    """
    mean, ratio = report["mean"], report["ratio"]
    lines = ["RMSE mm, mean over frames".ljust(36) + "".join(k.rjust(11) for k in SETS) + "   optical, +RR over it"]
    for name in (SHIPPED, *with_seeds(mean, EQUAL, "+RR", *IDEAS), *REGISTRY):
        if name in mean:
            over = format_interval(ratio[name]["optical"], 1, ".2f")
            lines.append(name.ljust(36) + _cells(mean[name]) + f"   {over}")
    return "\n".join(lines)


def with_seeds(mean: Mapping[str, Any], *names: str) -> list[str]:
    """Return those of ``names`` that were scored, each followed by its further training seeds."""
    found = []
    for name in names:
        found += [n for n in mean if n == name or n.startswith(f"{name}, seed ")]
    return found


def format_ablation(report: Mapping[str, Any]) -> str:
    """Return the ablation: RMSE in mm of each step and seed, and the relative changes of the mean that it made."""
    told = T4.records()
    falls = [100 * (told[b]["rmse"] / told[a]["rmse"] - 1) for a, b in (("BB", "BB + DP"), ("BB + DP", "BB + DP + RR"))]
    paper = " (Table IV: {:.0f} %, {:.0f} %)".format(*falls)
    heads = "optical, change".rjust(22) + "whole, change".rjust(22) + paper
    lines = ["RMSE mm".ljust(15) + "".join(k.rjust(11) for k in SETS) + heads]
    for seed, steps in report["ablation"].items():
        for step in ("BB", "+DP", "+RR"):
            change = steps.get(step)
            texts = (
                [format_interval([100 * (v - 1) for v in change[k]], 1, "+.0f") + " %" for k in PAPER] if change else []
            )
            row = f"{step}, seed {seed}".ljust(15) + _cells(report["mean"][f"{step}, seed {seed}"])
            lines.append(row + "".join(text.rjust(22) for text in texts))
    return "\n".join(lines)


def format_oracles(report: Mapping[str, Any]) -> str:
    """Return what DITR, shipped and at equal time, would score with one part replaced, and the difference it makes."""
    lines = ["RMSE mm".ljust(31) + "".join(k.rjust(11) for k in SETS) + "   optical, minus the unchanged"]
    groups = ((SHIPPED, ORACLES, "minus_ditr"), (EQUAL, EQUAL_ORACLES, "minus_equal"))
    for base, oracles, key in groups:
        for name in (base, *oracles):
            if name in report["mean"] and key in report:
                change = format_interval(report[key][name]["optical"], 1000, "+.1f")
                row = name.ljust(31) + _cells(report["mean"][name]) + f"   {change}  {oracles.get(name, '')}"
                lines.append(row.rstrip())
    return "\n".join(lines)


def format_real(real: Mapping[str, Mapping[str, Mapping[str, float | None]]]) -> str:
    """Return the table of real frames: RMSE in mm where the truth is known, else the share of readings that moved.

    Args:
        real: frame -> method -> ``optical``, ``geometric`` (metres) or ``moved`` (a share; None where it is not known
            which readings are of glass).
    """
    methods = list(next(iter(real.values())))
    true = [frame for frame, rows in real.items() if "optical" in rows[methods[0]]]
    controls = [frame for frame, rows in real.items() if rows[methods[0]].get("moved") is not None]
    heads = ["optical mm", "geometric mm", "moved %"]
    lines = [
        f"{len(true)} real frames with truth, {len(controls)} others".ljust(36) + "".join(h.rjust(14) for h in heads)
    ]
    for method in methods:
        columns = [[real[f][method][key] for f in true if real[f][method][key] is not None] for key in SETS[:2]]
        cells = [f"{1000 * np.mean(c):14.1f}" if c else f"{'-':>14}" for c in columns]
        moved = [real[f][method]["moved"] for f in controls]
        cells.append(f"{100 * np.mean(moved):14.2f}" if moved else f"{'-':>14}")
        lines.append(method.ljust(36) + "".join(cells))
    return "\n".join(lines)


def failure_frames(part: Mapping[str, Any]) -> dict[str, str]:
    """Return peer -> a frame of a split where its optical error exceeds that of +RR most.

    A frame stands for one peer only, or one hard frame would stand for all: of all such choices, the one in which the
    peers lose most together. A peer that wins everywhere gets a frame all the same.
    """
    peers = [n for n in IDEAS if n in part["mean"]]
    rows = {frame: row for frame, row in part["rmse_m"].items() if row[PAPERS]["optical"] is not None}  # with a region
    gaps = np.array([[row[peer]["optical"] - row[PAPERS]["optical"] for row in rows.values()] for peer in peers])
    chosen = linear_sum_assignment(gaps.reshape(len(peers), len(rows)), maximize=True)
    return {peers[i]: list(rows)[j] for i, j in zip(*chosen, strict=True)}


def read_failures(report: Mapping[str, Any], folder: Path | str = PICTURES) -> list[tuple[str, Sample, np.ndarray]]:
    """Return peer, frame and completed depth (H, W) in metres of each peer's bad frame beside DITR.

    Raises:
        ValueError: when a picture that the results name is not there.
    """
    return [
        (peer, load_sample(frame), read_depth(Path(folder) / f"{peer}.png"))
        for peer, frame in report["failures"].items()
    ]


def error_character(depth: np.ndarray, truth: np.ndarray, region: np.ndarray) -> dict[str, float]:
    """Say of what kind an error inside a region is.

    Args:
        depth: (H, W) completed, metres.
        truth: (H, W) metres, 0 = unknown.
        region: (H, W) bool.

    Returns:
        in metres: ``rmse``; ``offset``, the mean error, above 0 for too far; ``shape``, the RMSE without the offset;
        ``outline``, the RMSE within two pixels of the region's outline (0 where nothing of it is known).

    Raises:
        ValueError: when no pixel of the region has a truth.
    """
    known = region & (truth > 0)
    if not known.any():
        raise ValueError("no pixel of the region has a true depth; choose another frame")
    error = np.where(known, depth.astype(np.float64) - truth, 0)
    inner = cv2.erode(region.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    near = known & ~inner
    offset = float(error[known].mean())
    return {
        "rmse": float(np.sqrt((error[known] ** 2).mean())),
        "offset": offset,
        "shape": float(error[known].std()),
        "outline": float(np.sqrt((error[near] ** 2).mean())) if near.any() else 0.0,
    }


def format_failures(failures: Sequence[tuple[str, Sample, np.ndarray]]) -> str:
    """Return what kind of error each peer makes on its bad frame, mm, and what most of its error is, in words."""
    heads = ("frame", "RMSE", "offset", "shape", "outline")
    lines = ["mm".ljust(25) + heads[0].ljust(12) + "".join(h.rjust(9) for h in heads[1:])]
    for peer, sample, depth in failures:
        kind = error_character(depth, sample.depth_gt, sample.region)
        cells = "".join(
            f"{1000 * kind[k]:{'+' if k == 'offset' else ''}9.1f}" for k in ("rmse", "offset", "shape", "outline")
        )
        if abs(kind["offset"]) > kind["shape"]:
            told = "the glass is too far as a whole" if kind["offset"] > 0 else "the glass is too near as a whole"
        else:
            told = (
                "its shape is wrong, above all its outline"
                if kind["outline"] > 1.2 * kind["rmse"]
                else "its shape is wrong"
            )
        lines.append(peer.ljust(25) + sample.name.ljust(12) + cells + f"  {told}")
    return "\n".join(lines)


def format_study(report: Mapping[str, Any]) -> str:
    """Return every table of a results file, split after split."""
    texts = []
    for split, part in report["splits"].items():
        texts.append(f"{split} split, {part['frames']} frames")
        texts += [format_peers(part), ratio_verdict(part), format_ablation(part), format_oracles(part)]
    if report.get("real"):
        texts.append(format_real(report["real"]))
    return "\n\n".join(texts)


def _cells(row: Mapping[str, Sequence[float] | None]) -> str:
    return "".join(f"{1000 * row[k][0]:11.1f}" if row[k] else f"{'-':>11}" for k in SETS)
