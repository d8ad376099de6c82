"""How well stage one does: the region that it finds, and each of the two classes.

Paper: Sec. IV-B, "the misclassified pixels can greatly harm the performance of the following depth inpainting stage".
"""

import numpy as np

from .. import metrics
from ..data import REFLECTIVE, TRANSPARENT, Sample
from ..pipeline import Completion, Ditr
from ..region import IGNORE
from ..windows import fit_frame

STAGE_ONE = ("iou", "miss_rate", "area_ratio")  # of every frame; PER_CLASS where the materials are known
CLASSES = {"transparent": TRANSPARENT, "reflective": REFLECTIVE}
PER_CLASS = tuple(f"{figure}_{name}" for figure in ("iou", "recall") for name in CLASSES)


def score_stage_one(out: Completion, sample: Sample, ditr: Ditr) -> dict[str, float | None] | None:
    """Return how well the region was found, of pixels that may be judged; None when it was given or is not known."""
    if out.probability is None or sample.region is None:
        return None
    frame = fit_frame(sample.depth.shape, ditr.config.size)
    refined = frame.back(ditr.refine(frame.into(sample.region)) & frame.picture)
    judged = np.full_like(sample.region, True) if sample.material is None else sample.material != IGNORE
    scores = {
        "iou": metrics.iou((out.probability > ditr.config.refine.threshold) & judged, sample.region),
        "miss_rate": metrics.miss_rate(out.region, sample.region),
        "area_ratio": metrics.area_ratio(out.region & judged, refined & judged),
    }
    if sample.material is not None and out.classes is not None:
        scores |= class_scores(out.classes, sample.material)
    return scores


def class_map(ditr: Ditr, rgb: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return (H, W) uint8: 0 where no region is found, before refinement; else the likelier of the two classes.

    Args:
        ditr: whose stage one is asked.
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 metres, raw.
    """
    return ditr.claim(rgb, depth).class_map()


def class_scores(found: np.ndarray, material: np.ndarray) -> dict[str, float | None]:
    """Return IoU and recall of each class.

    ``iou_*`` asks for the very class; ``recall_*`` is the share of its pixels found as *either*: the pipeline merges
    them, so a mirror called glass costs nothing. None where the class does not occur.

    Args:
        found: (H, W) codes as :func:`class_map` returns.
        material: (H, W) true codes.

    Raises:
        ValueError: for maps of different shapes.
    """
    if found.shape != material.shape:
        raise ValueError(f"found is {found.shape}, material {material.shape}: they should be alike")
    scores = dict.fromkeys(PER_CLASS)
    for name, code in CLASSES.items():
        if (material == code).any():
            scores[f"iou_{name}"] = metrics.iou(found == code, material == code)
            scores[f"recall_{name}"] = 1 - metrics.miss_rate(found > 0, material == code)
    return scores


def mask_errors(region: np.ndarray, true: np.ndarray) -> dict[str, float | None]:
    """Return the share of the true region that is missed, and the area in true regions."""
    return {"miss_rate": metrics.miss_rate(region, true), "area_ratio": metrics.area_ratio(region, true)}
