"""Pinhole cameras: between pixels and metres, and from one view into another, with the shadow that parallax leaves."""

import math
from dataclasses import dataclass

import numpy as np

from .units import check_depth, check_metres

FACET_STEP = 0.04  # neighbours whose depths differ by less than 4 % are taken to lie on one surface


@dataclass(frozen=True)
class Camera:
    """Pinhole camera, in pixels: x right, y down, z forward; pixel (u, v) has its centre at the integer (u, v)."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def resized(self, width: int, height: int) -> "Camera":
        """Return the same camera with its image resized to ``width`` x ``height``."""
        sx, sy = width / self.width, height / self.height
        return Camera(self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5, width, height)

    def cropped(self, rows: slice, columns: slice) -> "Camera":
        """Return the camera of a crop ``image[rows, columns]``: the same rays, so only the principal point moves.

        Raises:
            ValueError: when the slices leave nothing or skip pixels.
        """
        (top, bottom, down), (left, right, across) = rows.indices(self.height), columns.indices(self.width)
        if down != 1 or across != 1 or bottom <= top or right <= left:
            raise ValueError(
                f"expected slices that leave a part of {self.height} x {self.width}, got {rows}, {columns}"
            )
        return Camera(self.fx, self.fy, self.cx - left, self.cy - top, right - left, bottom - top)


@dataclass(frozen=True)
class Stereo:
    """The infrared pair behind a raw depth frame: rectified cameras, left one reprojected into the RGB view.

    ``rgb_from_left`` is the 4 x 4 rigid motion (metres) that takes left-IR camera coordinates to RGB camera
    coordinates. The right camera sits ``baseline_m`` along +x of the left one.
    """

    camera: Camera
    baseline_m: float
    rgb_from_left: tuple[tuple[float, ...], ...]

    def motion(self) -> np.ndarray:
        """Return ``rgb_from_left`` as a (4, 4) float64 array."""
        return np.asarray(self.rgb_from_left, dtype=np.float64)


def unproject(depth_m: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the 3-D points of the valid pixels, row by row: x = (u - cx) z / fx, y = (v - cy) z / fy.

    Args:
        depth_m: (H, W) float metres, 0 = missing.
        camera: of the same size.

    Returns:
        (N, 3) float64 metres, N = number of pixels with depth > 0; x right, y down, z forward.

    Raises:
        ValueError: when the camera's size is not the map's, or the map is not a depth map.
    """
    depth_m = check_metres(depth_m)
    if depth_m.shape != (camera.height, camera.width):
        raise ValueError(
            f"the camera is for {(camera.height, camera.width)} (height, width), the depth map is {depth_m.shape}: "
            "use Camera.resized"
        )
    v, u = np.nonzero(depth_m > 0)
    z = depth_m[v, u].astype(np.float64)
    return np.stack([(u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z], axis=1)


def shadow_width_px(z_near: float, z_far: float, baseline_m: float, fx: float) -> float:
    """Return how wide, in pixels, the parallax shadow is that an edge at ``z_near`` casts on a surface at ``z_far``.

    A point at depth z moves by ``fx * baseline / z`` pixels between two parallel cameras, so the far side of the edge
    is laid bare over the difference of the two shifts.

    Paper: Sec. I, Fig. 3 (described there in words).

    Raises:
        ValueError: for depths that are not positive or not in order.
    """
    if not 0 < z_near <= z_far:
        raise ValueError(f"expected 0 < z_near <= z_far in metres, got {z_near} and {z_far}; swap or check the units")
    return fx * baseline_m * (1 / z_near - 1 / z_far)


def reproject(depth_ir: np.ndarray, camera_ir: Camera, camera_rgb: Camera, rgb_from_ir: np.ndarray) -> np.ndarray:
    """Carry a depth map over into the view of another camera, nearest surface first.

    Each source pixel becomes a small square facet, tilted like its neighbourhood. The facet is sampled on a grid
    finer than the target's pixels, so that a surface seen from the new camera has no lattice holes and grows by no more
    than half a source pixel. Where the new camera sees what the old one did not, nothing lands: the parallax shadow.
    The grid follows the focal lengths: a camera so near to a surface that it appears twice as large sees holes in it.

    Paper: Sec. I, Fig. 3 (geometric depth loss).

    Args:
        depth_ir: (h, w) metres in the source view, 0 = missing.
        camera_ir: intrinsics of the source view.
        camera_rgb: intrinsics of the target view.
        rgb_from_ir: (4, 4) rigid motion, metres, source camera coordinates to target camera coordinates.

    Returns:
        (H, W) float32 metres in the target view, 0 where nothing lands.

    Raises:
        ValueError: when the depth map does not fit its camera or the motion is not (4, 4).
    """
    depth_ir = check_depth("depth_ir", depth_ir, (camera_ir.height, camera_ir.width))
    motion = np.asarray(rgb_from_ir, dtype=np.float64)
    if motion.shape != (4, 4) or not np.isfinite(motion).all():
        raise ValueError(f"rgb_from_ir should be a finite (4, 4) rigid motion in metres, got shape {motion.shape}")
    zoom = max(camera_rgb.fx / camera_ir.fx, camera_rgb.fy / camera_ir.fy)  # target pixels per source pixel
    per_side = max(2, math.ceil(2 * zoom))  # samples at most half a target pixel apart: slanted facets may stretch 2x
    height, width = camera_rgb.height, camera_rgb.width
    nearest = np.full(height * width, np.inf, dtype=np.float32)

    v, u = np.nonzero(depth_ir)
    inverse, slope_u, slope_v = (a[v, u] for a in _facets(depth_ir))
    rays = np.stack([(u - camera_ir.cx) / camera_ir.fx, (v - camera_ir.cy) / camera_ir.fy, np.ones(len(u))])
    rays = motion[:3, :3] @ rays  # (3, N), source rays of unit depth in target axes
    step_u, step_v = motion[:3, 0] / camera_ir.fx, motion[:3, 1] / camera_ir.fy  # (3,) change of a ray per source pixel
    offsets = (np.arange(per_side) + 0.5) / per_side - 0.5
    for du, dv in ((a, b) for a in offsets for b in offsets):
        w = np.maximum(inverse + du * slope_u + dv * slope_v, 1e-6)  # 1/z is linear in the image of a plane
        x, y, z = (rays + (du * step_u + dv * step_v)[:, None]) / w + motion[:3, 3:]
        z = np.maximum(z, 1e-6)
        px, py = camera_rgb.fx * x / z + camera_rgb.cx, camera_rgb.fy * y / z + camera_rgb.cy
        col, row = np.floor(px + 0.5), np.floor(py + 0.5)
        seen = (col >= 0) & (col < width) & (row >= 0) & (row < height) & (z > 1e-6)
        # slide along the facet to the pixel's centre: the nearest of several samples would be too near on a slope
        centre = np.maximum(w + ((col - px) * slope_u + (row - py) * slope_v) / zoom, 1e-6)
        index = (row * width + col)[seen].astype(np.intp)
        np.minimum.at(nearest, index, (z * w / centre)[seen].astype(np.float32))
    nearest[~np.isfinite(nearest)] = 0
    return nearest.reshape(height, width)


def _facets(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return 1/z and its slope per pixel along u and v, from those neighbours that lie on the same surface."""
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    slopes = []
    for axis in (1, 0):
        step = np.diff(inverse, axis=axis)
        both = np.minimum(*(np.take(inverse, s, axis=axis) for s in _neighbours(depth.shape[axis])))
        joined = (both > 0) & (np.abs(step) < FACET_STEP * both)
        step = np.where(joined, step, 0.0)
        pad = [(0, 0), (0, 0)]
        pad[axis] = (1, 1)
        step, joined = np.pad(step, pad), np.pad(joined, pad)
        before, after = _neighbours(depth.shape[axis] + 1)
        total = np.take(step, before, axis=axis) + np.take(step, after, axis=axis)
        count = np.take(joined, before, axis=axis).astype(int) + np.take(joined, after, axis=axis)
        slopes.append(total / np.maximum(count, 1))
    return inverse, slopes[0], slopes[1]


def _neighbours(length: int) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(length - 1), np.arange(1, length)
