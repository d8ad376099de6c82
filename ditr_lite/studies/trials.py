"""What was tried and what was chosen: every comparison on validation scenes that the committed results hold.

Winners alone would hide what they cost and how near the others came. Paper: no table of this kind is given.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..config import from_dict, override, preset
from ..evaluation.costs import costs
from ..evaluation.statistics import format_interval, paired_bootstrap
from ..store import WEIGHTS, read_card
from .settings import DEFAULT, against_default, errors


class Trial(NamedTuple):
    """One setting that was tried: the part, the setting, errors in metres on validation scenes, whether it was taken.

    ``price`` says in words what else the choice looked at; ``command`` makes the figures again.
    """

    part: str
    setting: str
    optical_m: float
    chosen: bool
    price: str
    command: str


def trials(folder: Path | str = WEIGHTS) -> list[Trial]:
    """Read what was tried from ``results_factors.json``, ``_region``, ``_settings`` and the card in ``folder``."""
    factors, region, settings = (
        json.loads((Path(folder) / f"results_{name}.json").read_text()) for name in ("factors", "region", "settings")
    )
    shipped = 2 ** len(from_dict(read_card(folder)["config"]).autoencoder.multipliers)
    found = []
    for row in factors["rows"]:
        price = f"{row['step_flop'] / 1e9:.1f} GFLOP a step"
        error, name = row["floor"]["rmse_m"]["optical"][0], f"factor {row['factor']}"
        found.append(Trial("autoencoder", name, error, row["factor"] == shipped, price, factors["command"]))
    for name, row in region["refinement"].items():
        price = f"whole frame {1000 * row['whole_m']['mean'][0]:.1f} mm"
        error = row["optical_m"]["mean"][0]
        found.append(Trial("refinement", name, error, name == region["shipped"], price, region["command"]))
    tuning = region["finetuning"]
    before = {k: np.mean([v for v in tuning["before"][k] if v is not None]) for k in ("optical_m", "whole_m")}
    variants = {"not fine-tuned": before} | {
        name: {k: before[k] + row["change"][k][0] for k in before}
        for name, row in tuning.items()
        if isinstance(row, dict) and "change" in row
    }
    for name, row in variants.items():
        price = f"whole frame {1000 * row['whole_m']:.1f} mm"
        chosen = name == "not fine-tuned"
        found.append(Trial("stage one", name, float(row["optical_m"]), chosen, price, region["command"]))
    for name, row in settings["rows"].items():
        gain, other = (against_default(settings["rows"], name, key) for key in ("optical", "geometric"))
        operations = costs(override(preset("tiny"), **row["settings"]))
        price = f"{sum(r['gflops'] * r['calls'] for r in operations):.2f} GFLOP a frame"
        if name != DEFAULT:
            said = "optical error clearly different" if gain.clear else "not clearly different"
            price += f"; {said}; geometric {1000 * other.mean:+.1f} mm"
        error = float(errors(row).mean())
        found.append(Trial("stage two, tiny", name, error, name == DEFAULT, price, settings["command"]))
    return found


def format_trials(found: Sequence[Trial]) -> str:
    """Return the table, and per part whether what was chosen has the lowest optical error."""
    lines = [f"{'part':15} {'setting':40}{'optical mm':>11}   what else it cost"]
    for t in found:
        lines.append(f"{t.part:15} {t.setting:40}{1000 * t.optical_m:11.1f}   {t.price}{' <- chosen' * t.chosen}")
    lines.append("")
    for part in dict.fromkeys(t.part for t in found):
        rows = [t for t in found if t.part == part]
        best, chosen = min(rows, key=lambda t: t.optical_m), next(t for t in rows if t.chosen)
        said = "which also has the lowest error" if best is chosen else f"though {best.setting} has the lowest error"
        lines.append(f"{part}: chosen {chosen.setting}, {said} ({chosen.command})")
    return "\n".join(lines)


def format_refinement(report: Mapping[str, Any]) -> str:
    """Return what each refinement changes against the gentlest, scene by scene, and what a rule would choose.

    The rule: of the settings whose optical error is not measurably above the lowest, the one that costs the whole frame
    least. It says when a smaller gain inside the region is not worth a larger loss outside.

    Args:
        report: ``results_region.json`` as ``tools/region_study.py`` wrote it.
    """
    rows, shipped = report["refinement"], report["shipped"]
    mean = {key: {n: row[key]["mean"][0] for n, row in rows.items()} for key in ("optical_m", "whole_m")}
    gentlest, lowest = next(iter(rows)), min(mean["optical_m"], key=mean["optical_m"].get)
    lines = [
        f"minus {gentlest}, mm".ljust(16)
        + "optical".rjust(22)
        + "whole".rjust(22)
        + f"optical minus {lowest}".rjust(26)
    ]
    good = []
    for name in rows:
        gaps = [paired(rows, name, gentlest, key) for key in mean] + [paired(rows, name, lowest, "optical_m")]
        lines.append(
            name.ljust(16)
            + "".join(format_interval(g, 1000, "+.2f").rjust(w) for g, w in zip(gaps, (22, 22, 26), strict=True))
        )
        if gaps[2][1] <= 0:
            good.append(name)
    choice = min(good, key=mean["whole_m"].get)
    lines.append(f"not measurably above the lowest optical error ({lowest}): {', '.join(good)}")
    lines.append(
        f"of these {choice} costs the whole frame least, "
        + ("as shipped" if choice == shipped else f"but {shipped} is shipped")
    )
    return "\n".join(lines)


def paired(rows: Mapping[str, Any], a: str, b: str, key: str) -> tuple[float, float, float]:
    """Return the paired difference of two rows of a study with its interval over scenes, in metres."""
    return paired_bootstrap(rows[a][key]["scenes"], rows[b][key]["scenes"])
