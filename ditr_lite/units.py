"""What a depth map is: metres, 0 = nothing read; the checks of depth and mask, and the way to millimetres and back."""

import numpy as np

MAX_DEPTH_M = 65.0  # 16-bit millimetres end at 65.535 m: readings beyond this are codes for "no reading"


def clean_depth(depth: np.ndarray) -> np.ndarray:
    """Return depth as float32 metres with NaN, infinite, negative and absurd readings set to 0 (missing)."""
    depth = np.array(depth, dtype=np.float32)
    depth[~(np.isfinite(depth) & (depth > 0) & (depth < MAX_DEPTH_M))] = 0
    return depth


def depth_to_png(depth_m: np.ndarray) -> np.ndarray:
    """Return (H, W) uint16 millimetres of a depth map in metres, 0 staying 0."""
    return np.clip(np.rint(depth_m * 1000.0), 0, 65535).astype(np.uint16)


def check_metres(depth_m: np.ndarray) -> np.ndarray:
    """Return ``depth_m`` when it is a clean depth map, (H, W) floats in metres, finite and >= 0.

    Raises:
        ValueError: when it is not.
    """
    depth_m = np.asarray(depth_m)
    if depth_m.ndim != 2 or depth_m.dtype.kind != "f":
        raise ValueError(f"depth should be (H, W) floating-point metres, got {depth_m.shape} {depth_m.dtype}")
    if not np.isfinite(depth_m).all() or (depth_m < 0).any():
        raise ValueError("depth holds NaN, infinite or negative values: 0 means missing; see units.clean_depth")
    return depth_m


def check_depth(name: str, depth: np.ndarray, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """Return ``depth`` as float32 after checking that it is a depth map: (H, W) floating-point metres, 0 = missing.

    Args:
        name: what to call it in the message.
        depth: the array to check.
        shape: the shape it should have; None for any (H, W).

    Raises:
        ValueError: for another shape, an integer dtype, negative or non-finite values.
    """
    depth = np.asarray(depth)
    if depth.ndim != 2 or (shape is not None and depth.shape != tuple(shape)):
        expected = "(H, W)" if shape is None else str(tuple(shape))
        raise ValueError(f"{name} should have shape {expected}, got {depth.shape}; resize it with nearest neighbour")
    if not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(f"{name} should be floating-point metres, got {depth.dtype}; divide millimetres by 1000.0")
    if not (np.isfinite(depth) & (depth >= 0)).all():
        raise ValueError(f"{name} has negative or non-finite values; call units.clean_depth first (0 means missing)")
    return depth.astype(np.float32, copy=False)


def check_mask(name: str, mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return ``mask`` after checking that it is bool and has this shape.

    Raises:
        ValueError: when it is not.
    """
    mask = np.asarray(mask)
    if mask.dtype != bool or mask.shape != tuple(shape):
        raise ValueError(f"{name} should be bool {tuple(shape)}, got {mask.dtype} {mask.shape}; use mask > 0")
    return mask
