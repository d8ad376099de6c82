"""Boundaries found by a small network of ours, trained on the exact outlines that the simulator knows.

Two U-Nets of one shape: one looks at colour and finds all outlines, one looks at depth and finds those where depth
jumps. Each predicts, per pixel, whether a boundary lies within a pixel of it; cut at a threshold chosen on the
validation split, and thinned, that is a map one pixel wide. ``training.boundary`` trains them.
"""

from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..conditioning import to_tensor
from ..region import Encoder
from ..store import fingerprint, load_part
from .classical import drop_small, is_depth

MODES = {"rgb": 3, "depth": 3}  # input channels
WIDTH, LEVELS = 16, 4
MULTIPLE = 2**LEVELS  # of H and W
RELIEF = 8.0  # gain: a step of a centimetre is a few hundredths of a network unit
LEAST_SPAN_M = 0.15  # of a frame's depth: one flat wall


class BoundaryNet(nn.Module):
    """A U-Net with stage one's encoder, whose last step also sees the pixels themselves, folded into channels.

    Args:
        channels_in: of the image.
        width: channels at half size; doubled at every further level.
        levels: sizes 1/2, 1/4, ...
    """

    def __init__(self, channels_in: int, width: int = WIDTH, levels: int = LEVELS):
        super().__init__()
        widths = [width * 2**k for k in range(levels)]
        self.encoder = Encoder(channels_in, widths)
        self.decode = nn.ModuleList(_conv(3 * w, w) for w in reversed(widths[:-1]))
        self.last = _conv(width + 4 * channels_in, 2 * width)
        self.out = nn.Conv2d(2 * width, 4, 1)
        nn.init.constant_(self.out.bias, -3.0)  # boundaries are rare: begin with 5 %, not with one half

    def forward(self, image: Tensor) -> Tensor:
        """Return logits (B, 1, H, W) of "a boundary lies within a pixel" for (B, C, H, W), multiples of 16."""
        *finer, x = self.encoder(image)
        for decode, fine in zip(self.decode, reversed(finer), strict=True):
            x = decode(torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), fine], dim=1))
        x = self.last(torch.cat([x, F.pixel_unshuffle(image, 2)], dim=1))  # (B, 4C, H/2, W/2) of pixels
        return F.pixel_shuffle(self.out(x), 2)


def _conv(channels_in: int, channels: int) -> nn.Sequential:
    conv = nn.Conv2d(channels_in, channels, 3, padding=1, bias=False)
    return nn.Sequential(conv, nn.GroupNorm(8, channels), nn.ReLU())


def build_nets() -> nn.ModuleDict:
    """Return the two untrained networks, ``rgb`` and ``depth``."""
    return nn.ModuleDict({mode: BoundaryNet(channels) for mode, channels in MODES.items()})


def begin_with_stage_one(nets: nn.ModuleDict, region: dict[str, Tensor]) -> list[str]:
    """Copy what stage one's encoders have learned of telling glass from table into networks whose encoders are alike.

    Args:
        nets: from :func:`build_nets`; changed in place. The depth network's third channel, relief, begins with zeros.
        region: the tensors of ``region.safetensors``; an encoder of other sizes, or a pretrained one, is left out.

    Returns:
        the names of the networks that begin so.
    """
    begun = []
    for mode, net in nets.items():
        start = f"encoder_{mode}."
        own = net.encoder.state_dict()
        given = {k.removeprefix(start): v.clone() for k, v in region.items() if k.startswith(start)}
        for key in own.keys() & given.keys():
            more = own[key].ndim == 4 and own[key].shape[1] - given[key].shape[1]
            if more > 0:
                given[key] = F.pad(given[key], (0, 0, 0, 0, 0, more))
        alike = own.keys() == given.keys() and all(own[k].shape == given[k].shape for k in own)
        if alike:
            net.encoder.load_state_dict(given)
            begun.append(mode)
    return begun


def linear_units(depth: np.ndarray) -> np.ndarray:
    """Return depth (H, W) in metres as the depth network was trained to see it, (H, W) float32.

    Linear, unlike ``conditioning.Bounds``: the 2nd and 98th percentile of the readings, widened downwards by a quarter
    of their span and upwards by a tenth, become -1 and 1. The networks were trained so, and for outlines it serves:
    what squeezes the range, a room behind the table, is far from the outlines that count, and relief is clipped anyway.

    Args:
        depth: (H, W) metres, 0 = missing, with at least one reading.
    """
    low, high = (float(q) for q in np.percentile(depth[depth > 0], [2, 98]))
    spare = max(LEAST_SPAN_M - (high - low), 0) / 2
    low, high = low - spare, high + spare
    span = high - low
    low, high = low - 0.25 * span, high + 0.10 * span
    return ((depth - low) * (2 / (high - low)) - 1).astype(np.float32)


def depth_image(depth_n: Tensor, valid: Tensor) -> Tensor:
    """Return what the depth network looks at: (B, 3, H, W) normalised depth, validity, relief.

    Relief is a reading minus the mean of the readings in its 9x9 surroundings, times a gain: a step that is small
    beside the range of the frame becomes large.

    Args:
        depth_n: (B, 1, H, W) depth in :func:`linear_units`, anything where not valid.
        valid: (B, 1, H, W) 0/1.
    """
    depth_n = (depth_n * valid).clamp(-2, 2)
    mean = F.avg_pool2d(depth_n, 9, 1, 4) / F.avg_pool2d(valid, 9, 1, 4).clamp(min=1e-6)
    return torch.cat([depth_n, valid, RELIEF * (depth_n - mean).clamp(-0.25, 0.25) * valid], dim=1)


def depth_input(depth: np.ndarray) -> Tensor:
    """Return what the depth network looks at, (1, 3, H, W), of depth (H, W) in metres with at least one reading."""
    valid = torch.from_numpy((depth > 0).astype(np.float32))[None, None]
    return depth_image(torch.from_numpy(linear_units(depth))[None, None], valid)


def thin(probability: np.ndarray, threshold: float, min_length: int = 8) -> np.ndarray:
    """Return (H, W) bool: the ridges of what exceeds ``threshold``, without pieces under ``min_length`` pixels.

    Non-maximum suppression as in Canny's detector, for ridges instead of slopes: a pixel stays when it is not lower
    than both its neighbours in the direction (of four) in which the smoothed map is curved most. Slanted lines come out
    up to two pixels wide.

    Args:
        probability: (H, W) float32.
        threshold: between 0 and 1.
        min_length: pixels.
    """
    smooth = cv2.GaussianBlur(np.asarray(probability, np.float32), (0, 0), 1.0)
    xx, yy, xy = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((2, 0), (0, 2), (1, 1)))
    across = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2  # axis of the most negative curvature
    direction = np.rint(across / (np.pi / 4)).astype(int) % 4
    ridge, (h, w), padded = np.zeros(smooth.shape, bool), smooth.shape, np.pad(smooth, 1, mode="edge")
    for k, (dx, dy) in enumerate(((1, 0), (1, 1), (0, 1), (-1, 1))):
        after, before = (padded[1 + s * dy : 1 + s * dy + h, 1 + s * dx : 1 + s * dx + w] for s in (1, -1))
        ridge |= (direction == k) & (smooth >= after) & (smooth > before)
    return drop_small(ridge & (smooth > threshold), min_length)


class LearnedBoundary:
    """The trained networks as a backend.

    Args:
        nets: as :func:`build_nets` makes them.
        thresholds: probability above which a pixel is a boundary, per mode.
    """

    def __init__(self, nets: nn.ModuleDict, thresholds: dict[str, float]):
        self.nets = nets.eval().requires_grad_(False).to(memory_format=torch.channels_last)
        self.thresholds = thresholds

    @property
    def fingerprint(self) -> str:
        """Checksum of all that the maps depend on, for caches."""
        return fingerprint(self.nets, *self.thresholds.values())

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the (H, W) bool boundary map of an image or of a depth map (see ``boundary.Backend``).

        Raises:
            ValueError: for anything else.
        """
        image = np.asarray(image)
        return thin(self.probability(image), self.thresholds["depth" if is_depth(image) else "rgb"])

    @torch.no_grad()
    def probability(self, image: np.ndarray) -> np.ndarray:
        """Return (H, W) float32: how probable a boundary is within a pixel of each pixel."""
        image = np.asarray(image)
        mode = "depth" if is_depth(image) else "rgb"
        height, width = image.shape[:2]
        if mode == "depth":
            if not (image > 0).any():
                return np.zeros((height, width), np.float32)
            x = depth_input(image)
        else:
            x = to_tensor(image[None])
        x = F.pad(x, (0, -width % MULTIPLE, 0, -height % MULTIPLE), mode="replicate")
        x = x.contiguous(memory_format=torch.channels_last)
        return torch.sigmoid(self.nets[mode](x))[0, 0, :height, :width].numpy()


def load(path: Path | str | None = None) -> LearnedBoundary:
    """Return the backend with the shipped weights, or with those of the weights folder ``path``.

    Raises:
        ValueError: when there are none, or they are damaged or of other sizes.
    """
    try:
        state, nets = load_part("boundary", path), build_nets()
    except ValueError as error:
        raise ValueError(f"{error} (this part by `python -m ditr_lite train-boundary`)") from None
    thresholds = state.pop("thresholds", torch.empty(0))
    try:
        nets.load_state_dict(state)
        named = dict(zip(MODES, thresholds.tolist(), strict=True))
    except (RuntimeError, ValueError):  # torch's message is a page of tensor names
        raise ValueError("the boundary weights are of other sizes; train them with `train-boundary`") from None
    return LearnedBoundary(nets, named)
