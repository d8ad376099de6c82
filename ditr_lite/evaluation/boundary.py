"""Score every boundary backend, and OpenCV's Canny, against the exact outlines of rendered scenes.

Truth for M_RGB: the outlines of all objects. Truth for M_D and M_DA: those at which true depth jumps (by a centimetre).
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..boundary import Backend, boundaries_from_labels, boundary_maps, get_backend, precision_recall_f, true_maps
from ..data import TRANSPARENT, Sample
from .statistics import bootstrap_mean, interval, paired_bootstrap

CANNY = {"sigma": (0.0, 1.0, 1.5, 2.0, 3.0), "high": (30, 60, 90, 120, 180, 250, 350), "ratio": (0.3, 0.5, 0.8)}
MAPS = ("m_rgb", "m_d", "m_da")
COLUMNS = ("precision", "recall", "f", "glass_recall")


def canny(rgb: np.ndarray, sigma: float, high: float, ratio: float) -> np.ndarray:
    """Return OpenCV's Canny map (H, W) bool of the grey image, blurred by ``sigma``; the low threshold is a share."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    grey = cv2.GaussianBlur(grey, (0, 0), sigma) if sigma else grey
    return cv2.Canny(grey, ratio * high, high, L2gradient=True) > 0


def tune_canny(samples: Sequence[Sample], tolerance: float = 1) -> dict[str, float]:
    """Return the settings of :func:`canny` with the highest mean F for M_RGB on ``samples``."""
    truths = [boundaries_from_labels(s.instances) for s in samples]

    def mean_f(values: tuple) -> float:
        found = (canny(s.rgb, *values) for s in samples)
        return float(np.nanmean([precision_recall_f(f, t, tolerance)[2] for f, t in zip(found, truths, strict=True)]))

    return dict(zip(CANNY, max(product(*CANNY.values()), key=mean_f), strict=True))


def score_backends(
    samples: Iterable[Sample], backends: Mapping[str, Backend], settings: Mapping[str, float], tolerance: float = 1
) -> dict[str, dict[str, dict[str, list]]]:
    """Score every map of every backend on every frame.

    Args:
        samples: frames with instances and true depth.
        backends: by name.
        settings: of :func:`canny`, which finds M_RGB only.
        tolerance: pixels.

    Returns:
        map (of :data:`MAPS`) -> backend -> frame -> values of :data:`COLUMNS`, the last being the recall on the
        outlines of transparent objects; None where there is nothing to divide by.
    """
    scores: dict[str, dict[str, dict[str, list]]] = {m: {b: {} for b in backends} for m in MAPS}
    scores["m_rgb"]["canny"] = {}
    for sample in samples:
        outline, jumps = true_maps(sample)
        truths = {"m_rgb": outline, "m_d": jumps, "m_da": jumps}
        glass = sample.material == TRANSPARENT
        maps = {name: boundary_maps(sample.rgb, sample.depth, backend) for name, backend in backends.items()}
        found = [(m, b, three[k]) for b, three in maps.items() for k, m in enumerate(MAPS)]
        for m, b, pred in [*found, ("m_rgb", "canny", canny(sample.rgb, **settings))]:
            of_glass = precision_recall_f(pred, truths[m] & glass, tolerance)[1]
            row = (*precision_recall_f(pred, truths[m], tolerance), of_glass)
            scores[m][b][sample.name] = [None if np.isnan(v) else round(float(v), 4) for v in row]
    return scores


def summarise(scores: Mapping[str, Mapping[str, Mapping[str, list]]], best: str = "learned") -> dict[str, dict]:
    """Return per map and backend the mean over frames of each score with its 95 % interval, and F of ``best`` minus F.

    An empty map has no precision: such frames are left out of that mean. Their F, 0, stays in.
    """
    table: dict[str, dict] = {}
    for m, backends in scores.items():
        for b, rows in backends.items():
            columns = dict(zip(COLUMNS, zip(*rows.values(), strict=True), strict=True))
            entry = {k: interval(bootstrap_mean, v, digits=4) for k, v in columns.items()}
            if b != best and best in backends:
                entry["f_gain"] = interval(
                    paired_bootstrap, [r[2] for r in backends[best].values()], columns["f"], digits=4
                )
            table.setdefault(m, {})[b] = entry
    return table


def bench(
    samples: Iterable[Sample],
    tuning: Iterable[Sample],
    tolerance: float = 1,
    weights: Path | str | None = None,
    sam: Path | str | None = None,
) -> dict[str, Any]:
    """Return what ``bench-boundary`` finds: Canny's settings, summary, F of each frame.

    Args:
        samples: frames to score on.
        tuning: frames on which Canny is tuned.
        tolerance: pixels.
        weights: folder of the learned backend's weights; None for the shipped one.
        sam: folder of a SAM checkpoint; None leaves ``sam`` out.

    Raises:
        ValueError: for weights that cannot be used, or a negative tolerance.
    """
    backends = {"classical": get_backend("classical"), "learned": get_backend("learned", weights)}
    if sam is not None:
        backends["sam"] = get_backend("sam", sam)
    settings = tune_canny(list(tuning), tolerance)
    scores = score_backends(samples, backends, settings, tolerance)
    return {
        "tolerance_px": tolerance,
        "canny": settings,
        "summary": summarise(scores),
        "f": {m: {b: {n: r[2] for n, r in rows.items()} for b, rows in each.items()} for m, each in scores.items()},
    }


def format_scores(summary: Mapping[str, Mapping[str, Mapping[str, list | None]]]) -> str:
    """Return the summary as a table for the terminal."""
    lines = [f"{'map':6} {'backend':10}" + "".join(f"{c:>14}" for c in COLUMNS) + f"{'F: learned -':>25}"]
    for m, backends in summary.items():
        for b, entry in backends.items():
            cells = "".join(f"{'-' if entry[c] is None else f'{entry[c][0]:.3f}':>14}" for c in COLUMNS)
            gain = entry.get("f_gain")
            gain = f"{gain[0]:+.3f} [{gain[1]:+.3f}, {gain[2]:+.3f}]" if gain else ""
            lines.append(f"{m:6} {b:10}{cells}{gain:>25}")
    return "\n".join(lines)
