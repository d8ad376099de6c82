"""The two kinds of depth loss: which pixels suffer which, the paper's partition, and the parallax behind one kind.

Optical loss lies inside the region of transparent or reflective objects; geometric loss lies outside it, mostly in the
shadow that appears when depth measured by the infrared cameras is carried over into the view of the RGB camera.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from .data import Camera

WRONG_ABS_M = 0.010  # a reading is wrong when it is off by more than 10 mm ...
WRONG_REL = 0.02  # ... and by more than 2 % of the true depth
FACET_STEP = 0.04  # neighbours whose depths differ by less than 4 % are taken to lie on one surface


class LossType(IntEnum):
    """Where a pixel lies and what the sensor said there; the codes of ``Sample.loss``."""

    OUTSIDE_FINE = 0
    OUTSIDE_WRONG = 1
    OUTSIDE_MISSING = 2
    INSIDE_FINE = 3
    INSIDE_WRONG = 4
    INSIDE_MISSING = 5
    UNKNOWN = 255


class Cause(IntEnum):
    """Why a pixel was lost, which only a simulation can know; the codes of ``Sample.cause``."""

    NONE = 0
    TRANSMISSION = 1  # glass read as what stands behind it, or not at all
    REFLECTION = 2  # the virtual image in a mirror
    STEREO_OCCLUSION = 3  # hidden from the right infrared camera
    PARALLAX = 4  # hidden from the left infrared camera: the reprojection shadow
    OUT_OF_VIEW = 5  # outside the infrared images or the disparity range
    NO_MATCH = 6  # dark, grazing, saturated or textureless
    DROPOUT = 7  # edge and speckle dropout of the sensor
    MISMATCH = 8  # wrong reading outside the region


@dataclass(frozen=True)
class Partition:
    """RGB and depth split in two by the region; every pixel is kept in exactly one part and is 0 in the other.

    Paper: Sec. III, Eq. 1 and 2 (Eq. 2 prints {φ}, a set with one element, where the empty set ∅ is meant).

    Attributes:
        rgb_op, rgb_geo: (H, W, 3) like the image.
        depth_op, depth_geo: (H, W) float32 metres.
        region: (H, W) bool, the pixels of the optical part; its complement are those of the geometric part.
    """

    rgb_op: np.ndarray
    rgb_geo: np.ndarray
    depth_op: np.ndarray
    depth_geo: np.ndarray
    region: np.ndarray

    def union(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (rgb, depth) put together again: the right-hand sides of Eq. 1."""
        rgb = np.where(self.region[..., None], self.rgb_op, self.rgb_geo)
        return rgb, np.where(self.region, self.depth_op, self.depth_geo)


def partition(rgb: np.ndarray, depth: np.ndarray, region: np.ndarray) -> Partition:
    """Split an RGB-D frame into its optical and its geometric part.

    Paper: Sec. III, Eq. 1 (the parts together are everything) and Eq. 2 (they share no pixel).

    Args:
        rgb: (H, W, 3) of any dtype.
        depth: (H, W) metres, 0 = missing.
        region: (H, W) bool, transparent or reflective.

    Returns:
        The :class:`Partition`.

    Raises:
        ValueError: when shapes differ or the region is not boolean.
    """
    depth = check_depth("depth", depth)
    region = check_mask("region", region, depth.shape)
    if rgb.shape != (*depth.shape, 3):
        raise ValueError(f"rgb should be {(*depth.shape, 3)} like the depth map, got {rgb.shape}; resize one of them")
    inside = region[..., None]
    zero = rgb.dtype.type(0)
    return Partition(
        rgb_op=np.where(inside, rgb, zero),
        rgb_geo=np.where(inside, zero, rgb),
        depth_op=np.where(region, depth, np.float32(0)),
        depth_geo=np.where(region, np.float32(0), depth),
        region=region,
    )


def label(depth: np.ndarray, depth_gt: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Name the loss of every pixel: inside or outside the region; fine, wrong or missing.

    A reading is wrong when ``|depth - depth_gt| > max(WRONG_ABS_M, WRONG_REL * depth_gt)``.

    Paper: Sec. III, Fig. 4 (it counts these kinds and does not give its threshold; ours is 10 mm or 2 %).

    Args:
        depth: (H, W) raw metres, 0 = missing.
        depth_gt: (H, W) true metres, 0 = unknown.
        region: (H, W) bool, transparent or reflective.

    Returns:
        (H, W) uint8 codes of :class:`LossType`; UNKNOWN where there is no ground truth.

    Raises:
        ValueError: when shapes differ, depth is negative or not finite, or the region is not boolean.
    """
    depth = check_depth("depth", depth)
    depth_gt = check_depth("depth_gt", depth_gt, depth.shape)
    region = check_mask("region", region, depth.shape)
    wrong = np.abs(depth - depth_gt) > np.maximum(WRONG_ABS_M, WRONG_REL * depth_gt)
    kind = np.where(depth == 0, 2, wrong).astype(np.uint8)  # fine, wrong, missing = 0, 1, 2
    codes = kind + np.where(region, LossType.INSIDE_FINE, LossType.OUTSIDE_FINE).astype(np.uint8)
    codes[depth_gt == 0] = LossType.UNKNOWN
    return codes


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
        raise ValueError(f"{name} has negative or non-finite values; call data.clean_depth first (0 means missing)")
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
