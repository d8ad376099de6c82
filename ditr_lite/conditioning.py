"""What both branches are given: normalised depth, what is known of it, and the image that guides them.

Paper: Sec. III (calibration) and IV-C. The paper leaves open how raw depth reaches the denoiser; our reading is latent
inpainting's: the encoded known depth and a mask are concatenated to L_t, everything else enters through F(x).
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

CHANNELS = ("red", "green", "blue", "boundary", "filled", "known", "region", "evidence", "trusted")  # of F(x)'s input
MIN_SPAN_M = 0.15  # a frame of one flat wall still gets a range to paint in


@dataclass(frozen=True)
class Bounds:
    """Affine map between metres and network units: ``low`` goes to -1, ``high`` to 1; nothing is clipped."""

    low: float
    high: float

    def normalise(self, depth_m):
        """Map metres to network units (any array type)."""
        return (depth_m - self.low) * (2 / (self.high - self.low)) - 1

    def denormalise(self, depth_n):
        """Map network units to metres, the inverse of :meth:`normalise`."""
        return (depth_n + 1) * ((self.high - self.low) / 2) + self.low


def depth_bounds(depth: np.ndarray) -> Bounds:
    """Choose the bounds of a frame from its *raw* depth alone: ground-truth quantiles would leak the answer.

    The 2nd and 98th percentile, widened downwards by a quarter of their span, because what the sensor misses (glass)
    stands before what it sees, and upwards by a tenth.

    Raises:
        ValueError: when nothing was measured.
    """
    measured = depth[depth > 0]
    if measured.size == 0:
        raise ValueError("the depth map holds no reading at all; depth completion needs at least some measured pixels")
    low, high = (float(q) for q in np.percentile(measured, [2, 98]))
    spare = max(MIN_SPAN_M - (high - low), 0) / 2
    low, high = low - spare, high + spare
    span = high - low
    return Bounds(low - 0.25 * span, high + 0.10 * span)


@dataclass(frozen=True)
class Frame:
    """How an image lies in the working size: scaled to (``height``, ``width``), then padded right and below."""

    source: tuple[int, int]
    height: int
    width: int
    size: tuple[int, int]

    def into(self, image: np.ndarray) -> np.ndarray:
        """Bring an image to the working size: colour by area, depth and masks by nearest; padding is 0 (missing)."""
        method = cv2.INTER_NEAREST
        if image.ndim == 3:
            method = cv2.INTER_AREA if self.height < self.source[0] else cv2.INTER_LINEAR
        kind = np.uint8 if image.dtype == bool else image.dtype
        small = cv2.resize(image.astype(kind), (self.width, self.height), interpolation=method)
        return np.pad(small, self.padding + ((0, 0),) * (image.ndim - 2)).astype(image.dtype)

    @property
    def padding(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Rows before and after, columns before and after the image."""
        return (0, self.size[0] - self.height), (0, self.size[1] - self.width)

    @property
    def picture(self) -> np.ndarray:
        """(H, W) bool at the working size, False in the padding."""
        return np.pad(np.ones((self.height, self.width), bool), self.padding)

    def on_picture(self, find: Callable[..., tuple], *images: np.ndarray, **settings) -> tuple[np.ndarray, ...]:
        """Call ``find`` with images less their padding, whose edge it would take for a boundary; pad what it returns.

        Args:
            find: of images (h, w, ...) and ``settings``; returns maps (h, w).
            images: at the working size.
            settings: passed on.

        Returns:
            the maps at the working size, 0 in the padding.
        """
        found = find(*(image[: self.height, : self.width] for image in images), **settings)
        return tuple(np.pad(m, self.padding) for m in found)

    def back(self, image: np.ndarray) -> np.ndarray:
        """Bring a map (H, W) back from the working size: masks by nearest, depth smoothly but not over edges."""
        size = (self.source[1], self.source[0])
        image = image[: self.height, : self.width]
        if image.dtype == bool:
            return cv2.resize(image.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
        nearest = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
        if size == (self.width, self.height):
            return nearest
        smooth = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
        edge = np.abs(smooth - nearest) > 0.01 * np.abs(nearest)  # averaging over a jump would make flying pixels
        np.copyto(smooth, nearest, where=edge)
        return smooth


def fit(source: tuple[int, int], size: tuple[int, int]) -> Frame:
    """Return the :class:`Frame` that puts an image of (H, W) ``source`` into ``size``, keeping its aspect."""
    scale = min(size[0] / source[0], size[1] / source[1])
    height, width = (max(1, min(limit, round(length * scale))) for length, limit in zip(source, size, strict=True))
    return Frame(source, height, width, size)


def fill(depth_n: Tensor, known: Tensor) -> Tensor:
    """Fill unknown pixels with averages of known ones, from the nearest coarser scale that has any (push-pull).

    Only a start for the encoder, cheap and dense; the branches repaint it.

    Args:
        depth_n: (B, 1, H, W) normalised depth.
        known: (B, 1, H, W) 0/1.

    Returns:
        (B, 1, H, W), equal to ``depth_n`` where known; 0 everywhere when nothing is known.
    """
    if min(depth_n.shape[2:]) <= 1:
        return depth_n * known
    share = F.avg_pool2d(known, 2, ceil_mode=True, count_include_pad=False)
    mean = F.avg_pool2d(depth_n * known, 2, ceil_mode=True, count_include_pad=False) / share.clamp(min=1e-6)
    coarse = fill(mean, (share > 0).to(known.dtype))
    fine = F.interpolate(coarse, size=depth_n.shape[2:], mode="bilinear", align_corners=False)
    return torch.where(known > 0, depth_n, fine)


def depth_tensors(depth: np.ndarray, bounds: Bounds) -> tuple[Tensor, Tensor]:
    """Return normalised depth, 0 where missing, and its validity 0/1, (1, 1, H, W) float32 each, of (H, W) metres."""
    valid = torch.from_numpy((depth > 0).astype(np.float32))[None, None]
    depth_n = torch.from_numpy(bounds.normalise(depth).astype(np.float32))[None, None]
    return depth_n * valid, valid


def to_tensor(rgb: np.ndarray) -> Tensor:
    """Return (B, 3, H, W) float in [-1, 1] of (B, H, W, 3) uint8."""
    return torch.from_numpy(np.ascontiguousarray(rgb)).permute(0, 3, 1, 2).float() / 127.5 - 1


def condition(
    rgb: Tensor, depth_n: Tensor, valid: Tensor, region: Tensor, boundary: Tensor, evidence: bool = True
) -> tuple[Tensor, Tensor, Tensor]:
    """Assemble what a branch is given.

    Paper: Sec. IV-A: the mask is multiplied with the depth, so nothing inside the region counts as known. Departure:
    ``evidence`` shows the in-region readings in channels of their own, *not* as known depth: on real frames they are
    1.5 to 5 cm off, which is closer than any fill from outside comes.

    Args:
        rgb: (B, 3, H, W) in [-1, 1].
        depth_n: (B, 1, H, W) normalised raw depth, anything where not valid.
        valid: (B, 1, H, W) 0/1, measured pixels.
        region: (B, 1, H, W) 0/1.
        boundary: (B, 1, H, W) 0/1, the boundary map that guides this branch.
        evidence: whether in-region readings may be seen.

    Returns:
        the conditioning image (B, 9, H, W) with channels as in :data:`CHANNELS`; the filled known depth (B, 1, H, W)
        for the encoder; the share of known pixels per latent cell (B, 1, H/4, W/4).
    """
    known = valid * (1 - region)
    filled = fill(depth_n, known)
    seen = valid * region * float(evidence)
    offset = torch.where(seen > 0, (depth_n - filled).clamp(-2, 2), 0.0)
    image = torch.cat([rgb, boundary, filled, known, region, offset, seen], dim=1)
    return image, filled, F.avg_pool2d(known, 4)
