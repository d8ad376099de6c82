"""What a depth map is: metres, 0 = nothing read; the checks of depth and mask, and the way to a unit and back."""

import warnings

import numpy as np

MAX_DEPTH_M = 65.0  # 16-bit millimetres end at 65.535 m: readings beyond this are codes for "no reading"
MIN_DEPTH_M = 0.01  # no depth camera reads nearer: where most readings are, the unit is wrong
USUAL_M = (0.15, 5.0)  # where the median reading of an indoor frame lies; outside, a warning
MILLIMETRES = 0.001  # metres per unit
CHUNK = 2**20  # pixels that are worked on at a time: a large map is not held several times
UNITS = (  # in the order in which they are proposed
    (MILLIMETRES, "millimetres"),
    (0.01, "centimetres"),
    (0.1, "decimetres"),
    (0.0001, "tenths of a millimetre"),
    (1e-6, "micrometres"),
    (1000.0, "kilometres"),
)


def clean_depth(depth: np.ndarray) -> np.ndarray:
    """Return depth as float32 metres with NaN, infinite, negative and absurd readings set to 0 (missing).

    Masked pixels of a NumPy masked array are missing, too.
    """
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, that is missing
        depth = np.array(np.ma.filled(depth, 0), dtype=np.float32, order="C")
    flat = depth.reshape(-1)
    for start in range(0, flat.size, CHUNK):
        part = flat[start : start + CHUNK]
        part[~(np.isfinite(part) & (part > 0) & (part < MAX_DEPTH_M))] = 0
    return depth


def is_clean(depth: np.ndarray) -> bool:
    """Return whether :func:`clean_depth` would change nothing of an array."""
    return depth.dtype == np.float32 and all(((row >= 0) & (row < MAX_DEPTH_M)).all() for row in depth)


def check_unit(name: str, depth: np.ndarray, scale: float = 1.0) -> None:
    """Refuse depth that is no metres, and warn of depth that may be none.

    Depth whose borders were blended when it was resized holds some believable values whatever its unit; so most
    readings decide, not all.

    Args:
        name: what to call the depth in messages.
        depth: (H, W) in metres as claimed, before it is cleaned; not finite or at most 0 is missing.
        scale: metres per unit by which it was multiplied.

    Raises:
        ValueError: when the median reading lies beyond 65 m or nearer than 1 cm; the message names a likely unit.
    """
    depth = np.asarray(np.ma.filled(depth, 0))
    read = depth[np.isfinite(depth) & (depth > 0)]
    if not read.size:
        return
    median = float(np.median(read, overwrite_input=True))
    if MIN_DEPTH_M <= median < MAX_DEPTH_M:
        if not USUAL_M[0] <= median <= USUAL_M[1]:
            side = f"nearer than {USUAL_M[0]}" if median < USUAL_M[0] else f"farther than {USUAL_M[1]:g}"
            warnings.warn(f"most depth readings are {side} m: is their unit right (depth_scale)?", stacklevel=2)
        return
    wrong = f"beyond {MAX_DEPTH_M:g} m" if median >= MAX_DEPTH_M else f"nearer than {100 * MIN_DEPTH_M:g} cm"
    likely = [(s, unit) for s, unit in UNITS if USUAL_M[0] <= median / scale * s <= USUAL_M[1] and s != scale]
    advice = f"{likely[0][1]}? pass depth_scale={likely[0][0]:g}" if likely else "what is its unit? pass depth_scale"
    top = float(read.max()) / scale
    raise ValueError(f"{name}: most readings lie {wrong}, values up to {top:.6g} at {scale:g} m a unit: {advice}")


def depth_to_png(depth_m: np.ndarray, depth_scale: float = MILLIMETRES) -> np.ndarray:
    """Return (H, W) uint16 of a depth map in metres, in units of ``depth_scale`` metres, 0 staying 0."""
    depth_m = np.ascontiguousarray(depth_m)
    whole = np.empty(depth_m.shape, np.uint16)
    flat, stored = depth_m.reshape(-1), whole.reshape(-1)
    for start in range(0, flat.size, CHUNK):
        units = flat[start : start + CHUNK].astype(np.float64) / depth_scale
        stored[start : start + CHUNK] = np.clip(np.rint(units), 0, 65535)
    return whole


def upsample_sparse(depth: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return depth of lower resolution at the size of its colour picture, every reading at its place, 0 between.

    Nothing is interpolated: a reading stays what it was, on the pixel nearest to its own centre, and what lies between
    is missing, to be completed.

    Args:
        depth: (h, w) metres, 0 = missing, aligned to the picture.
        size: (H, W) of the picture.

    Raises:
        ValueError: when the picture is smaller, or of another shape by more than 2 %.
    """
    (height, width), (h, w) = size, depth.shape
    if h > height or w > width or abs(height * w / (width * h) - 1) > 0.02:
        raise ValueError(f"depth {depth.shape} cannot be brought to {tuple(size)}: it should be smaller, of like shape")
    rows = ((np.arange(h) + 0.5) * height / h).astype(int)
    columns = ((np.arange(w) + 0.5) * width / w).astype(int)
    large = np.zeros(size, depth.dtype)
    large[np.ix_(rows, columns)] = depth
    return large


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
