"""The edges of the system: what a frame must be to be completed, how the branches are composed, what is returned."""

from dataclasses import dataclass

import numpy as np

from .config import StdConfig
from .units import clean_depth


@dataclass(frozen=True)
class Completion:
    """What :class:`pipeline.Ditr` returns; all maps have the size of the input.

    Attributes:
        depth: (H, W) float32 metres, dense.
        region: (H, W) bool, after refinement (the caller's, if one was given).
        std: (H, W) float32 metres, the error to expect (one standard deviation), see :func:`expected_error`; 0 where
            depth was kept.
        boundary_rgb, boundary_depth, boundary_da: (H, W) bool, M_RGB, M_D and M_DA.
        probability: (H, W) float32, stage one's belief before threshold and refinement; None for a given region.
        optical, geometric: (H, W) float32 metres, each branch's own repainting before composition.
    """

    depth: np.ndarray
    region: np.ndarray
    std: np.ndarray
    boundary_rgb: np.ndarray
    boundary_depth: np.ndarray
    boundary_da: np.ndarray
    probability: np.ndarray | None
    optical: np.ndarray
    geometric: np.ndarray


def compose(depth: np.ndarray, optical: np.ndarray, geometric: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Return the composed depth: the optical branch inside the region, the geometric one in holes, the rest kept.

    Paper: Sec. IV-A, "inside the mask, the depth values are re-estimated [...] outside the mask, the missing depth
    values are re-generated, and the original depth values are kept".

    Args:
        depth: (H, W) float32 raw metres, 0 = missing.
        optical: (H, W) float32 metres, dense.
        geometric: (H, W) float32 metres, dense.
        region: (H, W) bool.
    """
    return np.where(region, optical, np.where(depth > 0, depth, geometric)).astype(np.float32)


def expected_error(
    spread: np.ndarray, depth: np.ndarray, kept: np.ndarray, region: np.ndarray, config: StdConfig
) -> np.ndarray:
    """Return the error to expect of the mean of samples: their spread, scaled, and what no spread shows.

    Samples of one denoiser agree where it has learnt to be wrong: their spread alone understates the error. Per branch
    sqrt((base * depth)^2 + (factor * spread)^2), with constants that ``tools/calibrate.py`` fits on validation scenes.

    Args:
        spread: (H, W) metres, standard deviation over samples; 0 of a single one.
        depth: (H, W) metres, their mean.
        kept: (H, W) bool, pixels that were not painted: 0.
        region: (H, W) bool, painted by the optical branch.
        config: the constants.

    Returns:
        (H, W) float32 metres.
    """
    share, times = (np.where(region, *pair) for pair in (config.base, config.factor))
    return np.where(kept, 0, np.hypot(share * depth, times * spread)).astype(np.float32)


def check_inputs(
    rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None, samples: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Check a frame and return it as arrays: its image, its depth as clean float32 metres, its region or None.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float metres; NaN, infinite, negative and absurd readings become 0, missing.
        region: (H, W) bool, or None.
        samples: at least 1.

    Raises:
        ValueError: naming what was expected, what came, and what to do.
    """
    rgb, depth = np.asarray(rgb), np.asarray(depth)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise ValueError(
            f"rgb: expected (H, W, 3) uint8, got {rgb.shape} {rgb.dtype}; convert grey or RGBA images to RGB"
        )
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(
            f"depth: expected (H, W) float metres, got {depth.shape} {depth.dtype}; divide millimetres by 1000"
        )
    if rgb.shape[:2] != depth.shape:
        raise ValueError(f"rgb is {rgb.shape[:2]} and depth {depth.shape}: align depth to the RGB image first")
    region = None if region is None else np.asarray(region)
    if region is not None and (region.shape != depth.shape or region.dtype != bool):
        raise ValueError(f"region: expected {depth.shape} bool, got {region.shape} {region.dtype}")
    if samples < 1:
        raise ValueError(f"samples: expected at least 1, got {samples}")
    depth = clean_depth(depth)
    if not (depth > 0).any():
        raise ValueError(
            "depth holds no reading (all pixels are 0, negative or not finite); completion needs some depth"
        )
    return rgb, depth, region
