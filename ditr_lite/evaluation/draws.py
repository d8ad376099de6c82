"""Many draws of one frame: what RMSE hides when steps are cut, and whether the spread of the draws can be trusted.

Paper: Sec. V-B scores one map per frame by its distance to the truth, for which a mean is the best answer. Draws can
be asked more: whether surfaces keep their edges, whether the truth lies among them, whether doubt goes with error.
"""

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from .. import metrics
from ..boundary import boundary_maps
from ..conditioning import depth_bounds, fit
from ..data import Sample
from ..pipeline import Ditr, compose

JUMP_M, CLEAR_M = 0.04, 0.01  # what is a depth edge, and how far from both surfaces a pixel must hang to fly
SCORES = {  # name -> what it says, and whether less is better
    "mean_mm": ("optical RMSE of the draws' mean, mm", True),
    "single_mm": ("of a single draw, mm", True),
    "crps_mm": ("CRPS, mm", True),
    "flying_mean": ("pixels at depth edges that fly, mean, %", True),
    "flying_single": ("the same of a single draw, %", True),
    "coverage": ("truths between lowest and highest draw, %", False),
}


@torch.no_grad()
def draw_frame(ditr: Ditr, sample: Sample, steps: int, count: int = 4, seed: int = 0) -> np.ndarray:
    """Return ``count`` completions of a frame with its true region, (S, H, W) metres: those whose mean Ditr returns.

    Raises:
        ValueError: for a frame without a region.
    """
    if sample.region is None:
        raise ValueError(f"{sample.name} has no true region: draws are compared where it is known")
    frame, bounds = fit(sample.depth.shape, ditr.config.size), depth_bounds(sample.depth)
    small_rgb, small, region = (frame.into(a) for a in (sample.rgb, sample.depth, sample.region))
    maps = frame.on_picture(boundary_maps, small_rgb, small, backend=ditr.backend)
    both = ditr.inpaint(small_rgb, small, region, maps, bounds, steps, count, seed)
    drawn = (compose(sample.depth, frame.back(o), frame.back(g), sample.region) for o, g in zip(*both, strict=True))
    return np.stack(list(drawn))


def flying_share(depth: np.ndarray, truth: np.ndarray, region: np.ndarray) -> float | None:
    """Return what share, in per cent, of the region's pixels at depth edges hang between the two surfaces.

    Args:
        depth: (H, W) metres.
        truth: (H, W) metres.
        region: (H, W) bool.

    Returns:
        None for a region without a depth edge of :data:`JUMP_M` within two pixels.
    """
    near, far = (extreme(truth, np.ones((5, 5), np.uint8)) for extreme in (cv2.erode, cv2.dilate))
    edge = (far - near > JUMP_M) & region & (near > 0)
    between = (depth > near + CLEAR_M) & (depth < far - CLEAR_M) & (np.abs(depth - truth) > CLEAR_M)
    return float(100 * between[edge].mean()) if edge.any() else None


def draw_scores(members: np.ndarray, sample: Sample) -> dict[str, float | None]:
    """Return the figures of :data:`SCORES` of draws (S, H, W) of a frame, inside its region."""
    truth, region, mean = sample.depth_gt, sample.region, members.mean(axis=0)
    known = region & (truth > 0)
    covered = (members.min(axis=0) <= truth) & (truth <= members.max(axis=0))
    flying = [flying_share(m, truth, region) for m in members]
    return {
        "mean_mm": 1000 * metrics.rmse(mean, truth, region),
        "single_mm": 1000 * float(np.mean([metrics.rmse(m, truth, region) for m in members])),
        "crps_mm": 1000 * metrics.crps(members, truth, region),
        "flying_mean": flying_share(mean, truth, region),
        "flying_single": None if None in flying else float(np.mean(flying)),
        "coverage": float(100 * covered[known].mean()),
    }


def spread_and_error(drawn: Sequence[np.ndarray], samples: Sequence[Sample]) -> tuple[np.ndarray, np.ndarray]:
    """Return the spread (N,) of the draws and the signed error (N,) of their mean, metres, of all region pixels."""
    parts = []
    for members, sample in zip(drawn, samples, strict=True):
        known = sample.region & (sample.depth_gt > 0)
        parts.append((members.std(axis=0, ddof=1)[known], (members.mean(axis=0) - sample.depth_gt)[known]))
    spread, error = (np.concatenate(values) for values in zip(*parts, strict=True))
    return spread, error


def reliability(spread: np.ndarray, error: np.ndarray, bins: int = 8) -> np.ndarray:
    """Return (2, bins): root mean square spread and error of bins of equal count, smallest spread first.

    Calibrated draws have both alike in every bin. Pixels that do not fill the last bin are left out.

    Raises:
        ValueError: for lists of different lengths, or fewer pixels than bins.
    """
    if spread.shape != error.shape or bins < 1 or spread.size < bins:
        raise ValueError(f"expected spread and error of the same pixels, at least {bins}: {spread.shape} {error.shape}")
    order = np.argsort(spread, kind="stable")[: spread.size // bins * bins]
    return np.sqrt((np.stack([spread, error])[:, order].reshape(2, bins, -1) ** 2).mean(axis=2))


def rejection(score: np.ndarray, error: np.ndarray, kept: Sequence[float]) -> np.ndarray:
    """Return the RMSE of what is left when the pixels with the largest ``score`` are dropped, per share ``kept``.

    With the spread as score: what doubt is worth. With |error| as score: the best that any doubt could be worth.
    """
    square = error[np.argsort(score, kind="stable")].astype(np.float64) ** 2
    running = np.cumsum(square) / np.arange(1, len(square) + 1)
    return np.sqrt(running[[max(1, round(share * len(square))) - 1 for share in kept]])
