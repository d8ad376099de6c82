"""How well stage one does, class by class, and what its errors cost at the end.

Paper: Sec. IV-B, "the misclassified pixels can greatly harm the performance of the following depth inpainting stage";
Table IV has the two ends of it (no partition, no refinement). Here the two kinds of error are told apart.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np

from .. import metrics
from ..config import RefineConfig
from ..data import Sample
from ..evaluation.stage_one import mask_errors
from ..pipeline import Ditr


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
    rows = []
    for refine in settings:
        region = ditr.find_region(sample.rgb, sample.depth, refine=refine)[1]
        depth = ditr(sample.rgb, sample.depth, region, samples=1).depth
        rows.append({**mask_errors(region, sample.region), **_final(depth, sample)})
    return rows


def _final(depth: np.ndarray, sample: Sample) -> dict[str, float | None]:
    scores = metrics.evaluate(depth, sample.depth_gt, sample.region, sample.depth)
    return {f"{name}_m": scores[name] and scores[name]["rmse"] for name in ("optical", "whole")}
