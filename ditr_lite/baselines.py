"""What else one could do: simple completions in the big one's call shape, ``f(rgb, depth, region) -> dense depth``.

Each stands for an idea, not for any published system. Except where a name says ``keep`` or ``raw``, readings inside the
region are thrown away, as we read the paper (Paper: Sec. IV-A), and it is filled from what surrounds it. Readings that
are kept come back bit for bit.
"""

from collections.abc import Callable, Iterable

import cv2
import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from .data import Sample
from .units import check_depth, check_mask

Fill = Callable[[np.ndarray, np.ndarray, np.ndarray | None], np.ndarray]

# How much too far a surviving in-region reading is on average: measure_bias over 600 rendered training scenes, seeds 0
# to 627. tools/data_card.py measures it anew over the training scenes that are there.
TRAIN_BIAS_M = 0.041
MIN_DEPTH_M = 0.01  # a reading less the bias never comes nearer than this, or than the reading itself
SCALES = (1, 2, 4, 8, 16)  # joint_bilateral: pixels between the taps of its 7 x 7 window, scale by scale
COLOUR_SIGMA = 20.0  # joint_bilateral: grey values (of 255) at which two colours count as different
ENOUGH = 1.0  # joint_bilateral: weight, in taps of the same colour close by, below which a pixel waits for more


def raw(rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
    """Return the sensor's own depth, right or wrong; what is missing gets the nearest reading, as scores need a number.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) metres, 0 = missing.
        region: (H, W) bool, ignored here.

    Returns:
        (H, W) float32 metres, dense.

    Raises:
        ValueError: for shapes and dtypes that do not fit, or no reading at all.
    """
    depth, _ = _checked(rgb, depth, region)
    return _nearest(depth)


def nearest(rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
    """Fill the region and the holes with the nearest reading outside; arguments and result as in :func:`raw`.

    Raises:
        ValueError: as :func:`raw`, and when there is no reading outside the region.
    """
    return _nearest(_outside(*_checked(rgb, depth, region)))


def navier_stokes(rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
    """Fill the region and the holes with OpenCV's fluid-dynamics inpainting; arguments as in :func:`nearest`.

    Depth goes in as float32 millimetres: 8 bits would round it to centimetres, and OpenCV's constants expect numbers of
    image-like size. (In OpenCV 5.0 its other method, Telea's, returns nonsense on float metres.)
    """
    known = _outside(*_checked(rgb, depth, region))
    holes = known == 0
    filled = cv2.inpaint(known * np.float32(1000), holes.astype(np.uint8), 3, cv2.INPAINT_NS) / np.float32(1000)
    return np.where(holes, filled, known)  # * 1000 / 1000 rounds: put the readings back


def harmonic(rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
    """Fill the region and the holes with the smoothest membrane through the readings around them.

    Solves Laplace's equation on the unknown pixels with the readings as boundary values and no flow through the image
    border. It continues a plane exactly across an inner hole and never leaves the range of the readings. Arguments as
    in :func:`nearest`. Solved directly: tenths of a second at 256 x 192, seconds at 1280 x 720.
    """
    return _harmonic(_outside(*_checked(rgb, depth, region)))


def joint_bilateral(rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
    """Fill the region and the holes with readings nearby that have a similar colour; arguments as in :func:`nearest`.

    A 7 x 7 window, its taps ever farther apart, weighs readings by distance and colour. A pixel that has collected too
    little weight waits for the next scale; those left after the last get the nearest value.
    """
    filled = _outside(*_checked(rgb, depth, region)).copy()
    colour = rgb.astype(np.float32)
    for scale in SCALES:
        reach = cv2.distanceTransform((filled == 0).astype(np.uint8), cv2.DIST_C, 3) <= 3 * scale  # has a tap in reach
        rows, cols = np.nonzero((filled == 0) & reach)
        total, weight = np.zeros(len(rows), np.float32), np.zeros(len(rows), np.float32)
        for dy, dx in np.ndindex(7, 7):
            y, x = rows + scale * (dy - 3), cols + scale * (dx - 3)
            inside = (y >= 0) & (y < filled.shape[0]) & (x >= 0) & (x < filled.shape[1])
            y, x = np.where(inside, y, rows), np.where(inside, x, cols)  # itself unknown: weight 0
            unlike = ((colour[y, x] - colour[rows, cols]) ** 2).sum(axis=1) / (2 * COLOUR_SIGMA**2)
            far = ((dy - 3) ** 2 + (dx - 3) ** 2) / (2 * 1.5**2)
            tap = np.exp(-unlike - np.float32(far)) * (filled[y, x] > 0)
            total += tap * filled[y, x]
            weight += tap
        done = weight > ENOUGH
        filled[rows[done], cols[done]] = total[done] / weight[done]
    return _nearest(filled)


def keep_and_fill(rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
    """Keep every reading, those inside the region too, and fill the holes harmonically; arguments as in :func:`raw`.

    Surviving in-region readings of real sensors are often only centimetres too far, which beats any fill from outside.
    """
    depth, _ = _checked(rgb, depth, region)
    return _harmonic(depth)


def keep_and_fill_debiased(rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
    """Do as :func:`keep_and_fill` after taking TRAIN_BIAS_M, measured on the training split, off in-region readings."""
    depth, region = _checked(rgb, depth, region)
    corrected = np.minimum(depth, np.maximum(depth - np.float32(TRAIN_BIAS_M), np.float32(MIN_DEPTH_M)))
    return _harmonic(np.where(region & (depth > 0), corrected, depth))


REGISTRY: dict[str, Fill] = {
    "raw": raw,
    "nearest": nearest,
    "navier_stokes": navier_stokes,
    "harmonic": harmonic,
    "joint_bilateral": joint_bilateral,
    "keep_and_fill": keep_and_fill,
    "keep_and_fill_debiased": keep_and_fill_debiased,
}


def measure_bias(samples: Iterable[Sample]) -> float:
    """Return by how many metres surviving in-region readings are too far: the value to put into TRAIN_BIAS_M.

    Args:
        samples: the training split; samples without ground truth, region or in-region readings are passed over.

    Returns:
        The mean over samples of the mean of raw - ground truth, metres; positive when readings are too far.

    Raises:
        ValueError: when no sample has in-region readings with ground truth.
    """
    biases = []
    for sample in samples:
        if sample.depth_gt is None or sample.region is None:
            continue
        valid = sample.region & (sample.depth > 0) & (sample.depth_gt > 0)
        if valid.any():
            biases.append(float(np.mean(sample.depth[valid] - sample.depth_gt[valid], dtype=np.float64)))
    if not biases:
        raise ValueError("no sample has in-region readings with ground truth; give samples of the training split")
    return float(np.mean(biases))


def _checked(rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return float32 depth with at least one reading, and a bool region, both (H, W)."""
    depth = check_depth("depth", depth)
    rgb = np.asarray(rgb)
    if rgb.shape != (*depth.shape, 3) or rgb.dtype != np.uint8:
        raise ValueError(f"rgb should be uint8 {(*depth.shape, 3)} like depth, got {rgb.dtype} {rgb.shape}; convert it")
    if not depth.any():
        raise ValueError(
            "depth has no reading at all (0 everywhere): nothing to fill from; check the file or its scale"
        )
    return depth, np.zeros(depth.shape, bool) if region is None else check_mask("region", region, depth.shape)


def _outside(depth: np.ndarray, region: np.ndarray) -> np.ndarray:
    known = np.where(region, np.float32(0), depth)
    if not known.any():
        raise ValueError(
            "no reading outside the region: nothing to fill it from; give a smaller region or use keep_and_fill"
        )
    return known


def _nearest(known: np.ndarray) -> np.ndarray:
    rows, cols = ndimage.distance_transform_edt(known == 0, return_distances=False, return_indices=True)
    return known[rows, cols]


def _harmonic(known: np.ndarray) -> np.ndarray:
    """Solve for the pixels that are 0: each is the mean of those of its four neighbours that lie in the image."""
    unknown = known == 0
    count = int(unknown.sum())
    if count == 0:
        return known.copy()
    number = np.full(known.shape, -1)
    number[unknown] = np.arange(count)
    neighbours, source, rows, cols = np.zeros(count), np.zeros(count), [], []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        for one, other in ((here, there), (there, here)):
            row = number[one][unknown[one]]  # unknown pixels that have such a neighbour
            column, value = number[other][unknown[one]], known[other][unknown[one]]
            neighbours[row] += 1
            source[row] += value  # 0 where the neighbour is unknown too
            rows.append(row[column >= 0])
            cols.append(column[column >= 0])
    rows, cols = np.concatenate(rows), np.concatenate(cols)
    coupling = sparse.coo_array((np.ones(len(rows)), (rows, cols)), shape=(count, count))
    laplacian = (sparse.diags_array(neighbours) - coupling).tocsc()
    filled = known.copy()
    # symmetric and positive definite: minimum degree on A^T + A, no pivoting
    solver = splu(laplacian, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    filled[unknown] = solver.solve(source)
    return filled
