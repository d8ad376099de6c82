"""The body that learned peers share: one U-Net at pixel size, as large as a denoiser of DITR, with the same colour.

What differs between peers is the idea (``peers.ideas``), not the capacity: the channels at strides 4, 8, 16 and 32 are
those of the shipped denoiser, and the features of the pretrained encoder of colour come in at the same strides.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..region import Encoder
from ..unet import norm

WIDTH, LEVELS = 16, 5  # channels at stride 2, doubled at every further level


class PixelUNet(nn.Module):
    """A U-Net with stage one's encoder whose last step also sees the pixels themselves, folded into channels.

    Args:
        channels_in: of the image.
        channels_out: of the result; the last convolution starts at zero.
        colour_channels: of the pretrained encoder's features at strides 4, 8, 16; () without them.
        width: channels at half size; doubled at every further level.
        levels: sizes 1/2, 1/4, ...
    """

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        colour_channels: Sequence[int] = (),
        width: int = WIDTH,
        levels: int = LEVELS,
    ):
        super().__init__()
        widths = [width * 2**k for k in range(levels)]
        self.encoder = Encoder(channels_in, widths)
        self.colour = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in zip(colour_channels, widths[1:], strict=False))
        self.decode = nn.ModuleList(conv(3 * w, w) for w in reversed(widths[:-1]))
        self.last = conv(width + 4 * channels_in, 2 * width)
        self.out = nn.Conv2d(2 * width, 4 * channels_out, 3, padding=1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, image: Tensor, colour: Sequence[Tensor] = ()) -> Tensor:
        """Map (B, channels_in, H, W) to (B, channels_out, H, W); H and W multiples of 2^levels.

        ``colour`` are the pretrained features of the picture at strides 4, 8, 16.
        """
        return F.pixel_shuffle(self.out(self.body(image, colour)), 2)

    def body(self, image: Tensor, colour: Sequence[Tensor] = ()) -> Tensor:
        """Return the features (B, 2 width, H/2, W/2) from which the last convolution reads."""
        if len(colour) < len(self.colour):
            raise ValueError(f"colour: expected features at {len(self.colour)} strides, got {len(colour)}")
        maps = self.encoder(image)
        for level, (project, given) in enumerate(zip(self.colour, colour, strict=False), start=1):
            maps[level] = maps[level] + project(given)
        *finer, x = maps
        for decode, fine in zip(self.decode, reversed(finer), strict=True):
            x = decode(torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), fine], dim=1))
        return self.last(torch.cat([x, F.pixel_unshuffle(image, 2)], dim=1))  # (B, 4 Cin, H/2, W/2) of pixels


class Critic(nn.Module):
    """Judge patches of 30 pixels of a picture and its depth: above 0 for true depth, below for painted depth."""

    def __init__(self, width: int = WIDTH):
        super().__init__()
        widths = (4, width, 2 * width, 4 * width)
        layers = []
        for a, b in zip(widths[:-1], widths[1:], strict=True):
            layers += [nn.Conv2d(a, b, 4, stride=2, padding=1), nn.LeakyReLU(0.2)]
        self.layers = nn.Sequential(*layers, nn.Conv2d(widths[-1], 1, 3, padding=1))

    def forward(self, rgb: Tensor, depth_n: Tensor) -> Tensor:
        """Map (B, 3, H, W) and (B, 1, H, W) to (B, 1, H/8, W/8)."""
        return self.layers(torch.cat([rgb, depth_n], dim=1))


def conv(channels_in: int, channels: int) -> nn.Sequential:
    """Return a 3x3 convolution, normalised and followed by SiLU."""
    return nn.Sequential(nn.Conv2d(channels_in, channels, 3, padding=1), norm(channels), nn.SiLU())


def perceptron(*widths: int) -> nn.Sequential:
    """Return 1x1 convolutions with SiLU between them: the same small network for every point (B, C, N)."""
    layers = []
    for a, b in zip(widths[:-1], widths[1:], strict=True):
        layers += [nn.Conv1d(a, b, 1), nn.SiLU()]
    return nn.Sequential(*layers[:-1])
