"""VQ autoencoder: depth maps to latents a quarter of their size (or a half, an eighth, ...), and back.

Paper: Sec. IV-C "Latent Space" - ``L = Enc(D_in)``, ``D_out = Dec(L)``, sampling scale 4 (two down- and two
up-samplings), no skip connections, a quantisation layer inside the decoder. The quantiser is therefore the decoder's
first layer and ``encode`` gives continuous latents, which is what the diffusion works on (latent diffusion's
"VQ-reg").

Every pixel is a distance, so a blurred depth edge is a wrong depth edge. Three choices follow:

* no normalisation layer anywhere: the statistics of GroupNorm or InstanceNorm change with the size of the image, and a
  network trained on crops must give the same depth on whole images;
* stride 1 is reached only by pixel (un)shuffle: all convolutions run at stride 2 and more, where they are affordable;
* the last convolution writes the four pixels of a 2x2 block separately, so two neighbours can differ sharply.
"""

import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from torch import Tensor, nn

from .config import AutoencoderConfig


class VectorQuantizer(nn.Module):
    """Replace every latent vector by its nearest entry of a learned codebook.

    Paper: Sec. IV-C, "a quantization layer"; van den Oord et al. 2017, Eq. 3 and appendix A.1 (moving averages).

    The codebook gets no gradient. Every code is the moving average of the vectors that chose it: ``total / count``,
    both decayed alike, so a code that nobody chooses stays where it is. A code idle for ``restart_after`` training
    steps is moved onto a vector of the current batch; all codes count as idle before the first step, so the first
    batch is also the initialisation. That choice draws from torch's global generator: seed it with
    ``torch.manual_seed``.

    Attributes:
        codebook: (K, C) the codes.
        count: (K,) moving average of how many vectors chose each code.
        total: (K, C) moving average of the sum of those vectors.
        idle: (K,) training steps since each code was last chosen or restarted.
    """

    def __init__(self, codes: int, channels: int, beta: float = 0.25, decay: float = 0.99, restart_after: int = 200):
        super().__init__()
        if codes < 1 or channels < 1 or beta < 0 or not 0 <= decay < 1 or restart_after < 1:
            raise ValueError(
                "expected codes >= 1, channels >= 1, beta >= 0, 0 <= decay < 1, restart_after >= 1; "
                f"got {codes}, {channels}, {beta}, {decay}, {restart_after}"
            )
        self.beta, self.decay, self.restart_after = beta, decay, restart_after
        self.register_buffer("codebook", torch.randn(codes, channels))
        self.register_buffer("count", torch.zeros(codes))
        self.register_buffer("total", torch.zeros(codes, channels))
        self.register_buffer("idle", torch.full((codes,), restart_after))

    @property
    def usage(self) -> float:
        """Return perplexity / K in (0, 1]: 1 when all codes are equally frequent, 1/K when one takes everything."""
        p = self.count / self.count.sum().clamp_min(1e-12)
        return float(torch.exp(-(p * p.clamp_min(1e-12).log()).sum()) / len(p))

    def nearest(self, vectors: Tensor) -> Tensor:
        """Return the index of the nearest code, by a k-d tree: exact, and far cheaper than all pairs.

        Args:
            vectors: (N, C) float.

        Returns:
            (N,) int64 in [0, K).
        """
        if vectors.is_meta:  # only shapes are asked for, to count operations
            return torch.empty(len(vectors), dtype=torch.long, device="meta")
        tree = cKDTree(self.codebook.cpu().numpy())
        return torch.from_numpy(tree.query(vectors.detach().cpu().numpy())[1]).to(vectors.device)

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Quantise ``z``; in training mode also move the codebook.

        The gradient passes straight through: ``d z_q / d z`` is the identity. The loss is ``beta * |z - sg(e)|^2``,
        ``sg`` stopping the gradient: it ties the *encoder* to the codes, and beta belongs to this term. (An early
        public VQ-GAN put beta on ``|sg(z) - e|^2`` instead; with a moving-average codebook that would train nothing
        at all.)

        Args:
            z: (B, C, h, w) continuous latents.

        Returns:
            z_q (B, C, h, w), the loss (scalar), the indices (B, h, w) int64.

        Raises:
            ValueError: when ``z`` is not (B, C, h, w) with the codebook's C.
        """
        channels = self.codebook.shape[1]
        if z.ndim != 4 or z.shape[1] != channels:
            raise ValueError(f"expected latents (B, {channels}, h, w), got {tuple(z.shape)}")
        flat = z.permute(0, 2, 3, 1).reshape(-1, channels)  # (B, C, h, w) -> (N, C)
        with torch.no_grad():
            index = self.nearest(flat)
        shape = (z.shape[0], *z.shape[2:])
        codes = self.codebook[index].view(*shape, channels).permute(0, 3, 1, 2)  # (N, C) -> (B, C, h, w)
        loss = self.beta * F.mse_loss(z, codes)  # codes is a buffer: this side of the loss reaches the encoder only
        if self.training:
            self.follow(flat.detach(), index)
        return z + (codes - z).detach(), loss, index.view(shape)

    @torch.no_grad()
    def follow(self, flat: Tensor, index: Tensor) -> None:
        """Move every code towards the vectors that chose it: one step of both moving averages.

        Args:
            flat: (N, C) vectors.
            index: (N,) which code each of them chose.
        """
        flat = flat.to(self.total.dtype)
        hits = torch.bincount(index, minlength=len(self.count))
        sums = torch.zeros_like(self.total).index_add_(0, index, flat)
        self.count.lerp_(hits.to(self.count.dtype), 1 - self.decay)
        self.total.lerp_(sums, 1 - self.decay)
        chosen = hits > 0
        self.codebook[chosen] = self.total[chosen] / self.count[chosen, None]

        self.idle += 1
        self.idle[chosen] = 0
        dead = (self.idle >= self.restart_after).nonzero().squeeze(1)
        if len(dead):
            fresh = flat[torch.randint(len(flat), (len(dead),)).to(flat.device)]
            self.codebook[dead] = fresh
            self.count[dead] = 1 - self.decay  # as if chosen once in this step, so that it moves freely
            self.total[dead] = fresh * (1 - self.decay)
            self.idle[dead] = 0


class ResidualBlock(nn.Module):
    """Add two 3x3 convolutions to the input; starts as the identity (last layer zero)."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.conv2.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, C, h, w) for (B, C, h, w)."""
        return x + self.conv2(F.silu(self.conv1(F.silu(x))))


class VQAutoencoder(nn.Module):
    """Encode normalised depth into latents of 1 / :attr:`factor` its size, and decode them.

    Paper: Sec. IV-C "Latent Space" and Fig. 6; the paper states neither widths nor blocks. ``paper`` takes latent
    diffusion's sizes (width 128, times 2 and 4 at strides 2 and 4, two blocks a level), ``lite`` fits them to a CPU.
    Erratum: "L = Enc(D_in)" cannot be what the diffusion learns to make; its target is Enc(ground truth).

    ``config.multipliers`` has one entry a level: two of them, strides 2 and 4, are the paper's factor of 4. The other
    parts of the system are built for 4; one or three levels are for comparing autoencoders.

    Latents leave ``encode`` and enter ``decode`` standardised, ``(z - latent_shift) * latent_scale``, with buffers that
    :meth:`calibrate` sets after training: diffusion assumes unit variance.
    """

    def __init__(self, config: AutoencoderConfig):
        super().__init__()
        if not config.multipliers:
            raise ValueError(f"expected multipliers for strides 2, 4, ..., at least one; got {config.multipliers}")
        latent = config.latent_channels
        widths = [config.width * m for m in config.multipliers]
        self.config = config
        encoder = [nn.PixelUnshuffle(2), nn.Conv2d(4, widths[0], 3, padding=1)]  # (B, 1, H, W) -> (B, c, H/2, W/2)
        for i, width in enumerate(widths):
            if i:  # -> half the size
                encoder.append(nn.Conv2d(widths[i - 1], width, 3, stride=2, padding=1))
            encoder += (ResidualBlock(width) for _ in range(config.res_blocks))
        self.encoder = nn.Sequential(*encoder, nn.SiLU(), nn.Conv2d(widths[-1], latent, 3, padding=1))
        self.quantizer = VectorQuantizer(config.codes, latent, config.commitment)
        decoder = [nn.Conv2d(latent, widths[-1], 3, padding=1)]
        decoder += (ResidualBlock(widths[-1]) for _ in range(config.res_blocks + 1))  # rebuilding is the harder half
        for wide, width in zip(widths[:0:-1], widths[-2::-1], strict=True):
            decoder += [nn.Upsample(scale_factor=2), nn.Conv2d(wide, width, 3, padding=1)]  # -> twice the size
            decoder += (ResidualBlock(width) for _ in range(config.res_blocks))
        decoder += [nn.SiLU(), nn.Conv2d(widths[0], 4, 3, padding=1), nn.PixelShuffle(2)]  # -> (B, 1, H, W)
        self.decoder = nn.Sequential(*decoder)
        self.register_buffer("latent_shift", torch.zeros(1, latent, 1, 1))
        self.register_buffer("latent_scale", torch.ones(1, latent, 1, 1))

    @property
    def factor(self) -> int:
        """Return f, how many times smaller than depth the latents are along each side: 2 to the number of levels."""
        return 2 ** len(self.config.multipliers)

    def encode(self, x: Tensor) -> Tensor:
        """Return continuous, standardised latents (B, C, H/f, W/f) of normalised depth ``x`` (B, 1, H, W).

        Raises:
            ValueError: unless ``x`` is (B, 1, H, W) with H and W multiples of f.
        """
        f = self.factor
        if x.ndim != 4 or x.shape[1] != 1 or x.shape[2] % f or x.shape[3] % f:
            raise ValueError(f"expected depth (B, 1, H, W), H, W multiples of {f}, got {tuple(x.shape)}; pad it first")
        return (self.encoder(x) - self.latent_shift) * self.latent_scale

    def decode(self, latents: Tensor, quantize: bool = True) -> Tensor:
        """Return normalised depth (B, 1, H, W) of ``latents`` (B, C, H/f, W/f), quantised first by default."""
        self._check(latents)
        z = latents / self.latent_scale + self.latent_shift
        return self.decoder(self.quantizer(z)[0] if quantize else z).to(z.dtype)  # float32 also where bfloat16 computes

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        """Encode, quantise and decode.

        Args:
            x: (B, 1, H, W) normalised depth.

        Returns:
            ``reconstruction`` (B, 1, H, W), ``latents`` (B, C, H/f, W/f) before quantisation, ``commitment`` (scalar,
            beta included), ``indices`` (B, H/f, W/f) int64.
        """
        latents = self.encode(x)
        z_q, commitment, indices = self.quantizer(latents / self.latent_scale + self.latent_shift)
        return {
            "reconstruction": self.decoder(z_q),
            "latents": latents,
            "commitment": commitment,
            "indices": indices,
        }

    @torch.no_grad()
    def calibrate(self, latents: Tensor) -> None:
        """Set the buffers so that ``latents``, as ``encode`` gives them now, get mean 0 and deviation 1 per channel."""
        self._check(latents)
        z = latents / self.latent_scale + self.latent_shift
        self.latent_shift.copy_(z.mean(dim=(0, 2, 3), keepdim=True))
        self.latent_scale.copy_(1 / z.std(dim=(0, 2, 3), keepdim=True).clamp_min(1e-6))

    def _check(self, latents: Tensor) -> None:
        channels = self.config.latent_channels
        if latents.ndim != 4 or latents.shape[1] != channels:
            raise ValueError(f"expected latents (B, {channels}, h, w), got {tuple(latents.shape)}")
