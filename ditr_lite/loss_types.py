"""The two kinds of depth loss: which pixels suffer which, the paper's partition, and the parallax behind one kind.

Optical loss lies inside the region of transparent or reflective objects; geometric loss lies outside it, mostly in the
shadow that appears when depth measured by the infrared cameras is carried over into the view of the RGB camera.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from .units import check_depth, check_mask

WRONG_ABS_M = 0.010  # a reading is wrong when it is off by more than 10 mm ...
WRONG_REL = 0.02  # ... and by more than 2 % of the true depth


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
    OUT_OF_VIEW = 5  # outside one of the infrared images
    NO_MATCH = 6  # dark, grazing, saturated, textureless, or nearer or farther than the sensor reads
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

    Paper: Sec. III, Fig. 4 (two causes, and that some readings are false; no threshold is given, ours is 10 mm or 2 %).

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
