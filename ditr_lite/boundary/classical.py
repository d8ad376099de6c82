"""Boundaries without any learned weights: Canny in colour, jumps between readings in depth."""

import cv2
import numpy as np


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

    @property
    def fingerprint(self) -> str:
        """Settings that the maps depend on, for caches."""
        return repr(sorted(vars(self).items()))

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the (H, W) bool boundary map of an image or of a depth map.

        Args:
            image: (H, W, 3) uint8 RGB, or (H, W) floating-point depth in metres with 0 = missing.

        Raises:
            ValueError: for anything else.
        """
        image = np.asarray(image)
        if is_depth(image):
            depth = _denoise(image.astype(np.float32))
            edges = self._jumps(depth) | self._jumps(depth.T).T
        else:
            edges = self._colour(image)
        return drop_small(edges, self.min_length)

    def _colour(self, rgb: np.ndarray) -> np.ndarray:
        # float CIELAB: equal steps look equally different; the bilateral filter flattens texture but not edges
        lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
        lab = cv2.bilateralFilter(lab, 7, sigmaColor=12, sigmaSpace=3)
        dx = cv2.Sobel(lab, cv2.CV_32F, 1, 0, ksize=3) / 4  # / 4: the height of a step; (H, W, 3)
        dy = cv2.Sobel(lab, cv2.CV_32F, 0, 1, ksize=3) / 4
        strongest = (dx**2 + dy**2).argmax(axis=2)[..., None]
        dx = np.take_along_axis(dx, strongest, axis=2)[..., 0]  # (H, W, 3) -> (H, W)
        dy = np.take_along_axis(dy, strongest, axis=2)[..., 0]
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


def is_depth(image: np.ndarray) -> bool:
    """Tell a depth map, (H, W) floating-point, from a colour image, (H, W, 3) uint8.

    Raises:
        ValueError: for anything else.
    """
    if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
        return False
    if image.ndim == 2 and np.issubdtype(image.dtype, np.floating):
        return True
    raise ValueError(f"expected RGB (H, W, 3) uint8 or depth (H, W) float, got {image.shape} {image.dtype}")


def spread_readings(depth: np.ndarray) -> np.ndarray:
    """Return (H, W) float32 in which every missing pixel (0) has the value of its nearest reading."""
    missing = depth <= 0
    if missing.all():
        return np.zeros(depth.shape, np.float32)
    _, labels = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    value_of = np.zeros(labels.max() + 1, np.float32)
    value_of[labels[~missing]] = depth[~missing]
    return value_of[labels]


def drop_small(edges: np.ndarray, min_length: int) -> np.ndarray:
    """Return (H, W) bool without the connected pieces (8 neighbours) of fewer than ``min_length`` pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(edges.astype(np.uint8), connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= min_length
    keep[0] = False  # label 0 is everything that is not an edge
    return keep[labels]


def _denoise(depth: np.ndarray) -> np.ndarray:
    """Take a 3x3 median of the readings only, leaving missing pixels missing."""
    # zeros would win the median beside a hole, so every hole first takes the value of its nearest reading
    return np.where(depth > 0, cv2.medianBlur(spread_readings(depth), 3), 0).astype(np.float32)
