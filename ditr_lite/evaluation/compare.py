"""Two systems, or two results files, on the same frames: what each scores, and their paired difference."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .. import metrics
from ..config import override
from ..data import Sample
from ..pipeline import Ditr
from ..store import read_config
from .results import head
from .scoring import DITR, run_methods
from .statistics import format_interval, interval, mean_known, paired_bootstrap, ratio_bootstrap

Scores = list[float | None]


# what a trained system can be asked to do otherwise and still works, if not as well as one that was trained for it
WORKING = ("sampler.steps", "sampler.samples", "sampler.eta", "window", "evidence")
WORKING_GROUP = "refine."


def compare_weights(
    first: Path | str | None,
    second: Path | str | None,
    samples: Sequence[Sample],
    given_region: bool = False,
    settings: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Score two systems.

    Args:
        first: weights folder; None for the shipped one.
        second: likewise.
        samples: frames with ground truth.
        given_region: hand over the true region instead of finding it.
        settings: dotted settings of the second system, such as ``{"sampler.steps": 4}``.

    Returns:
        ``frames``, their names; ``rmse_m``: "first" and "second" -> set -> one value a frame or None; ``difference``:
        set -> [mean, low, high] of second minus first in metres, 95 %, paired over frames; ``ratio``: likewise, of the
        means. None where no frame has such pixels.

    Raises:
        ValueError: for a setting that only training can change, or that there is not.
    """
    settings = settings or {}
    if settings:
        override(read_config(second), **settings)  # an unknown one is said to be unknown
    for key in settings:
        if key not in WORKING and not key.startswith(WORKING_GROUP):
            asked = f"{', '.join(WORKING)} or {WORKING_GROUP}*"
            raise ValueError(f"{key} shapes the weights: it needs a training of its own; expected {asked}")
    systems = {"first": Ditr.from_pretrained(path=first), "second": Ditr.from_pretrained(path=second)}
    if settings:
        systems["second"].config = override(systems["second"].config, **settings)
    rows = {which: run_methods(samples, ditr, {}, given_region) for which, ditr in systems.items()}
    rmse = {which: {key: [_rmse(row, key) for row in found] for key in metrics.SETS} for which, found in rows.items()}
    return _paired([row["name"] for row in rows["first"]], rmse)


def compare_results(first: Mapping[str, Any], second: Mapping[str, Any], methods: Sequence[str]) -> dict[str, Any]:
    """Hold two results files of ``evaluate`` or ``bench`` against each other, over the frames that both have.

    Args:
        first: what the file holds: ``rmse_m`` of every frame, method and set.
        second: likewise.
        methods: the one of the first and the one of the second, e.g. ``("ditr", "ditr")``.

    Returns:
        as :func:`compare_weights`.

    Raises:
        ValueError: for files that are of something else, of no common frame, or have no such method.
    """
    tables = {}
    for which, report, method in zip(("first", "second"), (first, second), methods, strict=True):
        frames = report.get("rmse_m")
        if not isinstance(frames, Mapping) or not all(isinstance(row, Mapping) for row in frames.values()):
            raise ValueError(f"the {which} file holds no RMSE by frame: expected one of `evaluate --json`")
        known = dict.fromkeys(name for row in frames.values() for name in row)
        if method not in known:
            raise ValueError(f"the {which} file has no method {method!r}; it has {', '.join(known)}")
        tables[which] = {name: row[method] for name, row in frames.items() if method in row}
    if (sources := [report.get("source") for report in (first, second)])[0] != sources[1]:
        raise ValueError(f"the files are of other frames: {sources[0]} and {sources[1]}")
    names = [name for name in tables["first"] if name in tables["second"]]
    if not names:
        raise ValueError("the files have no frame in common")
    rmse = {
        which: {key: [table[name].get(key) for name in names] for key in metrics.SETS}
        for which, table in tables.items()
    }
    return _paired(names, rmse)


def _paired(names: list[str], rmse: dict[str, dict[str, Scores]]) -> dict[str, Any]:
    pairs = {key: (rmse["second"][key], rmse["first"][key]) for key in metrics.SETS}
    return {
        "frames": names,
        "rmse_m": rmse,
        "difference": {key: interval(paired_bootstrap, *both) for key, both in pairs.items()},
        "ratio": {key: interval(ratio_bootstrap, *both) for key, both in pairs.items()},
    }


def _rmse(row: dict[str, Any], key: str) -> float | None:
    scores = (row["methods"][DITR] or {}).get(key)
    return scores and scores["rmse"]


def format_weights(found: dict[str, Any], first: str, second: str) -> str:
    """Return :func:`compare_weights`' result as a text table."""
    lines = [f"A = {first}", f"B = {second}", f"{len(found['frames'])} frames; RMSE mm, the mean over frames", ""]
    lines += ["set".ljust(16) + "A".rjust(8) + "B".rjust(8) + "B - A".rjust(26) + "B / A".rjust(26)]
    for key in metrics.SETS:
        means = [mean_known(found["rmse_m"][which][key]) for which in ("first", "second")]
        cells = ["-" if mean is None else f"{1000 * mean:.1f}" for mean in means]
        line = key.ljust(16) + "".join(cell.rjust(8) for cell in cells)
        line += format_interval(found["difference"][key], 1000).rjust(26)
        lines.append(line + format_interval(found["ratio"][key], 1, ".3f").rjust(26))
    return "\n".join([*lines, "mean [95 % interval], paired over frames; below 0, or 1, B is better"])


def weights_to_json(found: dict[str, Any], command: str, first: Path | None, second: Path | None) -> dict[str, Any]:
    """Return what a results file of a comparison holds."""
    return {**head(command, first), "second_sha256": head(command, second)["weights_sha256"], **found}
