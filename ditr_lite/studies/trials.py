"""What was tried and what was chosen: every comparison on validation scenes that the committed results hold.

Winners alone would hide what they cost and how near the others came. Paper: no table of this kind is given.

The open choices of stage two are tried here, one setting at a time, on the tiny system: the paper leaves most of them
open. A tiny system trained for a minute tells which way a choice points and its price; the shipped one was not trained
a dozen times over. ``tools/setting_study.py`` runs it.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..config import from_dict, override, preset
from ..evaluation.costs import costs
from ..evaluation.results import read
from ..evaluation.statistics import SeedComparison, compare_seeds, format_interval, mean_known, paired_bootstrap
from ..store import WEIGHTS, read_card
from .experiment import compare_settings, home_of

DEFAULT = "the default"
MANY = {"unet.anchor": "false", "sampler.steps": "10"}  # noise cannot be told from pure noise in a single step
SETTINGS: dict[str, dict[str, str]] = {
    "predicts x0, not what to add": {"unet.anchor": "false"},
    "predicts eps, 10 steps": {"sampler.prediction": "eps", **MANY},
    "predicts v, 10 steps": {"sampler.prediction": "v", **MANY},
    "Eq. 8 as the paper has it, 10 steps": {"sampler.objective": "eq8", **MANY},
    "cosine schedule": {"schedule.name": "cosine"},
    "no evidence": {"evidence": "false"},
    "the latent asks": {"unet.query": "latent"},
    "twice the width": {"unet.width": "16"},
    "no detail network": {"detail.width": "0"},
}
Row = dict[str, Any]


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
    factors, region, settings = (read(name, folder) for name in ("factors", "region", "settings"))
    shipped = 2 ** len(from_dict(read_card(folder)["config"]).autoencoder.multipliers)
    found = []
    for row in factors["rows"]:
        price = f"{row['step_flop'] / 1e9:.1f} GFLOP/step"
        error, name = row["floor"]["rmse_m"]["optical"][0], f"factor {row['factor']}"
        found.append(Trial("autoencoder", name, error, row["factor"] == shipped, price, factors["command"]))
    for name, row in region["refinement"].items():
        price = f"whole frame {1000 * row['whole_m']['mean'][0]:.1f} mm"
        error = row["optical_m"]["mean"][0]
        found.append(Trial("refinement", name, error, name == region["shipped"], price, region["command"]))
    tuning = region["finetuning"]
    before = {k: mean_known(tuning["before"][k]) for k in ("optical_m", "whole_m")}
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
        price = f"{sum(r['gflops'] * r['calls'] for r in operations):.2f} GFLOP/frame"
        if name != DEFAULT:
            said = "clear" if gain.clear else "not clear"
            price += f"; {said}; geometric {1000 * other.mean:+.1f} mm"
        error = float(errors(row).mean())
        found.append(Trial("stage two, tiny", name, error, name == DEFAULT, price, settings["command"]))
    return found


def try_settings(
    settings: Mapping[str, Mapping[str, str]] = SETTINGS,
    seeds: Sequence[int] = (0, 1),
    save: Callable[[dict[str, Row]], None] = lambda rows: None,
    folder: Path | str = "outputs/weights",
    **how: Any,
) -> dict[str, Row]:
    """Try every setting with every seed.

    Args:
        settings: name -> dotted setting -> value.
        seeds: of training.
        save: called with the rows so far after every training.
        folder: the arms of the first seed go there, those of another to ``seed_N`` in it.
        how: passed to :func:`studies.experiment.compare_settings`: data, limit, ...

    Returns:
        name -> ``settings``, ``seconds`` (of training, per seed) and ``rmse_m``: pixel set -> seed -> one value a frame
        or None; the first row is the default's.
    """
    rows: dict[str, Row] = {name: _row(chosen) for name, chosen in {DEFAULT: {}, **settings}.items()}
    for seed in seeds:
        home = home_of(folder, seed, seeds)
        for name, chosen in settings.items():
            result = compare_settings(chosen, seed=seed, folder=home, **how)
            for row, arm in ((DEFAULT, "default"), (name, "changed")):
                if row == DEFAULT and len(rows[row]["seconds"]) > seeds.index(seed):
                    continue  # the same weights as in the comparison before
                rows[row]["seconds"].append(round(result["seconds"][arm], 1))
                for key, values in result["rmse_m"][arm].items():
                    rows[row]["rmse_m"].setdefault(key, []).append(values)
            save(rows)
    return rows


def against_default(rows: Mapping[str, Row], name: str, key: str = "optical") -> SeedComparison:
    """Return how a setting compares with the default, in metres, over the frames that hold such pixels."""
    return compare_seeds(errors(rows[name], key), errors(rows[DEFAULT], key))


def errors(row: Row, key: str = "optical") -> np.ndarray:
    """Return a row's RMSE (S, N) in metres: seeds by frames, without the frames that hold no such pixel."""
    seen = np.array(row["rmse_m"][key], dtype=np.float64)  # None becomes NaN; a frame has none under any seed
    return seen[:, ~np.isnan(seen).any(axis=0)]


def _row(settings: Mapping[str, str]) -> Row:
    return {"settings": dict(settings), "seconds": [], "rmse_m": {}}


def format_trials(found: Sequence[Trial]) -> str:
    """Return the table, and per part whether what was chosen has the lowest optical error."""
    lines = [f"{'part':15} {'setting':39}{'optical mm':>11}  what else it cost; is the difference clear?"]
    for t in found:
        lines.append(f"{t.part:15} {t.setting:39}{1000 * t.optical_m:11.1f}  {t.price}{' <- chosen' * t.chosen}")
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
