"""Parallax shadows, measured: how wide are the gaps that reprojected truth shows, and does the closed form say so?

True depth is reprojected, not a sensor's, so that no matching error, dropout or glass plays a part: geometry alone.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ..camera import FACET_STEP, Camera, reproject, shadow_width_px
from ..data import Sample
from ..units import check_depth

FINE = 4  # the gaps are measured on a raster this many times finer than the picture


class Shadows(NamedTuple):
    """One entry per edge: what was measured, what was predicted, and whether the prediction's premise holds.

    Attributes:
        measured_px: (N,) width of the gap, in pixels of the picture.
        predicted_px: (N,) ``shadow_width_px`` of the depths on either side of the edge.
        offset_m: (N,) how far the camera was moved.
        clear: (N,) bool: both surfaces are wider than the predicted gap, so nothing else can reach into it.
    """

    measured_px: np.ndarray
    predicted_px: np.ndarray
    offset_m: np.ndarray
    clear: np.ndarray

    def within(self, predicted_px: np.ndarray | float | None = None, tolerance_px: float = 1.0) -> float:
        """Return the share of edges whose measured width lies within the tolerance of a prediction (default: its own).

        Raises:
            ValueError: when there is no edge.
        """
        if not self.measured_px.size:
            raise ValueError("no edges to score: measure scenes with objects before a background, or more rows")
        wanted = self.predicted_px if predicted_px is None else predicted_px
        return float(np.mean(np.abs(self.measured_px - wanted) <= tolerance_px))

    def only(self, chosen: np.ndarray) -> "Shadows":
        """Return the edges where ``chosen``, (N,) bool, is True."""
        return Shadows(*(values[chosen] for values in self))

    def best_constant(self) -> float:
        """Return the best width that ignores depth and offset: of all quarter pixels, the one that suits most edges."""
        widths = np.arange(0, self.measured_px.max(initial=0.0) + 0.25, 0.25)
        return float(max(widths, key=self.within))


def measure_shadows(depth_gt: np.ndarray, camera: Camera, offset_m: float, every: int = 16) -> Shadows:
    """Move the camera sideways, and measure the gap at every left-hand edge in every 16th row.

    A camera moved by ``-offset_m`` along x sees each point shifted right by ``fx * offset_m / z`` pixels, so a near
    surface runs away from the far one on its left. An edge is a pair of neighbours, the right one nearer by more than
    ``FACET_STEP``; its gap is the empty stretch left of where the near neighbour lands, 0 wide where there is none.

    Paper: Sec. I, Fig. 3 (the shadow is described there in words).

    Args:
        depth_gt: (H, W) true metres, 0 = unknown.
        camera: of the same size.
        offset_m: distance between the two views, metres, > 0.
        every: distance of the sampled rows.

    Returns:
        :class:`Shadows`, row by row; edges whose gap would leave the picture are left out.

    Raises:
        ValueError: for a depth map that does not fit the camera, or an offset or row distance that is not positive.
    """
    depth_gt = check_depth("depth_gt", depth_gt, (camera.height, camera.width))
    if not offset_m > 0 or every < 1:
        raise ValueError(f"expected an offset > 0 in metres and every >= 1 row, got {offset_m} and {every}")
    rows = slice(every // 2, None, every)
    sampled = np.zeros_like(depth_gt)
    sampled[rows] = depth_gt[rows]
    motion = np.eye(4)
    motion[0, 3] = offset_m
    seen = reproject(sampled, camera, _finer(camera), motion)[rows] > 0
    lines = zip(depth_gt[rows], seen, strict=True)
    edges = [_edge(z, u, line, camera, offset_m) for z, line in lines for u in _jumps(z)]
    measured, predicted, clear = np.array([edge for edge in edges if edge] or np.empty((0, 3)), float).T
    return Shadows(measured, predicted, np.full(len(measured), offset_m), clear > 0)


def measure_scenes(samples: Iterable[Sample], offsets_m: Iterable[float]) -> Shadows:
    """Return the shadows of many scenes and offsets together.

    Args:
        samples: with ground truth and camera.
        offsets_m: in metres; each is applied to each scene.
    """
    offsets_m = tuple(offsets_m)
    found = [measure_shadows(s.depth_gt, s.camera, b) for s in samples for b in offsets_m]
    return Shadows(*map(np.concatenate, zip(*found, strict=True)))


def _jumps(z: np.ndarray) -> np.ndarray:
    """Return the columns u of a row where u + 1 is known and nearer than u by more than ``FACET_STEP``."""
    return np.flatnonzero((z[1:] > 0) & (z[:-1] > (1 + FACET_STEP) * z[1:]))


def _edge(z: np.ndarray, u: int, seen: np.ndarray, camera: Camera, offset_m: float) -> tuple | None:
    """Return (measured, predicted, clear) of the edge between columns u and u + 1 of the row ``z``."""
    far, near = float(z[u]), float(z[u + 1])
    predicted = shadow_width_px(near, far, offset_m, camera.fx)
    reach = int(np.ceil(predicted)) + 1
    # column of the finer raster in which the near pixel's centre lands
    lands = round((u + 1 + camera.fx * offset_m / near) * FINE + (FINE - 1) / 2)
    if u + 1 - reach < 0 or u + 1 + reach > len(z) or lands >= len(seen) - FINE:
        return None
    left, right = z[u + 1 - reach : u + 1], z[u + 1 : u + 1 + reach]
    # no further surface within the gap's width: neither one that covers it nor one that shines in behind the near one
    clear = bool((np.abs(left - far) <= FACET_STEP * far).all() and (right < (near + far) / 2).all() and right.all())
    before = np.flatnonzero(~seen[max(lands - FINE, 0) : lands])  # the near facet ends half a pixel before its centre
    if not before.size:
        return 0.0, predicted, clear
    end = max(lands - FINE, 0) + int(before[-1])
    filled = np.flatnonzero(seen[:end])
    return ((end - int(filled[-1])) / FINE if filled.size else 0.0), predicted, clear


def _finer(camera: Camera) -> Camera:
    """Return the camera with ``FINE`` times the columns and the same rows."""
    cx = (camera.cx + 0.5) * FINE - 0.5
    return Camera(camera.fx * FINE, camera.fy, cx, camera.cy, camera.width * FINE, camera.height)
