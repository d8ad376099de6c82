"""What both branches are given: normalised depth, what is known of it, and the image that guides them.

Paper: Sec. III (calibration) and IV-C. The paper leaves open how raw depth reaches the denoiser; our reading is latent
inpainting's: the encoded known depth and a mask are concatenated to L_t, everything else enters through F(x).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

CHANNELS = ("red", "green", "blue", "boundary", "filled", "known", "region", "evidence", "trusted")  # of F(x)'s input
SPREADS = (0.12, 0.6)  # least and largest reach upwards, as a ratio of distances: exp(0.12) is 13 per cent


@dataclass(frozen=True)
class Bounds:
    """Invertible map between metres and network units in which distance itself does not matter.

    ``u = (ln d - ln m) / h`` with ``m = sqrt(low high)`` and ``h = ln(high / low) / 2``: the logarithm of depth,
    ``low`` at -1 and ``high`` at 1. Between them it is kept, beyond them compressed once more,
    ``sign(u) (1 + ln |u|)``: a room behind the table, or a stray reading, takes no room from the table. Nothing is
    clipped.

    Both may be floats, for one frame, or tensors (B, 1, 1, 1), for a batch.
    """

    low: float | Tensor
    high: float | Tensor

    def normalise(self, depth_m):
        """Map metres > 0 to network units (array or tensor); what is not positive becomes 0."""
        xp = torch if isinstance(depth_m, Tensor) else np
        low, high = self._logarithms()
        positive = depth_m > 0
        u = (xp.log(xp.where(positive, depth_m, 1.0)) - (low + high) / 2) * (2 / (high - low))
        size = abs(u)
        beyond = xp.sign(u) * (1 + xp.log(xp.where(size > 1, size, 1.0)))
        return xp.where(positive, xp.where(size > 1, beyond, u), 0.0)

    def denormalise(self, depth_n):
        """Map network units to metres, the inverse of :meth:`normalise`."""
        xp = torch if isinstance(depth_n, Tensor) else np
        low, high = self._logarithms()
        size = abs(depth_n)
        beyond = xp.sign(depth_n) * xp.exp(xp.where(size > 1, size, 1.0) - 1)
        u = xp.where(size > 1, beyond, depth_n)
        return xp.exp((low + high) / 2 + u * ((high - low) / 2))

    def _logarithms(self):
        xp = torch if isinstance(self.low, Tensor) else np
        return xp.log(self.low), xp.log(self.high)


def depth_bounds(depth: np.ndarray, about: np.ndarray | None = None) -> Bounds:
    """Choose the bounds of a frame from its *raw* depth alone: ground-truth quantiles would leak the answer.

    From the median they reach 2.5 median absolute deviations of log depth upwards, neither of which a minority of far
    or near readings can move. Downwards they reach a quarter farther, because what the sensor misses (glass) stands
    before what it sees; so the median lies a little above the middle of the range.

    Args:
        depth: (H, W) metres, 0 = missing.
        about: (H, W) bool, the pixels whose readings to take (those around a region, say); where none was read
            there, or None, all are taken.

    Raises:
        ValueError: when nothing was measured.
    """
    measured = depth[depth > 0] if about is None else depth[about & (depth > 0)]
    if measured.size == 0:
        measured = depth[depth > 0]
    if measured.size == 0:
        raise ValueError("the depth map holds no reading at all; depth completion needs at least some measured pixels")
    logs = np.log(measured.astype(np.float64))
    middle = float(np.median(logs))
    half = 2.5 * float(np.median(np.abs(logs - middle)))
    half = min(max(half, SPREADS[0]), SPREADS[1])
    return Bounds(float(np.exp(middle - 1.25 * half)), float(np.exp(middle + half)))


def fill(depth_n: Tensor, known: Tensor, rounds: int = 4) -> Tensor:
    """Fill unknown pixels smoothly: from the nearest coarser scale that knows any (push-pull), relaxed at every scale.

    Only a start for the encoder, cheap and dense; the branches repaint it. Each round replaces an unknown pixel by the
    mean of its four neighbours, so that many rounds would solve Laplace's equation; because the coarse scales come
    first, few are enough.

    Args:
        depth_n: (B, 1, H, W) normalised depth.
        known: (B, 1, H, W) 0/1.
        rounds: of relaxation at every scale.

    Returns:
        (B, 1, H, W), equal to ``depth_n`` where known; 0 everywhere when nothing is known.
    """
    if max(depth_n.shape[2:]) <= 1:
        return depth_n * known
    mean, share = pool(depth_n, known)
    coarse = fill(mean, (share > 0).to(known.dtype), rounds)
    fine = doubled(coarse, depth_n.shape[2:])
    filled = torch.where(known > 0, depth_n, fine)
    for _ in range(rounds):
        padded = F.pad(filled, (1, 1, 1, 1), mode="replicate")
        vertical = padded[:, :, :-2, 1:-1] + padded[:, :, 2:, 1:-1]
        horizontal = padded[:, :, 1:-1, :-2] + padded[:, :, 1:-1, 2:]
        filled = torch.where(known > 0, depth_n, (vertical + horizontal) / 4)
    return filled


def doubled(coarse: Tensor, size: Sequence[int]) -> Tensor:
    """Return a map (B, 1, H/2, W/2), rounded up, at its pixels (B, 1, H, W): the last cell may lie half outside."""
    return F.interpolate(coarse, scale_factor=2.0, mode="bilinear", align_corners=False)[..., : size[0], : size[1]]


def pool(depth_n: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Return means of known pixels of blocks of 2x2, and the share of known ones, (B, 1, H/2, W/2) each, rounded up."""
    share = F.avg_pool2d(known, 2, ceil_mode=True, count_include_pad=False)
    mean = F.avg_pool2d(depth_n * known, 2, ceil_mode=True, count_include_pad=False)
    return mean / share.clamp(min=1e-6), share


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

    Paper: Sec. IV-A multiplies masks with the depth. Our reading: nothing inside the region counts as known. Departure:
    ``evidence`` shows the in-region readings in channels of their own, *not* as known depth: on real frames they are
    1.5 to 5 cm off, which is closer than any fill from outside comes. They are filled, too: the channel says how far
    a fill from all readings lies from a fill from those outside.

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
    offset = (fill(depth_n, known + seen) - filled).clamp(-2, 2)
    image = torch.cat([rgb, boundary, filled, known, region, offset, seen], dim=1)
    return image, filled, F.avg_pool2d(known, 4)
