"""What a depth map is: metres, 0 = nothing read; the checks of depth and mask, and the way to a unit and back."""

import warnings
from collections.abc import Iterator

import numpy as np

MAX_DEPTH_M = 65.0  # 16-bit millimetres end at 65.535 m: readings beyond this are codes for "no reading"
MIN_DEPTH_M = 0.01  # no depth camera reads nearer: where most readings are, the unit is wrong
MAX_SAMPLES = 256  # draws of one frame: more would not fit into memory, and their mean would not change
MAX_SEED = 2**63 - 1
USUAL_M = (0.15, 5.0)  # where the median reading of an indoor frame lies; outside, a warning
STRAY_RATIO = 1.25  # a reading that differs from nearly all its neighbours by this factor belongs to no surface
MILLIMETRES = 0.001  # metres per unit
STRIP = 2**20  # pixels of a large map that are worked on at a time, so that no copy of the whole is needed
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
    for start in range(0, flat.size, STRIP):
        part = flat[start : start + STRIP]
        part[~(np.isfinite(part) & (part > 0) & (part < MAX_DEPTH_M))] = 0
    return depth


def strips(shape: tuple[int, int]) -> Iterator[slice]:
    """Yield slices of rows that together cover a map of ``shape`` (H, W), each of an even number, but for the last."""
    rows = 2 * max(1, STRIP // (2 * max(1, shape[1])))
    for start in range(0, shape[0], rows):
        yield slice(start, min(start + rows, shape[0]))


def strays(depth: np.ndarray, window: int = 5) -> np.ndarray:
    """Find readings that belong to no surface: most readings around them differ by more than :data:`STRAY_RATIO`.

    They are hidden from the networks and given back in the end. A reading with few others around it cannot be judged,
    so sparse depth has no strays.

    Args:
        depth: (H, W) metres, 0 = missing.
        window: side of the neighbourhood in pixels, odd.

    Returns:
        (H, W) bool.
    """
    half, found = window // 2, np.zeros(depth.shape, bool)
    for rows in strips(depth.shape):
        around = depth[max(rows.start - half, 0) : rows.stop + half]
        first = rows.start - max(rows.start - half, 0)
        found[rows] = _strays(around, window)[first : first + rows.stop - rows.start]
    return found


def _strays(depth: np.ndarray, window: int) -> np.ndarray:
    valid = depth > 0
    logs = np.log(np.where(valid, depth, 1.0)).astype(np.float32)
    padded = np.pad(np.where(valid, logs, np.nan), window // 2, constant_values=np.nan)
    alike = np.zeros(depth.shape, np.int16)
    read = np.zeros(depth.shape, np.int16)
    for dy in range(window):
        for dx in range(window):
            other = padded[dy : dy + depth.shape[0], dx : dx + depth.shape[1]]
            alike += np.abs(other - logs) < np.log(STRAY_RATIO)  # False for NaN
            read += ~np.isnan(other)
    enough = read > window * window // 3
    return valid & enough & (alike - 1 < 0.2 * read)


def without_strays(depth: np.ndarray) -> np.ndarray:
    """Return depth (H, W) in metres as the networks see it: without its :func:`strays`, unless it has nothing else."""
    return np.where(readings_seen(depth), depth, 0).astype(np.float32)


def readings_seen(depth: np.ndarray) -> np.ndarray:
    """Return (H, W) bool, the readings of depth (H, W) that the networks see: not :func:`strays`, unless all are."""
    read = depth > 0
    left = read & ~strays(depth)
    return left if left.any() else read


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


def check_inputs(
    rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None, samples: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Check a frame and return it as arrays: its image, its depth as clean float32 metres, its region or None.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float metres; NaN, infinite, negative and absurd readings become 0, missing, as do masked pixels
            of a NumPy masked array.
        region: (H, W) bool, or None.
        samples: 1 to :data:`MAX_SAMPLES`.

    Raises:
        ValueError: naming what was expected, what came, and what to do.
    """
    rgb = _array("rgb", rgb)
    depth = _array("depth", depth)
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
    if not depth.size:
        raise ValueError(f"depth: expected at least one pixel, got {depth.shape}")
    region = None if region is None else _array("region", region)
    if region is not None and (region.shape != depth.shape or region.dtype != bool):
        raise ValueError(f"region: expected {depth.shape} bool, got {region.shape} {region.dtype}")
    check_count("samples", samples, 1, MAX_SAMPLES)
    check_unit("depth", depth)
    depth = depth if is_clean(depth) else clean_depth(depth)
    if not (depth > 0).any():
        raise ValueError(
            "depth holds no reading (all pixels are 0, negative or not finite); completion needs some depth"
        )
    return rgb, depth, region


def check_count(name: str, value: int, low: int, high: int) -> int:
    """Return a whole number, NumPy's too, as Python's after checking its limits.

    Raises:
        ValueError: for another kind of number, or one beyond the limits.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise ValueError(f"{name}: expected a whole number, got {value!r}")
    if value < low:
        raise ValueError(f"{name}: expected at least {low}, got {value}")
    if value > high:
        raise ValueError(f"{name}: expected at most {high}, got {value}")
    return int(value)


def _array(name: str, given: np.ndarray) -> np.ndarray:
    """Return what a caller gave as a plain array, masked pixels as 0."""
    try:
        return np.asarray(np.ma.filled(given, 0) if isinstance(given, np.ma.MaskedArray) else given)
    except (TypeError, ValueError, RuntimeError) as error:  # ragged lists, tensors of a GPU or with gradients
        raise ValueError(f"{name}: expected a NumPy array, got {type(given).__name__} ({error})") from None


def depth_to_png(depth_m: np.ndarray, depth_scale: float = MILLIMETRES) -> np.ndarray:
    """Return (H, W) uint16 of a depth map in metres, in units of ``depth_scale`` metres, 0 staying 0."""
    depth_m = np.ascontiguousarray(depth_m)
    whole = np.empty(depth_m.shape, np.uint16)
    flat, stored = depth_m.reshape(-1), whole.reshape(-1)
    for start in range(0, flat.size, STRIP):
        units = flat[start : start + STRIP].astype(np.float64) / depth_scale
        stored[start : start + STRIP] = np.clip(np.rint(units), 0, 65535)
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
