"""Score DITR beside every baseline: same frames, same region, same composition, same pixels.

Paper: Sec. V-C, Tables I-III and V. A baseline that were given the true region, or that might change pixels DITR must
keep, would be compared on other terms; so each gets DITR's region and its result is composed as DITR's is.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from .. import metrics
from ..baselines import REGISTRY, Fill
from ..data import Sample
from ..pipeline import Completion, Ditr, compose
from ..units import check_depth, clean_depth
from .protocols import Protocol
from .results import head
from .stage_one import PER_CLASS, STAGE_ONE, score_stage_one
from .statistics import bootstrap_mean, format_interval, interval, paired_bootstrap

DITR, SENSOR = RESERVED = "ditr", "sensor"  # rows that are not methods
COMPARED = ("optical", "optical_valid", "geometric")  # where differences get an interval


Result = dict[str, Any]  # of one frame, ready for JSON


def run_methods(
    samples: Iterable[Sample],
    ditr: Ditr,
    methods: Mapping[str, Fill] | None = None,
    given_region: bool = False,
    steps: int | None = None,
    samples_per_frame: int | None = None,
    progress: bool = True,
    protocol: Protocol | None = None,
) -> list[Result]:
    """Complete every frame with DITR, once, and with every baseline, and score them all.

    Args:
        samples: frames with ground truth.
        ditr: the system.
        methods: name -> baseline; all of ``baselines.REGISTRY`` by default.
        given_region: hand over the true region (as it is, not refined) instead of letting stage one find it.
        steps: denoising steps of DITR, its configuration's by default.
        samples_per_frame: draws of DITR, likewise.
        progress: show a bar.
        protocol: also score as somebody else's code would.

    Returns:
        One dictionary a frame: ``name``; ``methods``: name -> what ``metrics.evaluate`` gives, None where the method
        refused the frame, with the reason in ``refused``. Beside ``ditr`` and the baselines stands ``sensor``, the bare
        readings, scored only where there are any. ``stage_one``: IoU of the prediction before refinement, share of
        the true region that is missed after it, area after it over that of the true region refined alike, and IoU and
        recall of each class where materials are known; None where there is nothing to compare. ``kept``: whether every
        reading outside the region came back bit for bit. ``protocol``: method -> scores, when one was asked for.

    Raises:
        ValueError: for a frame without ground truth, or without a region to give; a method named as in ``RESERVED``.
    """
    methods = REGISTRY if methods is None else methods
    taken = [name for name in RESERVED if name in methods]
    if taken:
        raise ValueError(f"a method cannot be called {taken[0]!r}, which is a row of its own: give it another name")
    results = []
    for sample in tqdm(samples, desc="frames", unit="frame", **({} if progress else {"disable": True})):
        if sample.depth_gt is None:
            raise ValueError(f"{sample.name} has no ground-truth depth: there is nothing to score; try `complete`")
        if given_region and sample.region is None:
            raise ValueError(f"{sample.name} has no true region to give: leave it to stage one")
        sample = replace(sample, depth=clean_depth(sample.depth))
        out, maps, refused = _complete(sample, ditr, methods, given_region, steps, samples_per_frame)
        result = {"name": sample.name, "refused": refused, "methods": dict.fromkeys([DITR, *methods])}
        for name, depth in maps.items():
            result["methods"][name] = metrics.evaluate(depth, sample.depth_gt, sample.region, sample.depth)
        result["methods"][SENSOR] = score_sensor(sample)
        result["stage_one"] = None if out is None else score_stage_one(out, sample, ditr)
        result["kept"] = out is None or kept_bit_for_bit(out, sample.depth)
        if protocol is not None:
            fed = replace(sample, depth=protocol.prepare(sample.depth))
            if not np.array_equal(fed.depth, sample.depth):
                asked = (ditr, methods, given_region, steps, samples_per_frame)
                _, maps, result["protocol_refused"] = _complete(fed, *asked)
            scores = {name: protocol.score(depth, sample) for name, depth in maps.items()}
            result["protocol"] = dict.fromkeys([DITR, *methods]) | scores
        results.append(result)
    return results


def _complete(
    sample: Sample, ditr: Ditr, methods: Mapping[str, Fill], given: bool, steps: int | None, draws: int | None
) -> tuple[Completion | None, dict[str, np.ndarray], dict[str, str]]:
    """Return DITR's completion, the depth of every method that made one, and why the others did not."""
    if not sample.depth.any():
        return None, {}, dict.fromkeys([DITR, *methods], "no reading in the frame")
    out = ditr(sample.rgb, sample.depth, sample.region if given else None, steps, draws)
    maps, refused = {DITR: out.depth}, {}
    for name, method in methods.items():
        try:
            filled = check_depth(name, method(sample.rgb, sample.depth, out.region), sample.depth.shape)
        except ValueError as error:  # nothing is known outside the region, so nothing can be filled from there
            refused[name] = str(error)
            continue
        maps[name] = compose(sample.depth, filled, filled, out.region)
    return out, maps, refused


def score_sensor(sample: Sample) -> dict[str, metrics.Scores | None] | None:
    """Score the raw readings themselves, leaving out the pixels that have none; None where no reading can be scored."""
    read = sample.depth > 0
    if not (read & (sample.depth_gt > 0)).any():
        return None
    truth = np.where(read, sample.depth_gt, 0).astype(np.float32)  # where nothing was read, no truth: not scored
    return metrics.evaluate(np.where(read, sample.depth, 1).astype(np.float32), truth, sample.region, sample.depth)


def kept_bit_for_bit(out: Completion, depth: np.ndarray) -> bool:
    """Return whether every reading outside the region came back with the very same bits."""
    keep = (depth > 0) & ~out.region
    return np.array_equal(out.depth[keep].view(np.uint32), depth[keep].view(np.uint32))


def ranked(methods: Mapping[str, Mapping[str, metrics.Scores | None]], key: str) -> list[str]:
    """Return the names of dense methods by their RMSE on one pixel set of a frame, the best first, DITR among them.

    Args:
        methods: name -> pixel set -> scores; the bare sensor, which answers on its readings only, is left out.
        key: of the pixel set.
    """
    scored = {name: row[key]["rmse"] for name, row in methods.items() if name != SENSOR and row and row.get(key)}
    return sorted(scored, key=scored.get)


def summary(results: Sequence[Result], protocol: Protocol | None = None) -> dict[str, Any]:
    """Condense :func:`run_methods`' results; ``protocol`` says how its scores are averaged.

    Returns:
        ``images``; ``methods``: name -> ``metrics.average``, None where all frames were refused; ``differences``:
        baseline -> set -> [mean, low, high] of DITR's RMSE minus the baseline's in metres, 95 %, paired over images,
        None without common images or where :func:`on_the_same_pixels` says no; ``stage_one``: name -> [mean, low,
        high]; ``kept``: whether all frames passed; ``refused``: method -> reason -> frames; ``protocol``: name ->
        average, when there is one.

    Raises:
        ValueError: for no results.
    """
    if not results:
        raise ValueError("no results to summarise: run_methods was given no sample")
    found = [r["stage_one"] for r in results if r["stage_one"]]
    out = {
        "images": len(results),
        "methods": _averages(results, "methods", metrics.average),
        "differences": {name: _differences(results, name) for name in results[0]["methods"] if name != DITR},
        "stage_one": {},
        "kept": all(r["kept"] for r in results),
    }
    for key in STAGE_ONE + PER_CLASS:
        values = [f.get(key) for f in found]
        out["stage_one"][key] = interval(bootstrap_mean, values)
    out["refused"] = _reasons(results, "refused")
    if "protocol" in results[0]:
        out["protocol_refused"] = _reasons(results, "protocol_refused")
        out["protocol"] = _averages(results, "protocol", protocol.average if protocol else metrics.average)
    return out


def format_report(report: Mapping[str, Any], protocol: Protocol | None = None) -> str:
    """Return :func:`summary`'s result as text: tables, intervals, stage one, and what did not go as it should."""
    methods = {name: row or {} for name, row in report["methods"].items()}
    width = max(len(name) for name in methods)
    lines = [f"{report['images']} frames; a score is the mean over frames of the frame's value.", ""]
    lines += [metrics.format_table(methods), "Pooled over all pixels instead, RMSE mm"]
    lines += ["method".ljust(width) + "".join(key.rjust(15) for key in metrics.SETS)]
    for name, row in methods.items():
        cells = [f"{1000 * row[k]['pooled']['rmse']:15.1f}" if row.get(k) else "-".rjust(15) for k in metrics.SETS]
        lines.append(name.ljust(width) + "".join(cells))
    lines += ["", "RMSE of ditr minus RMSE of the method, mm: mean [95 % interval], paired over frames"]
    lines += ["method".ljust(width) + "".join(key.rjust(26) for key in COMPARED)]
    for name, row in report["differences"].items():
        lines.append(name.ljust(width) + "".join(format_interval(row[key], 1000, "+.1f").rjust(26) for key in COMPARED))
    lines.append("")
    if protocol is not None and "protocol" in report:
        rows = {name: row or {} for name, row in report["protocol"].items()}
        lines += [f"As {protocol.name}'s code scores: {protocol.describe()}"]
        lines += [metrics.format_table(rows, protocol.sets)]
        for name, reasons in report["protocol_refused"].items():
            lines += [f"{name} refused {count} frames as that code feeds them: {why}" for why, count in reasons.items()]
    one = report["stage_one"]
    if one["iou"] is not None:
        figures = (f"{key} {format_interval(one[key], 1, '.3f')}" for key in STAGE_ONE + PER_CLASS if one.get(key))
        lines.append("stage one: " + ", ".join(figures) + " (miss_rate and area_ratio after refinement)")
    lines.append(f"{SENSOR} = bare readings, scored only where there are any; all others are dense")
    lines.append("readings outside the region: " + ("kept bit for bit" if report["kept"] else "CHANGED, a defect"))
    for name, reasons in report["refused"].items():
        lines += [f"{name} refused {count} of {report['images']} frames: {why}" for why, count in reasons.items()]
    return "\n".join(lines)


def to_json(
    results: Sequence[Result],
    command: str,
    weights: Path | str | None = None,
    protocol: Protocol | None = None,
    **notes: Any,
) -> Result:
    """Return what a committed result file holds: its head, the summary, RMSE and stage one's figures of every frame.

    Args:
        results: of :func:`run_methods`.
        command: that made them.
        weights: folder of the weights; None for the shipped ones.
        protocol: the one that they were scored with, if any.
        notes: anything else to write down, e.g. the split.
    """
    frames = {}
    for result in results:
        rows = frames[result["name"]] = {}
        for method, scores in result["methods"].items():
            rows[method] = {key: score and round(score["rmse"], 6) for key, score in (scores or {}).items()}
    one = {result["name"]: result["stage_one"] for result in results if result["stage_one"]}
    one = {name: {key: v if v is None else round(v, 6) for key, v in row.items()} for name, row in one.items()}
    begin = head(command, weights, **notes)
    return {**begin, "summary": summary(results, protocol), "rmse_m": frames, "stage_one": one}


def _reasons(results: Sequence[Result], key: str) -> dict[str, dict[str, int]]:
    """Return method -> reason -> frames that it refused, of the methods that refused any."""
    found = {name: Counter(r[key][name] for r in results if name in r.get(key, {})) for name in results[0]["methods"]}
    return {name: dict(reasons) for name, reasons in found.items() if reasons}


def _averages(results: Sequence[Result], key: str, average: Callable[[list], dict]) -> dict[str, Any]:
    averages = {}
    for name in results[0][key]:
        rows = [r[key][name] for r in results if r[key][name]]
        averages[name] = average(rows) if rows else None
    return averages


def on_the_same_pixels(name: str, key: str) -> bool:
    """Return whether a method and DITR are scored on the same pixels of a set: the sensor only on its readings."""
    return name != SENSOR or key == "optical_valid"


def _differences(results: Sequence[Result], name: str) -> dict[str, list[float] | None]:
    found = dict.fromkeys(COMPARED)
    for key in COMPARED:
        if on_the_same_pixels(name, key):
            found[key] = interval(paired_bootstrap, _rmse(results, DITR, key), _rmse(results, name, key))
    return found


def _rmse(results: Sequence[Result], name: str, key: str) -> list[float | None]:
    scores = [(r["methods"][name] or {}).get(key) for r in results]
    return [s and s["rmse"] for s in scores]
