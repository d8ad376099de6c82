"""Two weights folders on the same frames: what each scores, and their paired difference."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .. import metrics
from ..data import Sample
from ..pipeline import Ditr
from .results import head
from .scoring import DITR, run_methods
from .statistics import format_interval, interval, mean_known, paired_bootstrap, ratio_bootstrap

Scores = list[float | None]


def compare_weights(
    first: Path | str | None, second: Path | str | None, samples: Sequence[Sample], given_region: bool = False
) -> dict[str, Any]:
    """Score two systems.

    Args:
        first: weights folder; None for the shipped one.
        second: likewise.
        samples: frames with ground truth.
        given_region: hand over the true region instead of finding it.

    Returns:
        ``frames``, their names; ``rmse_m``: "first" and "second" -> set -> one value a frame or None; ``difference``:
        set -> [mean, low, high] of second minus first in metres, 95 %, paired over frames; ``ratio``: likewise, of the
        means. None where no frame has such pixels.
    """
    rmse, names = {}, []
    for which, folder in (("first", first), ("second", second)):
        rows = run_methods(samples, Ditr.from_pretrained(path=folder), {}, given_region)
        names = [row["name"] for row in rows]
        rmse[which] = {key: [_rmse(row, key) for row in rows] for key in metrics.SETS}
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
