"""The open choices of stage two, one setting at a time: trained on the tiny system, judged on validation scenes.

The paper leaves most of them open. A tiny system trained for a minute tells which way a choice points and its price;
the shipped one was not trained a dozen times over. ``tools/setting_study.py`` runs it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..evaluation.statistics import SeedComparison, compare_seeds
from ..store import WEIGHTS
from .experiment import compare

RESULTS = WEIGHTS / "results_settings.json"
DEFAULT = "the default"
MANY = {"unet.anchor": "false", "sampler.steps": "10"}  # noise cannot be told from pure noise in a single step
SETTINGS: dict[str, dict[str, str]] = {
    "predicts x0, not what to add": {"unet.anchor": "false"},
    "predicts eps, 10 steps": {"sampler.prediction": "eps", **MANY},
    "predicts v, 10 steps": {"sampler.prediction": "v", **MANY},
    "cosine schedule": {"schedule.name": "cosine"},
    "no evidence": {"evidence": "false"},
    "the latent asks": {"unet.query": "latent"},
    "twice the width": {"unet.width": "16"},
    "no detail network": {"detail.width": "0"},
}
Row = dict[str, Any]


def run(
    settings: Mapping[str, Mapping[str, str]] = SETTINGS,
    seeds: Sequence[int] = (0, 1),
    save: Callable[[dict[str, Row]], None] = lambda rows: None,
    **how: Any,
) -> dict[str, Row]:
    """Try every setting with every seed.

    Args:
        settings: name -> dotted setting -> value.
        seeds: of training.
        save: called with the rows so far after every training.
        how: passed to :func:`studies.experiment.compare`: data, folder, limit, ...

    Returns:
        name -> ``settings``, ``seconds`` (of training, per seed) and ``rmse_m``: pixel set -> seed -> one value a frame
        or None; the first row is the default's.
    """
    rows: dict[str, Row] = {name: _row(chosen) for name, chosen in {DEFAULT: {}, **settings}.items()}
    for seed in seeds:
        for name, chosen in settings.items():
            result = compare(chosen, seed=seed, **how)
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
