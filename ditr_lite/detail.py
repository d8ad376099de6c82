"""The finer final step: a small network at pixel size that corrects what the decoder blurs.

Not in the paper. The autoencoder works at a quarter of the resolution and, at depth edges, its error is several times
that inside surfaces; geometric loss lies along edges. This network sees the decoded depth beside the image and adds a
residual. Width 0 in the configuration leaves it out, which is the paper's system.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ditr_lite.config import DetailConfig
from ditr_lite.unet import norm

CHANNELS = ("decoded", "raw", "known", "branch", "red", "green", "blue", "boundary")  # of the input, in this order
LEVELS = 3  # at strides 2, 4 and 8


def convs(in_channels: int, channels: int, count: int) -> nn.Sequential:
    """Return ``count`` 3x3 convolutions, each normalised and followed by SiLU: (B, Cin, H, W) -> (B, C, H, W)."""
    layers = []
    for i in range(count):
        layers += [nn.Conv2d(channels if i else in_channels, channels, 3, padding=1), norm(channels), nn.SiLU()]
    return nn.Sequential(*layers)


class DetailNet(nn.Module):
    """A U-Net over 2x2 pixel blocks that predicts what to add to the decoded depth.

    Its last convolution starts at zero: untrained, it leaves the decoder's depth exactly as it is. Skips are added, not
    concatenated: half the cost at the size where the cost lies.

    Raises:
        ValueError: for a width below 1 (width 0 means: do not build this network).
    """

    def __init__(self, config: DetailConfig):
        super().__init__()
        if config.width < 1:
            raise ValueError(f"DetailNet: expected a width of at least 1, got {config.width}; for 0 leave it out")
        widths = [config.width * 2**i for i in range(LEVELS)]
        ins = [4 * len(CHANNELS), *widths[:-1]]
        # one convolution at stride 2, where each costs most, and on the way up
        self.down = nn.ModuleList(convs(a, b, 2 if i else 1) for i, (a, b) in enumerate(zip(ins, widths, strict=True)))
        fine_to_coarse = list(zip(widths[:-1], widths[1:], strict=True))
        self.upsample = nn.ModuleList(nn.ConvTranspose2d(b, a, 2, stride=2) for a, b in reversed(fine_to_coarse))
        self.up = nn.ModuleList(convs(a, a, 1) for a, _ in reversed(fine_to_coarse))
        self.out = nn.Conv2d(widths[0], 4, 3, padding=1)  # 4 = one value for each pixel of a 2x2 block
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Predict the residual.

        Args:
            x: (B, 8, H, W) floating, channels as in ``CHANNELS``: decoded and raw depth (normalised), mask of known
                readings, mask of the optical branch, RGB in [-1, 1], boundary map; H and W multiples of 8.

        Returns:
            (B, 1, H, W), to be added to the decoded depth.

        Raises:
            ValueError: for another number of channels or a size that is not a multiple of 8.
        """
        if x.ndim != 4 or x.shape[1] != len(CHANNELS) or x.shape[2] % 2**LEVELS or x.shape[3] % 2**LEVELS:
            raise ValueError(
                f"x: expected (B, {len(CHANNELS)}, H, W) with channels {', '.join(CHANNELS)}, H and W multiples of "
                f"{2**LEVELS}, got {tuple(x.shape)}"
            )
        x = F.pixel_unshuffle(x, 2)  # (B, 8, H, W) -> (B, 32, H/2, W/2)
        skips = []
        for i, level in enumerate(self.down):
            x = level(F.max_pool2d(x, 2) if i else x)
            skips.append(x)
        skips.pop()
        for upsample, level in zip(self.upsample, self.up, strict=True):
            x = level(upsample(x) + skips.pop())
        return F.pixel_shuffle(self.out(x), 2)  # (B, 4, H/2, W/2) -> (B, 1, H, W)


def detail_input(
    decoded: Tensor, depth_n: Tensor, valid: Tensor, region: Tensor, image: Tensor, boundary: Tensor
) -> Tensor:
    """Return the (S, 8, H, W) input of :class:`DetailNet`, channels as in :data:`CHANNELS`.

    Args:
        decoded: (S, 1, H, W) normalised depth out of the decoder, both branches composed.
        depth_n: (B, 1, H, W) normalised raw depth; like all that follow, B is S or 1.
        valid: (B, 1, H, W) 0/1, measured pixels.
        region: (B, 1, H, W) 0/1, where the optical branch painted.
        image: (B, 3, H, W) in [-1, 1].
        boundary: (B, 1, H, W) 0/1, M_RGB.
    """
    known = valid * (1 - region)
    raw = torch.where(known > 0, depth_n, decoded)
    parts = [decoded, raw, known, region, image, boundary]
    return torch.cat([p.expand(len(decoded), -1, -1, -1) for p in parts], dim=1)
