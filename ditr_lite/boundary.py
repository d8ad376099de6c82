"""Boundary maps that guide stage two: M_RGB from colour, M_D from depth, M_DA where both agree.

Paper: Sec. IV-C "Feature Extractor". The paper runs SAM (ViT-L) on RGB and on depth and calls the outlines of its
masks M_RGB and M_D; how a set of masks becomes a map is not said. Here anything that turns an image into a bool map
is a backend, and ``classical`` needs no weights.

Convention: a boundary belongs to the surface in front: the marked pixels are its outermost ones, one pixel wide.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from skimage.segmentation import find_boundaries

Backend = Callable[[np.ndarray], np.ndarray]  # uint8 (H, W, 3) or float metres (H, W) -> (H, W) bool


def boundaries_from_labels(instances: np.ndarray) -> np.ndarray:
    """Mark the outermost pixels of every labelled object.

    ``skimage.segmentation.find_boundaries`` with mode "inner": the marked pixel lies on the object and has a
    4-neighbour with another label; background (0) is never marked. One pixel wide, two where two objects touch.

    Args:
        instances: (H, W) int, 0 = background.

    Returns:
        (H, W) bool.

    Raises:
        ValueError: when ``instances`` is not (H, W) of integers.
    """
    instances = np.asarray(instances)
    if instances.ndim != 2 or not np.issubdtype(instances.dtype, np.integer):
        raise ValueError(f"expected instance labels (H, W) of integers, got {instances.shape} {instances.dtype}")
    return find_boundaries(instances, connectivity=1, mode="inner", background=0)


class ClassicalBoundary:
    """Find boundaries without any learned weights: Canny in colour, jumps between readings in depth.

    Args:
        low: weak-edge threshold on colour, CIELAB units per pixel; kept only when joined to a strong edge.
        high: strong-edge threshold on colour, same unit.
        jump: relative depth difference that makes a boundary (0.02: 2 cm at 1 m).
        slope: relative depth change per pixel that a slanted surface may have on top of that.
        max_hole: widest run of missing readings, in pixels, that a jump is looked for across.
        min_length: connected boundaries with fewer pixels are dropped as noise.
    """

    def __init__(
        self,
        low: float = 3.0,
        high: float = 8.0,
        jump: float = 0.02,
        slope: float = 0.01,
        max_hole: int = 24,
        min_length: int = 8,
    ):
        if not 0 < low <= high or min(jump, slope, max_hole, min_length) < 0:
            raise ValueError("expected 0 < low <= high and no negative value")
        self.low, self.high, self.jump, self.slope = low, high, jump, slope
        self.max_hole, self.min_length = max_hole, min_length

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the (H, W) bool boundary map of an image or of a depth map.

        Args:
            image: (H, W, 3) uint8 RGB, or (H, W) floating-point depth in metres with 0 = missing.

        Raises:
            ValueError: for anything else.
        """
        image = np.asarray(image)
        if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
            edges = self._colour(image)
        elif image.ndim == 2 and np.issubdtype(image.dtype, np.floating):
            depth = _denoise(image.astype(np.float32))
            edges = self._jumps(depth) | self._jumps(depth.T).T
        else:
            raise ValueError(f"expected RGB (H, W, 3) uint8 or depth (H, W) float, got {image.shape} {image.dtype}")
        return _drop_small(edges, self.min_length)

    def _colour(self, rgb: np.ndarray) -> np.ndarray:
        # float CIELAB: equal steps look equally different; the bilateral filter flattens texture but not edges
        lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
        lab = cv2.bilateralFilter(lab, 7, sigmaColor=12, sigmaSpace=3)
        dx = cv2.Sobel(lab, cv2.CV_32F, 1, 0, ksize=3) / 4  # / 4: the height of a step; (H, W, 3)
        dy = cv2.Sobel(lab, cv2.CV_32F, 0, 1, ksize=3) / 4
        strongest = (dx**2 + dy**2).argmax(axis=2)[..., None]
        dx, dy = (np.take_along_axis(d, strongest, axis=2)[..., 0] for d in (dx, dy))  # (H, W, 3) -> (H, W)
        scale = 64  # cv2.Canny takes int16 derivatives: keep 1/64 of a unit; 2^15 / 64 = 512 is never reached
        ints = [np.ascontiguousarray(np.rint(d * scale).astype(np.int16)) for d in (dx, dy)]
        return cv2.Canny(*ints, self.low * scale, self.high * scale, L2gradient=True) > 0

    def _jumps(self, depth: np.ndarray) -> np.ndarray:
        """Compare every reading with the next one to its right in the row, whatever is missing in between.

        Jumping over holes, rather than filling them, keeps two rules. A hole's own border is no boundary: where both
        sides are equally deep (glass, dark paint) nothing is marked. And where they differ, the nearer side is
        marked, because what a stereo camera misses beside an edge is the surface behind (the parallax shadow). Runs
        longer than ``max_hole`` say nothing.
        """
        rows, columns = np.nonzero(depth > 0)
        edges = np.zeros(depth.shape, bool)
        if len(rows) < 2:
            return edges
        z = depth[rows, columns]
        gap = columns[1:] - columns[:-1]  # 1 for neighbours
        near = np.minimum(z[1:], z[:-1])
        found = np.abs(z[1:] - z[:-1]) > (self.jump + self.slope * gap) * near
        found &= (rows[1:] == rows[:-1]) & (gap <= self.max_hole + 1)
        (pair,) = np.nonzero(found)
        front = pair + (z[pair + 1] < z[pair])  # index of the nearer of the two readings
        edges[rows[front], columns[front]] = True
        return edges


def _denoise(depth: np.ndarray) -> np.ndarray:
    """Take a 3x3 median of the readings only, leaving missing pixels missing."""
    missing = depth <= 0
    if missing.all():
        return np.zeros_like(depth)
    # zeros would win the median beside a hole, so every hole first takes the value of its nearest reading
    _, labels = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    value_of = np.zeros(labels.max() + 1, np.float32)
    value_of[labels[~missing]] = depth[~missing]
    return np.where(missing, 0, cv2.medianBlur(value_of[labels], 3)).astype(np.float32)


def _drop_small(edges: np.ndarray, min_length: int) -> np.ndarray:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(edges.astype(np.uint8), connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= min_length
    keep[0] = False  # label 0 is everything that is not an edge
    return keep[labels]


def _load_classical(path: Path | str | None = None) -> Backend:
    if path is not None:
        raise ValueError(f"backend 'classical' has no weights; leave out path={str(path)!r}")
    return ClassicalBoundary()


# name -> loader(path or None). A loader, not an object: weights are read only by those who ask for them.
BACKENDS: dict[str, Callable[..., Backend]] = {"classical": _load_classical}


def get_backend(name: str, path: Path | str | None = None) -> Backend:
    """Return the boundary backend called ``name``, with weights from ``path`` where it needs any.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in BACKENDS:
        raise ValueError(f"unknown boundary backend {name!r}; choose one of {', '.join(BACKENDS)}")
    return BACKENDS[name](path)


def within(mask: np.ndarray, tolerance: float) -> np.ndarray:
    """Return (H, W) bool: the pixels at most ``tolerance`` pixels (Euclidean) from a true pixel of ``mask``."""
    if not mask.any():
        return np.zeros(mask.shape, bool)  # OpenCV leaves the distance to an empty set undefined
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return distance <= tolerance + 1e-4  # float32 distances: 2 px must count as 2


def depth_aware(boundary_rgb: np.ndarray, boundary_depth: np.ndarray, tolerance: float = 2) -> np.ndarray:
    r"""Keep the colour boundaries that depth confirms.

    Paper: Sec. IV-C, I4, M_DA = M_RGB \ complement(M_D), "only RGB boundaries that appear on depth boundary maps are
    real boundaries between objects". Erratum: A \ complement(B) is the plain intersection of A and B, and of two maps
    one pixel wide, found in two images with different noise, hardly any pixel coincides. So M_D is first grown by
    ``tolerance``; tolerance 0 is the formula as printed.

    Args:
        boundary_rgb: (H, W) bool, M_RGB.
        boundary_depth: (H, W) bool, M_D.
        tolerance: pixels, Euclidean, >= 0.

    Returns:
        (H, W) bool, a subset of M_RGB.

    Raises:
        ValueError: for maps that are not bool and of one shape, or a negative tolerance.
    """
    _check_pair(boundary_rgb, boundary_depth, tolerance)
    return boundary_rgb & within(boundary_depth, tolerance)


def boundary_maps(
    rgb: np.ndarray, depth: np.ndarray, backend: Backend | None = None, tolerance: float = 2
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (M_RGB, M_D, M_DA) of one frame, each (H, W) bool.

    Paper: Sec. IV-C, S8: the optical branch is guided by M_DA, the geometric one by M_RGB.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float metres, raw, 0 = missing.
        backend: what finds boundaries, from :func:`get_backend`; None for the classical one.
        tolerance: see :func:`depth_aware`.

    Raises:
        ValueError: when the two images differ in size, or the backend or the tolerance cannot be used.
    """
    rgb, depth = np.asarray(rgb), np.asarray(depth)
    if rgb.shape[:2] != depth.shape:
        raise ValueError(f"expected rgb and depth of one size, got {rgb.shape} and {depth.shape}; resize one")
    backend = ClassicalBoundary() if backend is None else backend
    m_rgb, m_d = backend(rgb), backend(depth)
    return m_rgb, m_d, depth_aware(m_rgb, m_d, tolerance)


def precision_recall_f(pred: np.ndarray, true: np.ndarray, tolerance: float = 1) -> tuple[float, float, float]:
    """Score a boundary map against the true one.

    Precision is the share of predicted pixels with a true one within ``tolerance``, recall the share of true pixels
    with a predicted one, F their harmonic mean. (Simpler than the one-to-one matching of the Berkeley benchmark:
    thick predictions are not punished for being thick.)

    Args:
        pred: (H, W) bool.
        true: (H, W) bool.
        tolerance: pixels, Euclidean, >= 0.

    Returns:
        (precision, recall, F) in [0, 1]; NaN for a share of an empty set, F only when both maps are empty.

    Raises:
        ValueError: for maps that are not bool and of one shape, or a negative tolerance.
    """
    _check_pair(pred, true, tolerance)
    right, hit = (pred & within(true, tolerance)).sum(), (true & within(pred, tolerance)).sum()
    nan = float("nan")
    precision = float(right / pred.sum()) if pred.any() else nan
    recall = float(hit / true.sum()) if true.any() else nan
    if not right:
        return precision, recall, 0.0 if pred.any() or true.any() else nan
    return precision, recall, float(2 * precision * recall / (precision + recall))


def _check_pair(a: np.ndarray, b: np.ndarray, tolerance: float) -> None:
    if a.shape != b.shape or a.ndim != 2 or a.dtype != bool or b.dtype != bool:
        raise ValueError(f"expected two (H, W) bool maps of one size, got {a.shape} {a.dtype} and {b.shape} {b.dtype}")
    if tolerance < 0:
        raise ValueError(f"expected a tolerance >= 0 pixels, got {tolerance}")
