"""Stage one: find the pixels of transparent and reflective objects, then refine the mask.

Paper: Sec. IV-B "Region Proposal" - TROSNet, "mainly an encoder-decoder network, with some mid-stage processes,
including feature fusion and boundary refinement" over RGB and depth; then a 7x7 median filter and a 5x5 dilation in 3
iterations, "to lower the miss rate". The network here keeps those three ideas at a size that a CPU trains; it is not
TROSNet itself.
"""

from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config import RegionConfig, check_kernels
from .encoder import CHANNELS, ColourEncoder

IGNORE = 255  # target class of a pixel whose class is unknown


def _conv(channels_in: int, channels_out: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    # GroupNorm, not BatchNorm: batches are small here, and one image must not change the mask of another
    groups = 8 if channels_out % 8 == 0 else 1
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, 3, stride, padding=dilation, dilation=dilation, bias=False),
        nn.GroupNorm(groups, channels_out),
        nn.ReLU(inplace=True),
    )


def _chain(block: type[nn.Module], channels: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(block(channels) for _ in range(count)))


def _resize(x: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)


def level_widths(width: int, levels: int) -> list[int]:
    """Return the channels of each level: they double down to stride 16 and stay from there on."""
    return [width * 2 ** min(k, 3) for k in range(levels)]


class Encoder(nn.Module):
    """Turn one modality into a pyramid at strides 2, 4, 8, ..., with ``widths`` channels."""

    def __init__(self, channels_in: int, widths: list[int]):
        super().__init__()
        widths = [channels_in, *widths]
        self.down = nn.ModuleList(_conv(a, b, stride=2) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.refine = nn.ModuleList(_conv(b, b) for b in widths[1:])

    def forward(self, x: Tensor) -> list[Tensor]:
        """Return features (B, widths[k], H/2^(k+1), W/2^(k+1)) for k = 0, 1, ..."""
        pyramid = []
        for down, refine in zip(self.down, self.refine, strict=True):
            x = down(x)
            x = x + refine(x)
            pyramid.append(x)
        return pyramid


class PretrainedPyramid(nn.Module):
    """The colour encoder with its pyramid brought to the widths of the depth encoder's."""

    def __init__(self, channels_in: int, widths: list[int]):
        super().__init__()
        if channels_in != 3 or len(widths) > len(CHANNELS):
            raise ValueError(f"the pretrained encoder sees colour at up to {len(CHANNELS)} levels, got {len(widths)}")
        self.encoder = ColourEncoder(len(widths))
        self.project = nn.ModuleList(nn.Conv2d(c, w, 1) for c, w in zip(CHANNELS, widths, strict=False))

    def forward(self, x: Tensor) -> list[Tensor]:
        """Return features (B, widths[k], H/2^(k+1), W/2^(k+1)) for k = 0, 1, ..."""
        return [project(level) for project, level in zip(self.project, self.encoder(x), strict=True)]


COLOUR_ENCODERS = {"pretrained": PretrainedPyramid, "scratch": Encoder}


class CrossModalFusion(nn.Module):
    """Let each modality reweight the other, pixel by pixel and channel by channel, then add them.

    On glass, colour shows little and depth is wrong or missing in a telling way; on a textured table it is the reverse.
    Which modality to trust can therefore only be decided by looking at the other one.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.gate_rgb = nn.Conv2d(channels, channels, 1)  # read from depth, applied to RGB
        self.gate_depth = nn.Conv2d(channels, channels, 1)  # read from RGB, applied to depth

    def forward(self, rgb: Tensor, depth: Tensor) -> Tensor:
        """Return the fused features, all three (B, C, h, w)."""
        return rgb * torch.sigmoid(self.gate_rgb(depth)) + depth * torch.sigmoid(self.gate_depth(rgb))


class Residual(nn.Module):
    """Two convolutions, added to their input; at first they change nothing: a trained network can be given them.

    Not in the paper.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.see = _conv(channels, channels)
        self.change = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.change.weight)
        nn.init.zeros_(self.change.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, h, w) to the same shape."""
        return x + self.change(self.see(x))


class LookAround(nn.Module):
    """Let every cell of a coarse map look at every other: a block of a transformer, which at first changes nothing.

    Not in the paper. One glass makes another likely, and a mirror shows what stands elsewhere in the picture: what a
    convolution sees is too small for that. Attention alone does not know who is whose neighbour; a depthwise
    convolution before it does, at any size of the map.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.heads = max(channels // 32, 1)
        self.place = nn.Conv2d(channels, channels, 3, padding=1, groups=channels)
        self.norm = nn.LayerNorm(channels)
        self.to_qkv, self.out = nn.Linear(channels, 3 * channels), nn.Linear(channels, channels)
        self.widen, self.narrow = nn.Linear(channels, 2 * channels), nn.Linear(2 * channels, channels)
        self.norm_mixed = nn.LayerNorm(channels)
        for last in (self.place, self.out, self.narrow):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, h, w) to the same shape."""
        size = x.shape[2:]
        x = (x + self.place(x)).flatten(2).transpose(1, 2)  # (B, C, h, w) -> (B, hw, C)
        qkv = self.to_qkv(self.norm(x)).unflatten(2, (3 * self.heads, -1))  # (B, hw, 3 heads, d)
        q, k, v = qkv.transpose(1, 2).chunk(3, dim=1)  # each (B, heads, hw, d)
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)  # (B, hw, C)
        x = x + self.out(mixed)
        x = x + self.narrow(F.gelu(self.widen(self.norm_mixed(x))))
        return x.transpose(1, 2).unflatten(2, size)


class BoundaryRefinement(nn.Module):
    """Predict the region's boundary and correct the features there, and only there.

    Decoded features come from coarse levels and are smooth; ``fine`` are the fused features at stride 2, which are not.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.see = _conv(2 * channels, channels)
        self.predict = nn.Conv2d(channels, 1, 1)
        self.correct = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, decoded: Tensor, fine: Tensor) -> tuple[Tensor, Tensor]:
        """Return sharpened features (B, C, h, w) and boundary logits (B, 1, h, w)."""
        seen = self.see(torch.cat([decoded, fine], dim=1))  # (B, 2C, h, w) -> (B, C, h, w)
        boundary = self.predict(seen)
        return decoded + torch.sigmoid(boundary) * self.correct(seen), boundary


class RegionNet(nn.Module):
    """Classify every pixel as background, transparent or reflective from RGB and raw depth.

    Paper: Sec. IV-B, S1. Two encoders, fusion at every level, a decoder that adds finer fused features on its way up,
    boundary refinement at stride 2. Side outputs for deep supervision and classes are ours, attention and more blocks
    too; without the last two (0 of each) it is the network that the ``paper`` preset takes.

    The depth encoder also sees the validity mask: that a reading is missing is evidence too.
    """

    def __init__(self, config: RegionConfig):
        super().__init__()
        widths = level_widths(config.width, config.levels)
        self.config = config
        self.encoder_rgb = COLOUR_ENCODERS[config.colour](3, widths)
        self.encoder_depth = Encoder(2, widths)
        self.fusion = nn.ModuleList(CrossModalFusion(c) for c in widths)
        self.context = _conv(widths[-1], widths[-1], dilation=2)
        self.around = _chain(LookAround, widths[-1], config.attention)
        finer = list(zip(widths[:-1], widths[1:], strict=True))[::-1]  # (fine, coarse) channels, coarse levels first
        self.lateral = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in finer)
        self.decode = nn.ModuleList(_conv(fine, fine) for fine, _ in finer)
        self.deepen = nn.ModuleList(_chain(Residual, fine, config.blocks) for fine, _ in finer[1:])
        self.deepen.insert(0, _chain(LookAround, finer[0][0], config.attention))
        self.side = nn.ModuleList(nn.Conv2d(c, config.classes, 1) for c in reversed(widths[1:]))
        self.boundary = BoundaryRefinement(widths[0])
        self.classify = nn.Conv2d(widths[0], config.classes, 1)

    def forward(self, rgb: Tensor, depth_n: Tensor, valid: Tensor) -> dict[str, Any]:
        """Return class and boundary logits.

        Args:
            rgb: (B, 3, H, W) in [-1, 1].
            depth_n: (B, 1, H, W) normalised raw depth; ignored where invalid.
            valid: (B, 1, H, W) bool or 0/1.

        Returns:
            ``logits`` (B, classes, H, W); ``side``, logits of the coarser levels, coarsest first, at their own sizes;
            ``boundary`` (B, 1, H, W) logits.

        Raises:
            ValueError: when the shapes do not fit together.
        """
        one = (len(rgb), 1, *rgb.shape[2:])
        if rgb.ndim != 4 or rgb.shape[1] != 3 or depth_n.shape != one or valid.shape != one:
            raise ValueError(
                "expected rgb (B, 3, H, W) with depth_n and valid (B, 1, H, W); "
                f"got {tuple(rgb.shape)}, {tuple(depth_n.shape)}, {tuple(valid.shape)}"
            )
        valid = valid.to(rgb.dtype)
        levels_rgb = self.encoder_rgb(rgb)
        levels_depth = self.encoder_depth(torch.cat([depth_n * valid, valid], dim=1))
        fused = [fuse(r, d) for fuse, r, d in zip(self.fusion, levels_rgb, levels_depth, strict=True)]
        x = self.around(fused[-1] + self.context(fused[-1]))
        side = []
        steps = zip(self.lateral, self.decode, self.deepen, self.side, reversed(fused[:-1]), strict=True)
        for lateral, decode, deepen, out, fine in steps:
            side.append(out(x))
            x = deepen(decode(_resize(lateral(x), fine) + fine))
        x, boundary = self.boundary(x, fused[0])
        return {"logits": _resize(self.classify(x), rgb), "side": side, "boundary": _resize(boundary, rgb)}


def region_probability(outputs: dict[str, Any]) -> Tensor:
    """Return (B, 1, H, W): the probability that a pixel is transparent or reflective, the two classes merged."""
    return outputs["logits"].softmax(dim=1)[:, 1:].sum(dim=1, keepdim=True)


def refine_region(mask: np.ndarray, median: int = 7, dilate: int = 5, iterations: int = 3) -> np.ndarray:
    """Smooth a region mask with a median filter, then grow it by dilation.

    Paper: Sec. IV-B, S2, median 7x7, then dilation 5x5 in 3 iterations (together one 13x13 dilation, 6 pixels a side).
    Of no named resolution; these are pixels of the mask given, so at 256x192 they roughly double a true region.
    Borders: the median repeats the border pixel outwards; beyond the border nothing dilates inwards.

    Args:
        mask: (H, W) bool.
        median: side of the median window in pixels, odd; 0 or 1 leaves the step out.
        dilate: side of the square dilation kernel in pixels, odd; 0 or 1 leaves the step out.
        iterations: how often to dilate; 0 leaves the step out.

    Returns:
        (H, W) bool.

    Raises:
        ValueError: for a mask that is not two-dimensional bool, an even kernel or a negative number.
    """
    mask = np.asarray(mask)
    if mask.ndim != 2 or mask.dtype != bool:
        raise ValueError(f"expected a mask (H, W) bool, got {mask.shape} {mask.dtype}; threshold it first")
    check_kernels(median, dilate, iterations)
    out = mask.astype(np.uint8)
    if median > 1:
        out = cv2.medianBlur(out, median)
    if dilate > 1 and iterations > 0:
        out = cv2.dilate(out, np.ones((dilate, dilate), np.uint8), iterations=iterations)
    return out.astype(bool)
