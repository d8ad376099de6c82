"""DITR beside its learned peers at equal training time, its ablation, and what each part of its error is due to.

Paper: Tables I to III (compared systems) and IV (ablation: BB, +DP, +RR). ``tools/peer_study.py`` runs everything on
one split at once: same frames, same region from stage one, same pixels.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import metrics
from ..baselines import REGISTRY
from ..config import from_dict
from ..data import Sample
from ..evaluation.statistics import bootstrap_mean, format_interval, paired_bootstrap, ratio_bootstrap
from ..paper.tables import T1, T4, T5
from ..pipeline import Completion, Ditr, build, compose
from ..store import WEIGHTS, load_part, load_parts, read_card
from ..studies.floor import reconstruct
from ..studies.swaps import SWAPS, Swapped
from .networks import load_peers

RESULTS = WEIGHTS / "results_peers.json"
SETS = ("optical", "geometric", "whole")
SHIPPED, EQUAL = "ditr", "ditr, equal time"
ORACLES = {  # what is put in the place of one part of the shipped system
    "true region": "stage one never errs",
    "no detail network": "the branches as decoded",
    "truth through the autoencoder": "denoisers never err",
    "one sample": "no averaging",
    "sixteen samples": "four times the averaging",
}
IDEAS = {  # peer -> its idea, and the systems of Tables I to III that have it
    "regression": "one U-Net from colour and raw depth to depth (DFNet)",
    "rgb_only": "depth from colour alone, in metres (DenseDepth, SRD, MiDaS)",
    "rgb_only_aligned": "the same, scaled and shifted to the readings (MiDaS)",
    "normals_optimisation": "predict orientation and edges, then solve for depth (DeepCompletion, ClearGrasp)",
    "two_stream_confidence": "a prediction and the sensor, blended by learnt confidence (SwinDRNet)",
    "single_latent_diffusion": "one latent denoiser for the whole frame (LDM; BB)",
}
PAPER = {  # pixel set -> the paper's RMSE of DITR over that of DFNet, and the table that it is from; both are rounded
    "optical": (T5.records()["DITR"]["optical.rmse"] / T5.records()["DFNet"]["optical.rmse"], "Table V, optical"),
    "whole": (T1.records()["DITR"]["rmse"] / T1.records()["DFNet"]["rmse"], "Table I, overall"),
}
Method = Callable[[Sample, Completion], np.ndarray]  # frame and shipped completion -> depth


def arm_system(folder: Path | str, arm: str, seed: int) -> Ditr:
    """Return a system of the shipped stage one and autoencoder with the branches of an arm ("dp", "ditr").

    Raises:
        ValueError: when the arm has not been trained.
    """
    config = from_dict(read_card(folder)["config"])
    if arm == "dp":
        config = replace(config, detail=replace(config.detail, width=0))
    parts, (_, shipped) = build(config), load_parts()
    for name, module in parts.items():
        own = name in ("optical", "geometric", "detail")
        module.load_state_dict(load_part(f"{arm}_{name}-{seed}", folder) if own else shipped[name])
    return Ditr(parts, config)


def methods(ditr: Ditr, folder: Path | str, seeds: Sequence[int] = (0, 1)) -> dict[str, Method]:
    """Return every method of the study: the shipped system with its oracles, baselines, peers, ablation, equal time.

    Args:
        ditr: the shipped system.
        folder: weights of peers and arms.
        seeds: of BB and +DP.

    Raises:
        ValueError: when something has not been trained.
    """
    plain = Swapped(ditr, SWAPS["no detail"])
    rows: dict[str, Method] = {
        SHIPPED: lambda s, out: out.depth,
        "true region": lambda s, out: ditr(s.rgb, s.depth, s.region).depth,
        "no detail network": lambda s, out: plain.paint(s, out.region),
        "truth through the autoencoder": _composed(lambda s, out: reconstruct(ditr.parts["autoencoder"], s)[0]),
        "one sample": lambda s, out: ditr(s.rgb, s.depth, out.region, samples=1).depth,
        "sixteen samples": lambda s, out: ditr(s.rgb, s.depth, out.region, samples=16).depth,
    }
    for name, method in REGISTRY.items():
        rows[name] = _composed(lambda s, out, method=method: method(s.rgb, s.depth, out.region))
    for name, peer in load_peers(folder).items():
        rows[f"{name}, bare"] = lambda s, out, peer=peer: peer(s.rgb, s.depth)
        rows[name] = _composed(lambda s, out, peer=peer: peer(s.rgb, s.depth, out.region))
    equal = arm_system(folder, "ditr", 0)
    rows[EQUAL] = lambda s, out: equal(s.rgb, s.depth, out.region).depth
    for seed in seeds:
        single, two = load_peers(folder, seed)["single_latent_diffusion"], arm_system(folder, "dp", seed)
        rows[f"BB, seed {seed}"] = lambda s, out, single=single: single(s.rgb, s.depth)
        rows[f"+DP, seed {seed}"] = lambda s, out, two=two: two(s.rgb, s.depth, out.probability > 0.5).depth
        rows[f"+RR, seed {seed}"] = lambda s, out, two=two: two(s.rgb, s.depth, out.region).depth
    return rows


def _composed(method: Method) -> Method:
    def composed(s: Sample, out: Completion) -> np.ndarray:
        filled = method(s, out)
        return compose(s.depth, filled, filled, out.region)

    return composed


def score_methods(frames, ditr: Ditr, rows: Mapping[str, Method]) -> dict[str, dict[str, dict[str, float | None]]]:
    """Return frame -> method -> pixel set -> RMSE in metres; stage one runs once a frame and serves all."""
    scores = {}
    for sample in frames:
        out = ditr(sample.rgb, sample.depth)
        scores[sample.name] = {}
        for name, method in rows.items():
            found = metrics.evaluate(method(sample, out), sample.depth_gt, sample.region, sample.depth)
            scores[sample.name][name] = {k: found[k] and round(found[k]["rmse"], 6) for k in SETS}
    return scores


def summarise_peers(scores: Mapping[str, Mapping[str, Mapping[str, float | None]]]) -> dict[str, Any]:
    """Return means, ratios and differences with 95 % intervals over frames, from :func:`score_methods`'s result.

    Returns:
        ``mean``: method -> set -> [mean, low, high] in metres; ``ratio``: method -> set -> mean of DITR at equal time
        over that of the method; ``minus_ditr``: method -> set -> [difference to the shipped system]; ``ablation``:
        seed -> step -> set -> [relative change of the mean].
    """
    names = list(next(iter(scores.values())))
    column = {n: {k: [frame[n][k] for frame in scores.values()] for k in SETS} for n in names}
    out: dict[str, Any] = {"mean": {n: {k: bootstrap_mean(column[n][k]) for k in SETS} for n in names}}
    if EQUAL in names:
        out["ratio"] = {n: {k: ratio_bootstrap(column[EQUAL][k], column[n][k]) for k in SETS} for n in names}
    out["minus_ditr"] = {n: {k: paired_bootstrap(column[n][k], column[SHIPPED][k]) for k in SETS} for n in names}
    seeds = [n.removeprefix("BB, seed ") for n in names if n.startswith("BB, seed ")]
    out["ablation"] = {
        seed: {
            after: {
                k: ratio_bootstrap(column[f"{after}, seed {seed}"][k], column[f"{before}, seed {seed}"][k])
                for k in SETS
            }
            for before, after in (("BB", "+DP"), ("+DP", "+RR"))
        }
        for seed in seeds
    }
    return out


def load_results(path: Path | str = RESULTS) -> dict[str, Any]:
    """Read what ``tools/peer_study.py`` wrote."""
    return json.loads(Path(path).read_text(encoding="utf-8"))


def by_seed(report: Mapping[str, Any], step: str, key: str) -> np.ndarray:
    """Return the errors (S, N) in metres of a step of the ablation: its training seeds by frames that hold such pixels.

    Args:
        report: what ``tools/peer_study.py`` wrote.
        step: ``BB``, ``+DP`` or ``+RR``.
        key: pixel set.
    """
    names = [f"{step}, seed {seed}" for seed in report["ablation"]]
    rows = [[frame[n][key] for n in names] for frame in report["rmse_m"].values()]
    return np.array([row for row in rows if None not in row]).T


def ratio_verdict(report: Mapping[str, Any]) -> str:
    """Say where the paper's ratio to DFNet lies beside ours, of DITR at equal time to regression and to the best peer.

    Like is set beside like: *whole* beside the paper's overall, *optical* beside its optical ratio (:data:`PAPER`).
    """
    mean, lines = report["mean"], []
    best = min((n for n in IDEAS if n in mean), key=lambda n: mean[n]["optical"][0])
    for name in dict.fromkeys(("regression", best)):
        for key, (paper, table) in PAPER.items():
            middle, low, high = report["ratio"][name][key]
            told = "smaller" if high < 1 else "larger" if low > 1 else "not measurably different"
            lies = "below" if paper < low else "above" if paper > high else "inside"
            lines.append(
                f"DITR's {key} error at equal time is {told}: {middle:.2f} [{low:.2f}, {high:.2f}] times that of "
                f"{name}; the paper's {paper:.2f} to DFNet ({table}) lies {lies} our interval"
            )
    return "\n".join(lines)


def format_peers(report: Mapping[str, Any]) -> str:
    """Return the table of peers: RMSE in mm bare and composed, and DITR at equal time over the composed peer."""
    mean, ratio = report["mean"], report["ratio"]
    lines = ["RMSE mm, mean over frames".ljust(32) + "".join(k.rjust(11) for k in SETS) + "   optical, DITR : it"]
    chosen = [SHIPPED, EQUAL, *[n for n in mean if f"{n}, bare" in mean or n.endswith(", bare")]]
    chosen += [n for n in REGISTRY if n in mean]
    for name in chosen:
        lines.append(name.ljust(32) + _cells(mean[name]) + f"   {format_interval(ratio[name]['optical'], 1, '.2f')}")
    return "\n".join(lines)


def format_ablation(report: Mapping[str, Any]) -> str:
    """Return the ablation: RMSE in mm of each step and seed, and the relative changes of the mean that it made."""
    told = T4.records()
    falls = [100 * (told[b]["rmse"] / told[a]["rmse"] - 1) for a, b in (("BB", "BB + DP"), ("BB + DP", "BB + DP + RR"))]
    paper = " (Table IV: {:.0f} %, {:.0f} %)".format(*falls)
    heads = "optical, change".rjust(22) + "whole, change".rjust(22) + paper
    lines = ["RMSE mm".ljust(16) + "".join(k.rjust(11) for k in SETS) + heads]
    for seed, steps in report["ablation"].items():
        for step in ("BB", "+DP", "+RR"):
            change = steps.get(step)
            texts = (
                [format_interval([100 * (v - 1) for v in change[k]], 1, "+.0f") + " %" for k in PAPER] if change else []
            )
            row = f"{step}, seed {seed}".ljust(16) + _cells(report["mean"][f"{step}, seed {seed}"])
            lines.append(row + "".join(text.rjust(22) for text in texts))
    return "\n".join(lines)


def format_oracles(report: Mapping[str, Any]) -> str:
    """Return what the shipped system would score with one part replaced, and the difference that makes."""
    lines = ["RMSE mm".ljust(32) + "".join(k.rjust(11) for k in SETS) + "   optical, minus shipped"]
    for name in (SHIPPED, *ORACLES):
        change = format_interval(report["minus_ditr"][name]["optical"], 1000, "+.1f")
        lines.append(name.ljust(32) + _cells(report["mean"][name]) + f"   {change}  {ORACLES.get(name, '')}")
    return "\n".join(lines)


def _cells(row: Mapping[str, Sequence[float]]) -> str:
    return "".join(f"{1000 * row[k][0]:11.1f}" for k in SETS)
