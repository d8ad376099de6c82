"""How well stage one does, class by class, and what its errors cost at the end.

Paper: Sec. IV-B, "the misclassified pixels can greatly harm the performance of the following depth inpainting stage";
Table IV has the two ends of it (no partition, no refinement). Here the two kinds of error are told apart.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np
import torch

from . import metrics
from .conditioning import depth_bounds, depth_tensors, fit, to_tensor
from .config import RefineConfig
from .data import REFLECTIVE, TRANSPARENT, Sample
from .pipeline import Ditr
from .region import refine_region

CLASSES = {"transparent": TRANSPARENT, "reflective": REFLECTIVE}
PER_CLASS = tuple(f"{figure}_{name}" for figure in ("iou", "recall") for name in CLASSES)


@torch.no_grad()
def class_map(ditr: Ditr, rgb: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return (H, W) uint8: 0 where no region is found, before refinement; else the likelier of the two classes.

    Args:
        ditr: whose stage one is asked.
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 metres, raw.
    """
    frame, bounds = fit(depth.shape, ditr.config.size), depth_bounds(depth)
    small = frame.into(depth)
    inputs = [t.to(ditr.device) for t in (to_tensor(frame.into(rgb)[None]), *depth_tensors(small, bounds))]
    p = ditr.parts["region"](*inputs)["logits"].softmax(dim=1)[0].cpu().numpy()  # (3, h, w)
    found = np.where(p[1:].sum(0) > 0.5, 1 + p[1:].argmax(0), 0)
    return sum(np.uint8(code) * frame.back(found == code) for code in CLASSES.values())


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


def offset_region(region: np.ndarray, pixels: int) -> np.ndarray:
    """Return a (H, W) bool region grown (pixels > 0) or shrunk (< 0) by that many pixels, diagonals included."""
    step = cv2.dilate if pixels > 0 else cv2.erode
    return step(region.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=abs(pixels)) > 0


def region_costs(ditr: Ditr, sample: Sample, offsets: Sequence[int]) -> list[dict[str, Any]]:
    """Complete a frame with its true region shrunk and grown, and say what each pixel's mistake costs.

    Args:
        ditr: the system; one draw a frame.
        sample: with ground truth and region.
        offsets: pixels, as :func:`offset_region` takes them.

    Returns:
        one row an offset: ``offset``; ``optical_m`` and ``whole_m``, RMSE; ``missed_m``, mean over the missed pixels of
        how much larger their error is than with the true region; ``discarded_m``, the same over readings outside it
        that were thrown away; None where there are none.

    Raises:
        ValueError: for a frame without truth, or without anything in its region.
    """
    if sample.depth_gt is None or sample.region is None or not sample.region.any():
        raise ValueError(f"{sample.name} lacks ground truth or a region: its errors cannot be priced")
    known, rows = sample.depth_gt > 0, []

    def error_of(region: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        depth = ditr(sample.rgb, sample.depth, region, samples=1).depth
        return depth, np.abs(depth - sample.depth_gt)

    depth_true, base = error_of(sample.region)
    for offset in offsets:
        region = offset_region(sample.region, offset)
        depth, error = error_of(region) if offset else (depth_true, base)
        missed = known & sample.region & ~region
        discarded = known & region & ~sample.region & (sample.depth > 0)
        row = {"offset": offset, **_final(depth, sample)}
        for name, pixels in {"missed_m": missed, "discarded_m": discarded}.items():
            row[name] = float((error - base)[pixels].mean()) if pixels.any() else None
        rows.append(row)
    return rows


def refinement_costs(ditr: Ditr, sample: Sample, settings: Iterable[RefineConfig]) -> list[dict[str, Any]]:
    """Complete a frame with the region that stage one finds, refined in several ways, at the working size.

    Returns:
        one row a setting: ``miss_rate``, ``area_ratio`` (to the true region, not refined), ``optical_m``, ``whole_m``.
    """
    frame = fit(sample.depth.shape, ditr.config.size)
    found = frame.into(class_map(ditr, sample.rgb, sample.depth)) > 0
    rows = []
    for r in settings:
        region = frame.back(refine_region(found, r.median, r.dilate, r.iterations) & frame.picture)
        depth = ditr(sample.rgb, sample.depth, region, samples=1).depth
        rows.append({**mask_errors(region, sample.region), **_final(depth, sample)})
    return rows


def mask_errors(region: np.ndarray, true: np.ndarray) -> dict[str, float | None]:
    """Return the share of the true region that is missed, and the area in true regions."""
    return {"miss_rate": metrics.miss_rate(region, true), "area_ratio": metrics.area_ratio(region, true)}


def _final(depth: np.ndarray, sample: Sample) -> dict[str, float | None]:
    scores = metrics.evaluate(depth, sample.depth_gt, sample.region, sample.depth)
    return {f"{name}_m": scores[name] and scores[name]["rmse"] for name in ("optical", "whole")}
