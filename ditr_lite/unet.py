"""The denoiser: a U-Net over latents that looks at the image through cross-attention.

Paper: Sec. IV-C "Denoising Step". Four levels, channels doubling; 3x3 convolutions; 2x2 max-pooling; a 1x1 convolution
as linear projection at the bottom; up-sampling by 2x2 convolutions, each followed by two 3x3 convolutions; self- and
cross-attention. How t and the raw depth come in is left open: here t through a sinusoidal embedding and an MLP (DDPM),
the encoded masked depth and its mask concatenated to L_t (latent inpainting). Notation: ``latents`` is L_t (DDPM's
x_t), ``features`` F(x), the result x_theta of Eq. 9 or, as trained, epsilon_theta or v_theta.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .config import UNetConfig

Maps = list[Tensor]  # F(x): one map per level, finest first
STRIDE = 4  # pixels per latent cell and side (S5: sampling scale 4)


def norm(channels: int) -> nn.GroupNorm:
    """Return group normalisation over groups of 8 channels, or the next larger number that divides them equally."""
    most = max(channels // 8, 1)
    return nn.GroupNorm(next(groups for groups in range(most, 0, -1) if channels % groups == 0), channels)


def sinusoid(position: Tensor, channels: int, longest: float) -> Tensor:
    """Write numbers (N,) as sines, then cosines, of frequencies from 1 down to 1 / longest, (N, channels) float32."""
    frequency = torch.exp(-math.log(longest) * torch.linspace(0, 1, channels // 2, device=position.device))
    angle = position.float()[:, None] * frequency  # (N, channels / 2)
    return torch.cat([angle.sin(), angle.cos()], dim=1)


def grid_code(height: int, width: int, channels: int, device: torch.device) -> Tensor:
    """Return the place of every cell of a grid as sinusoids of its row (first half) and column, (H * W, channels).

    Fixed, not a learnt depthwise convolution: in cross-attention query and keys come from two streams, which must share
    one coordinate system. Here code(i) . code(j) depends on the offset i - j only and is largest at 0, so "look at the
    same place" is there before training; any grid size works; no weights.
    """
    rows = sinusoid(torch.arange(height, device=device), channels // 2, longest=64.0)  # (H, channels / 2)
    columns = sinusoid(torch.arange(width, device=device), channels // 2, longest=64.0)  # (W, channels / 2)
    return torch.cat([rows.repeat_interleave(width, 0), columns.repeat(height, 1)], dim=1)


class Attention(nn.Module):
    """Multi-head attention from one map (query) to another (source) of the same size: softmax(Q K^T / sqrt(d)) V.

    Q and K carry the grid code, V does not: *where* decides who is looked at, *what* is fetched is content alone.
    """

    def __init__(self, query_channels: int, source_channels: int, channels: int, heads: int):
        super().__init__()
        if channels % (4 * heads):
            raise ValueError(f"attention: {channels} channels do not divide into {heads} heads of a multiple of 4")
        self.heads = heads
        self.norm_query, self.norm_source = norm(query_channels), norm(source_channels)
        self.to_q = nn.Linear(query_channels, channels)
        self.to_k = nn.Linear(source_channels, channels, bias=False)  # a bias on K cancels in the softmax
        self.to_v = nn.Linear(source_channels, channels)
        self.out = nn.Linear(channels, channels)  # "then projected to an output channel dimension"

    def forward(self, query: Tensor, source: Tensor) -> Tensor:
        """Attend: query (B, Cq, H, W), source (B, Cs, H, W) -> (B, channels, H, W)."""
        h, w = query.shape[2:]
        query = self.norm_query(query).permute(0, 2, 3, 1).flatten(1, 2)  # (B, C, H, W) -> (B, HW, C): no copy
        source = self.norm_source(source).permute(0, 2, 3, 1).flatten(1, 2)  # is made when memory is channels_last
        q, k, v = self.to_q(query), self.to_k(source), self.to_v(source)  # each (B, HW, C)
        q, k, v = (x.unflatten(2, (self.heads, -1)).transpose(1, 2) for x in (q, k, v))  # (B, heads, HW, d)
        place = grid_code(h, w, q.shape[-1], q.device).to(q.dtype)  # (HW, d), the same for every head
        mixed = F.scaled_dot_product_attention(q + place, k + place, v)  # (B, heads, HW, d)
        tokens = self.out(mixed.transpose(1, 2).flatten(2))  # (B, HW, C)
        return tokens.unflatten(1, (h, w)).permute(0, 3, 1, 2)  # (B, C, H, W)


class CrossAttentionFeatureQuery(Attention):
    """The image asks, the latent answers: Q from F(x), K and V from L_t, so that *depth* is gathered.

    Paper: Sec. IV-C: L_t is "encoded as value and key", the feature "transformed under the single-query attention".
    """

    def __init__(self, channels: int, feature_channels: int, heads: int):
        super().__init__(feature_channels, channels, channels, heads)

    def forward(self, latent: Tensor, feature: Tensor) -> Tensor:
        """Attend: latent (B, C, H, W), feature (B, Cf, H, W) -> (B, C, H, W)."""
        return super().forward(query=feature, source=latent)


class CrossAttentionLatentQuery(Attention):
    """The latent asks, the image answers, as in latent diffusion: Q from L_t, K and V from F(x)."""

    def __init__(self, channels: int, feature_channels: int, heads: int):
        # forward(latent, feature): the order fits already
        super().__init__(channels, feature_channels, channels, heads)


class PlainBlock(nn.Module):
    """Two 3x3 convolutions, each followed by ReLU (on the way up the paper names one), time added after the first."""

    def __init__(self, in_channels: int, channels: int, time_channels: int):
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        self.time = nn.Linear(time_channels, channels)

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        """Map (B, Cin, H, W) and time (B, Ct) to (B, C, H, W)."""
        return F.relu(self.conv2(F.relu(self.conv1(x) + self.time(time)[:, :, None, None])))


class NormalisedBlock(PlainBlock):
    """The same convolutions, normalised before (GroupNorm, SiLU) and added to their input: it trains faster."""

    def __init__(self, in_channels: int, channels: int, time_channels: int):
        super().__init__(in_channels, channels, time_channels)
        self.norm1, self.norm2 = norm(in_channels), norm(channels)
        self.skip = nn.Identity() if in_channels == channels else nn.Conv2d(in_channels, channels, 1)

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        """Map (B, Cin, H, W) and time (B, Ct) to (B, C, H, W)."""
        h = self.conv1(F.silu(self.norm1(x))) + self.time(time)[:, :, None, None]
        return self.skip(x) + self.conv2(F.silu(self.norm2(h)))


CROSS_ATTENTION = {"feature": CrossAttentionFeatureQuery, "latent": CrossAttentionLatentQuery}
BLOCKS = {"residual": NormalisedBlock, "plain": PlainBlock}


class Level(nn.Module):
    """Level ``i``: two convolutions at one size, then, at an attention level, self- and cross-attention."""

    def __init__(self, i: int, in_channels: int, config: UNetConfig):
        super().__init__()
        channels = config.width * config.multipliers[i]
        feature_channels = config.cond_channels * config.multipliers[i]
        self.block = BLOCKS[config.block](in_channels, channels, 4 * config.width)
        self.attention = i in config.attention_levels
        if self.attention:
            self.self_attention = Attention(channels, channels, channels, config.heads)
            self.cross_attention = CROSS_ATTENTION[config.query](channels, feature_channels, config.heads)

    def forward(self, x: Tensor, time: Tensor, feature: Tensor | None) -> Tensor:
        """Map (B, Cin, H, W) to (B, C, H, W), looking at ``feature`` (B, Cf, H, W)."""
        x = self.block(x, time)
        if self.attention:
            x = x + self.self_attention(x, x)
            x = x + self.cross_attention(x, feature)
        return x


class FeatureExtractor(nn.Module):
    """F(x): the conditioning image at latent size (no pixel thrown away) and, for the attentions, at coarser sizes."""

    def __init__(self, in_channels: int, config: UNetConfig):
        super().__init__()
        levels = 1 + max(config.attention_levels, default=0)
        widths = [config.cond_channels * m for m in config.multipliers[:levels]]
        self.steps = nn.ModuleList()
        a = in_channels * STRIDE**2
        for i, b in enumerate(widths):
            first = nn.Conv2d(a, b, 3, stride=2 if i else 1, padding=1)
            second = nn.Conv2d(b, b, 3, padding=1)
            self.steps.append(nn.Sequential(first, norm(b), nn.SiLU(), second))
            a = b
        pairs = zip(config.colour_channels, widths, strict=False)
        self.colour = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in pairs)

    def forward(self, cond: Tensor, colour: Maps = ()) -> Maps:
        """Map (B, Cin, H, W) to [(B, cond_channels, H/4, W/4), twice the channels at H/8, ...].

        ``colour`` are the features of a pretrained encoder at H/4, H/8, ..., (B, colour_channels[i], ...) each.
        """
        features = []
        x = F.pixel_unshuffle(cond, STRIDE)  # (B, Cin, H, W) -> (B, 16 Cin, H/4, W/4)
        for i, step in enumerate(self.steps):
            x = step(F.silu(x) if i else x)
            if i < len(self.colour):
                x = x + self.colour[i](colour[i])
            features.append(x)
        return features


class DenoisingUNet(nn.Module):
    """The denoiser, x_theta(L_t, t, F(x)), of a conditioning image with ``cond_in_channels`` (RGB, boundary map, ...).

    Raises ValueError for a block, query or level that does not exist.
    """

    def __init__(self, config: UNetConfig, latent_channels: int, cond_in_channels: int):
        super().__init__()
        for name, value, known in (("block", config.block, BLOCKS), ("query", config.query, CROSS_ATTENTION)):
            if value not in known:
                raise ValueError(f"unknown {name} {value!r}; choose one of {', '.join(known)}")
        if not set(config.attention_levels) <= set(range(len(config.multipliers))):
            raise ValueError(f"attention_levels {config.attention_levels}: only {len(config.multipliers)} levels exist")
        self.config, self.latent_channels = config, latent_channels
        widths = [config.width * m for m in config.multipliers]
        wide = 4 * config.width
        self.extractor = FeatureExtractor(cond_in_channels, config)
        self.time = nn.Sequential(nn.Linear(config.width, wide), nn.SiLU(), nn.Linear(wide, wide), nn.SiLU())
        self.stem = nn.Conv2d(2 * latent_channels + 1 + config.cond_channels, widths[0], 3, padding=1)  # 1: the mask
        ups = range(len(widths) - 2, -1, -1)  # coarse to fine
        self.down = nn.ModuleList(Level(i, widths[max(i - 1, 0)], config) for i in range(len(widths)))
        self.project = nn.Conv2d(widths[-1], widths[-1], 1)  # "1x1 convolution layer for linear projection"
        self.upsample = nn.ModuleList(nn.ConvTranspose2d(widths[i + 1], widths[i], 2, stride=2) for i in ups)
        self.up = nn.ModuleList(Level(i, 2 * widths[i], config) for i in ups)
        self.norm = norm(widths[0])
        self.out = nn.Conv2d(widths[0], latent_channels, 3, padding=1)
        nn.init.zeros_(self.out.weight)  # an untrained network predicts 0, the mean of normalised latents
        nn.init.zeros_(self.out.bias)

    def features(self, cond: Tensor, colour: Maps = ()) -> Maps:
        """Return F(x) of a conditioning image (B, Cin, H, W); it does not depend on t: compute it once per image.

        ``colour``: features of the picture by a pretrained encoder at strides 4, 8, ..., as many as the configuration
        names channels.
        """
        if cond.ndim != 4 or cond.shape[2] % STRIDE or cond.shape[3] % STRIDE:
            raise ValueError(f"cond: expected (B, C, H, W), H and W multiples of {STRIDE}, got {tuple(cond.shape)}")
        if len(colour) != len(self.config.colour_channels):
            raise ValueError(f"colour: expected {len(self.config.colour_channels)} maps, got {len(colour)}")
        return self.extractor(cond, colour)

    def forward(
        self,
        latents: Tensor,
        t: Tensor,
        features: Maps,
        masked_latents: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Predict from noisy latents what the training asked for, like ``latents``.

        Args:
            latents: (B, C, h, w) floating, L_t; h and w multiples of 2^(levels - 1).
            t: (B,) long.
            features: what :meth:`features` returned, F(x).
            masked_latents: (B, C, h, w) encoded masked depth, or None for zeros: nothing is known.
            mask: (B, 1, h, w) where it is known, or None for zeros: nowhere.
        """
        b, c, h, w = latents.shape
        known = latents.new_zeros(b, c, h, w) if masked_latents is None else masked_latents
        mask = latents.new_zeros(b, 1, h, w) if mask is None else mask
        k = 2 ** (len(self.down) - 1)
        if c != self.latent_channels or h % k or w % k or t.shape != (b,):
            expected = f"latents (B, {self.latent_channels}, h, w), h and w multiples of {k}, and t (B,)"
            raise ValueError(f"expected {expected}, got {tuple(latents.shape)} and {tuple(t.shape)}")
        x = self.stem(torch.cat([latents, known, mask.to(latents.dtype), features[0]], dim=1))
        time = self.time(sinusoid(t, self.config.width, longest=10_000.0).to(latents.dtype))  # (B, 4 * width)
        features = [*features, *[None] * len(self.down)]  # levels without attention look at nothing
        skips = []
        for i, level in enumerate(self.down):
            x = level(F.max_pool2d(x, 2) if i else x, time, features[i])
            skips.append(x)
        x = self.project(skips.pop())
        for upsample, level in zip(self.upsample, self.up, strict=True):
            x = level(torch.cat([upsample(x), skips.pop()], dim=1), time, features[len(skips)])
        out = self.out(F.silu(self.norm(x))).to(latents.dtype)  # float32 also where bfloat16 computes
        return out + known if self.config.anchor else out
