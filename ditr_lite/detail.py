"""The finer final step: a small network at pixel size that corrects what the decoder blurs and ties it to the readings.

Not in the paper. The autoencoder works at a quarter of the resolution and, at depth edges, its error is several times
that inside surfaces; geometric loss lies along edges, four fifths of it within three pixels of a reading. This network
sees the decoded depth beside the image and beside a smooth fill from the readings around, which errs in other places
than the diffusion does. It blends the two, adds a residual, and then lets depth spread from pixel to pixel by
affinities that it predicts, readings being held: a convolutional spatial propagation (CSPN, Cheng et al. 2018). Width 0
in the configuration leaves it out, which is the paper's system.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .conditioning import fill
from .config import DetailConfig
from .unet import norm

CHANNELS = ("decoded", "raw", "known", "evidence", "branch", "red", "green", "blue", "boundary", "filled")  # of input
LEVELS = 3  # at strides 2, 4 and 8
DILATIONS = (3, 1)  # of the 3x3 neighbourhoods that depth spreads over, coarse to fine, each with its own affinities
ROUNDS = 3  # of spreading at each of them: a reading reaches 12 pixels far
OUTPUTS = 4 + 9 * len(DILATIONS)  # a pixel's residual, blend, trust in its reading outside and inside, affinities


def convs(in_channels: int, channels: int, count: int) -> nn.Sequential:
    """Return ``count`` 3x3 convolutions, each normalised and followed by SiLU: (B, Cin, H, W) -> (B, C, H, W)."""
    layers = []
    for i in range(count):
        layers += [nn.Conv2d(channels if i else in_channels, channels, 3, padding=1), norm(channels), nn.SiLU()]
    return nn.Sequential(*layers)


class DetailNet(nn.Module):
    """A U-Net over 2x2 pixel blocks that corrects the decoded depth and lets it spread.

    Its last convolution starts at zero: untrained, it is a plain smoothing that holds the readings. Skips are added,
    not concatenated: half the cost at the size where the cost lies.

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
        self.out = nn.Conv2d(widths[0], 4 * OUTPUTS, 3, padding=1)  # 4: each pixel of a 2x2 block has its own
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return the finer depth.

        Args:
            x: (B, 10, H, W) floating, channels as in ``CHANNELS``: decoded and raw depth (normalised), masks of
                readings outside and inside the region, mask of the optical branch, RGB in [-1, 1], boundary map, the
                smooth fill; H and W multiples of 8.

        Returns:
            (B, 1, H, W), normalised like the decoded depth.

        Raises:
            ValueError: for another number of channels or a size that is not a multiple of 8.
        """
        return self.spread(x, x[:, :1])

    def spread(self, x: Tensor, decoded: Tensor) -> Tensor:
        """Return the finer depth (S B, 1, H, W) of ``decoded`` (S B, 1, H, W), by what the network says of ``x``.

        ``x`` (B, 10, H, W) is as in :meth:`forward`. Of S samples, one batch after the other, residual, blend, trust
        and affinities are shared: the network, the costly part, runs once.
        """
        residual, blend, trust, affinities = self.predict(x)
        filled = x[:, -1:]
        held = (x[:, 2:4] * trust).sum(dim=1, keepdim=True)  # (B, 2, H, W) -> (B, 1, H, W): a pixel is in one of both
        finer = []
        for one in decoded.split(len(x)):  # one sample at a time: each takes the memory of all nine affinities
            start = torch.lerp(one, filled, blend) + residual
            finer.append(propagate(start, x[:, 1:2], held, affinities))
        return torch.cat(finer)

    def predict(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Return residual (B, 1, H, W), blend (B, 1, H, W), trust in readings (B, 2, H, W) and affinities per dilation.

        Blend lies in (0, 1): 0 takes the decoded depth, 1 the smooth fill. Trust lies in (0, 1), for readings outside
        and inside the region. Affinities are (B, 9, H, W) each, positive, and sum to 1 over the 9; see
        :func:`propagate`.
        """
        if x.ndim != 4 or x.shape[1] != len(CHANNELS) or x.shape[2] % 2**LEVELS or x.shape[3] % 2**LEVELS:
            raise ValueError(
                f"x: expected (B, {len(CHANNELS)}, H, W) with channels {', '.join(CHANNELS)}, H and W multiples of "
                f"{2**LEVELS}, got {tuple(x.shape)}"
            )
        kind = x.dtype
        x = F.pixel_unshuffle(x, 2)  # (B, 10, H, W) -> (B, 40, H/2, W/2)
        skips = []
        for i, level in enumerate(self.down):
            x = level(F.max_pool2d(x, 2) if i else x)
            skips.append(x)
        skips.pop()
        for upsample, level in zip(self.upsample, self.up, strict=True):
            x = level(upsample(x) + skips.pop())
        out = F.pixel_shuffle(self.out(x), 2)  # (B, 4 OUTPUTS, H/2, W/2) -> (B, OUTPUTS, H, W)
        out = out.to(kind)  # depth spreads in float32 also where bfloat16 computes
        residual, blend, trust, *kernels = out.split([1, 1, 2, *[9] * len(DILATIONS)], dim=1)
        blend = torch.sigmoid(blend - 2.0)  # at first the fill hardly counts,
        start = trust.new_tensor([3.0, -1.0]).view(1, 2, 1, 1)  # readings outside are trusted, and inside hardly
        return residual, blend, torch.sigmoid(trust + start), [k.softmax(dim=1) for k in kernels]


def propagate(start: Tensor, readings: Tensor, trust: Tensor, affinities: list[Tensor]) -> Tensor:
    """Let depth spread: each pixel becomes a mean of its neighbours by affinity, drawn back to its reading by trust.

    With equal affinities this is the relaxation that solves Laplace's equation; affinities that end at an object's
    edge keep its depth from running out.

    Args:
        start: (B, 1, H, W) depth to begin with.
        readings: (B, 1, H, W), anything where there is none.
        trust: (B, 1, H, W) in [0, 1], 0 where there is no reading; 1 holds a reading as it is.
        affinities: for each of :data:`DILATIONS` (B, 9, H, W), over the 3x3 neighbourhood row by row.

    Returns:
        (B, 1, H, W).
    """
    depth = start
    for dilation, affinity in zip(DILATIONS, affinities, strict=True):
        weights = affinity.unbind(1)  # 9 of (B, H, W)
        for _ in range(ROUNDS):
            spread = torch.zeros_like(depth)[:, 0]
            for weight, neighbour in zip(weights, neighbours(depth, dilation), strict=True):
                spread = torch.addcmul(spread, weight, neighbour)  # one at a time: a third of the cost of stacking
            depth = spread[:, None] + trust * (readings - spread[:, None])
    return depth


def neighbours(depth: Tensor, dilation: int) -> list[Tensor]:
    """Return the nine pixels of each 3x3 neighbourhood, ``dilation`` apart, of (B, 1, H, W), as nine (B, H, W).

    Row by row, the pixel itself being the fifth; beyond the border the border repeats.
    """
    height, width = depth.shape[2:]
    padded = F.pad(depth, [dilation] * 4, mode="replicate")[:, 0]
    steps = (0, dilation, 2 * dilation)
    return [padded[:, y : y + height, x : x + width] for y in steps for x in steps]


def detail_input(
    decoded: Tensor, depth_n: Tensor, valid: Tensor, region: Tensor, image: Tensor, boundary: Tensor
) -> Tensor:
    """Return the (S, 10, H, W) input of :class:`DetailNet`, channels as in :data:`CHANNELS`.

    Args:
        decoded: (S, 1, H, W) normalised depth out of the decoder, of one branch.
        depth_n: (B, 1, H, W) normalised raw depth; like all that follow, B is S or 1.
        valid: (B, 1, H, W) 0/1, measured pixels.
        region: (B, 1, H, W) 0/1, what the optical branch paints.
        image: (B, 3, H, W) in [-1, 1].
        boundary: (B, 1, H, W) 0/1, M_RGB.
    """
    raw = torch.where(valid > 0, depth_n, decoded)
    known = valid * (1 - region)
    filled = fill(depth_n, known)
    parts = [decoded, raw, known, valid * region, region, image, boundary, filled]
    return torch.cat([p.expand(len(decoded), -1, -1, -1) for p in parts], dim=1)
