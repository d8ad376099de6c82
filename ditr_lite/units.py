"""What a depth map is: metres, 0 = nothing read; the checks of depth and mask, and the way to a unit and back.

Some mistakes leave a frame that can be completed, into nonsense: inverse depth, red and blue exchanged, raw depth and
truth exchanged. Where a frame shows one of them, a warning says so; nothing is refused, and silence proves nothing.
"""

import warnings
from collections.abc import Iterator

import numpy as np

MAX_DEPTH_M = 65.0  # 16-bit millimetres end at 65.535 m: readings beyond this are codes for "no reading"
MIN_DEPTH_M = 0.01  # no depth camera reads nearer: where most readings are, the unit is wrong
MAX_SAMPLES = 256  # draws of one frame: more would not fit into memory, and their mean would not change
MAX_SEED = 2**63 - 1
USUAL_M = (0.15, 5.0)  # where the median reading of an indoor frame lies; outside, a warning
NEIGHBOURHOOD = 5  # pixels a side, of a reading that may be a stray
STRAY_RATIO = 1.25  # a reading that differs from nearly all its neighbours by this factor belongs to no surface
MILLIMETRES = 0.001  # metres per unit
STRIP = 2**20  # pixels of a large map that are worked on at a time, so that no copy of the whole is needed
FEWEST = 300  # readings, or pixels, below which nothing is said about them
SURFACE = 0.005  # share of a value by which readings of a flat surface may leave it
FLATTER = 0.15  # share of the readings by which more lie on one plane when depth is taken for its inverse
LATTICE = (0.9, 0.98)  # share of a picture's colours that JPEG knows: fewer, and more with red and blue exchanged
LOSS = 0.2  # share of the region by which the truth has to show more loss than the raw depth to be taken for it
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


def strays(depth: np.ndarray) -> np.ndarray:
    """Find readings that belong to no surface: most readings around them differ by more than :data:`STRAY_RATIO`.

    They are hidden from the networks and given back in the end. A reading with few others around it cannot be judged,
    so sparse depth has no strays.

    Args:
        depth: (H, W) metres, 0 = missing.

    Returns:
        (H, W) bool.
    """
    half, found = NEIGHBOURHOOD // 2, np.zeros(depth.shape, bool)
    for rows in strips(depth.shape):
        around = depth[max(rows.start - half, 0) : rows.stop + half]
        first = rows.start - max(rows.start - half, 0)
        found[rows] = _strays(around)[first : first + rows.stop - rows.start]
    return found


def _strays(depth: np.ndarray) -> np.ndarray:
    valid = depth > 0
    logs = np.log(np.where(valid, depth, 1.0)).astype(np.float32)
    padded = np.pad(np.where(valid, logs, np.nan), NEIGHBOURHOOD // 2, constant_values=np.nan)
    alike = np.zeros(depth.shape, np.int16)
    read = np.zeros(depth.shape, np.int16)
    for dy, dx in np.ndindex(NEIGHBOURHOOD, NEIGHBOURHOOD):
        other = padded[dy : dy + depth.shape[0], dx : dx + depth.shape[1]]
        alike += np.abs(other - logs) < np.log(STRAY_RATIO)  # False for NaN
        read += ~np.isnan(other)
    enough = read > NEIGHBOURHOOD**2 // 3
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


def check_unit(name: str, depth: np.ndarray, scale: float | None = None) -> None:
    """Refuse depth that is no metres, and warn of depth that may be none.

    Depth whose borders were blended when it was resized holds some believable values whatever its unit; so most
    readings decide, not all.

    Args:
        name: what to call the depth in messages.
        depth: (H, W) in metres as claimed, before it is cleaned; not finite or at most 0 is missing.
        scale: metres per unit by which it was multiplied, an argument ``depth_scale``; None where there is none.

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
    used = scale or 1.0
    likely = [(s, unit) for s, unit in UNITS if USUAL_M[0] <= median / used * s <= USUAL_M[1] and s != used]
    do = "pass depth_scale=" if scale else "multiply it by "
    advice = f"{likely[0][1]}? {do}{likely[0][0]:g}" if likely else f"what is its unit? {do.rstrip('=')}"
    if not (likely or scale):
        advice = "what is its unit? metres are expected"
    top = float(read.max()) / used
    raise ValueError(f"{name}: most readings lie {wrong}, values up to {top:.6g} at {used:g} m a unit: {advice}")


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
    if rgb.ndim == 2 and depth.ndim == 3:
        raise ValueError(f"rgb: expected (H, W, 3), got {rgb.shape}, and depth {depth.shape}: the two are swapped")
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
    warn_of_mistakes(rgb, depth)
    return rgb, depth, region


def warn_of_mistakes(rgb: np.ndarray, depth: np.ndarray) -> None:
    """Warn where a picture shows that its red and blue are exchanged, or a depth map that it is inverse depth.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 metres, clean.
    """
    if looks_inverse(depth):
        warnings.warn(
            "depth looks like disparity or inverse depth: surfaces are flat in its values as they are, which those of "
            "metres are not; metres are focal length x baseline / disparity",
            stacklevel=3,
        )
    if looks_bgr(rgb):
        warnings.warn(
            "rgb looks like BGR: once JPEG, its colours fit that only with red and blue exchanged; turn their order "
            "round (rgb[..., ::-1])",
            stacklevel=3,
        )


def looks_inverse(depth: np.ndarray) -> bool:
    """Return whether a map holds disparity, or another inverse of depth, instead of depth.

    The inverse of a plane's depth is linear in pixel coordinates (1/z = a u + b v + c, of any pinhole camera), the
    depth itself is not. So a plane is sought in the map taken for depth, and in the map taken for inverse depth; of
    depth the second never holds many more readings than the first. Factor and offset of the disparity do not matter.

    It cannot be told where no plane fills a good part of the frame, where the largest is seen face on (then both are
    linear), or where readings are coarser than half a percent. Of the shipped scenes' depth, inverted, a bit more than
    half is recognised; of their depth as it is, nothing is taken for inverse.

    Args:
        depth: (H, W) float, 0 = missing, of any unit.
    """
    read = np.flatnonzero(depth > 0)
    if read.size < FEWEST:
        return False
    rng = np.random.default_rng(0)
    some = rng.choice(read, min(read.size, 1000), replace=False)
    rows, columns = np.unravel_index(some, depth.shape)
    values = depth.ravel()[some].astype(np.float64)
    steps = np.diff(np.unique(values))
    if not steps.size or np.median(steps) > SURFACE * np.median(values):
        return False
    where = np.stack([columns / depth.shape[1], rows / depth.shape[0], np.ones(some.size)], axis=1)  # (N, 3)
    return _on_a_plane(where, values, rng) > _on_a_plane(where, 1 / values, rng) + FLATTER


def _on_a_plane(where: np.ndarray, values: np.ndarray, rng: np.random.Generator) -> float:
    """Return the share of values (N,) that one linear function of ``where`` (N, 3) explains: RANSAC."""
    through = rng.integers(len(values), size=(100, 3))
    through = through[np.abs(np.linalg.det(where[through])) > 1e-4]  # of three points in a line nothing follows
    if not len(through):
        return 0.0
    planes = np.linalg.solve(where[through], values[through][..., None])[..., 0]  # (T, 3)
    near = np.abs(where @ planes.T - values[:, None]) < SURFACE * values[:, None]  # (N, T)
    on = near[:, near.sum(axis=0).argmax()]
    for _ in range(3):  # the plane of all that are on it, in place of that of three
        plane = np.linalg.lstsq(where[on] / values[on, None], np.ones(on.sum()), rcond=None)[0]
        again = np.abs(where @ plane - values) < SURFACE * values
        if again.sum() <= on.sum():
            break
        on = again
    return float(on.mean())


def looks_bgr(rgb: np.ndarray) -> bool:
    """Return whether a picture's channels are blue, green, red.

    JPEG stores whole numbers of brightness and two colour differences, and only about one colour in four comes out of
    them. Of a picture that was decoded from JPEG nearly every pixel does; with red and blue exchanged, few do. So it
    cannot be told of grey pictures, nor of those that never were JPEG or were resized or changed since. Their colours
    as such prove nothing: tables may be blue.

    Args:
        rgb: (H, W, 3) uint8.
    """
    pixels = rgb.reshape(-1, 3)
    pixels = pixels[:: max(1, len(pixels) // 8192)].astype(np.float64)
    unclipped = ((pixels > 0) & (pixels < 255)).all(axis=1)
    pixels = pixels[unclipped & (np.abs(pixels[:, 0] - pixels[:, 2]) > 8)]
    if len(pixels) < FEWEST:
        return False
    return _of_jpeg(pixels) < LATTICE[0] and _of_jpeg(pixels[:, ::-1]) > LATTICE[1]


def _of_jpeg(pixels: np.ndarray) -> float:
    """Return the share of colours (N, 3), red first, that whole numbers of Y, Cb, Cr give (JFIF, ITU-T T.871)."""
    red, green, blue = pixels.T
    luminance = 0.299 * red + 0.587 * green + 0.114 * blue
    y = np.rint(luminance)
    cb = np.rint((blue - luminance) / 1.772)
    cr = np.rint((red - luminance) / 1.402)
    green_again = y - (0.114 * 1.772 * cb + 0.299 * 1.402 * cr) / 0.587
    again = np.stack([y + 1.402 * cr, green_again, y + 1.772 * cb], axis=1)
    return float((np.abs(again - pixels) < 0.51).all(axis=1).mean())


def typical_ratio(depth: np.ndarray, truth: np.ndarray, region: np.ndarray | None) -> float:
    """Return the median of raw depth over truth outside the region, (H, W) each; 1 where both are known nowhere."""
    both = (depth > 0) & (truth > 0) & (True if region is None else ~region)
    return float(np.median(depth[both] / truth[both])) if both.any() else 1.0


def looks_swapped(depth: np.ndarray, truth: np.ndarray, region: np.ndarray) -> bool:
    """Return whether raw depth and truth are exchanged.

    Inside the region a sensor reads nothing, or what stands behind; the truth does neither. So the share of the region
    where the first map lacks what the second knows, or lies farther by more than a percent, less the share where it is
    the other way round, is positive when they are the right way round. It cannot be told without a region, or where the
    sensor lost little in it.

    Args:
        depth: (H, W) metres, 0 = missing; said to be raw.
        truth: (H, W) metres, 0 = unknown.
        region: (H, W) bool, transparent or reflective.
    """
    depth, truth = depth[region], truth[region]
    if depth.size < FEWEST:
        return False
    read, known = depth > 0, truth > 0
    both = read & known
    lost = (known & ~read) | (both & (depth > 1.01 * truth))
    reverse = (read & ~known) | (both & (truth > 1.01 * depth))
    return float(reverse.mean() - lost.mean()) > LOSS


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
