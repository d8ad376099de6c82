"""Stage two, once: condition, encode, denoise, decode, sharpen. Everything that paints depth calls :func:`paint`.

Paper: Sec. IV-C and Fig. 5 to 8. A *view* is a picture at network size: the whole frame for the geometric branch, a
window around each blob of the region for the optical one. All tensors are float32, B views at a time.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor, nn

from . import diffusion
from .boundary import M_DA, M_RGB
from .conditioning import condition
from .detail import detail_input
from .schedule import NoiseSchedule
from .windows import RIM

BRANCHES = ("optical", "geometric")
GROUP = 4  # samples that are drawn at a time: more take longer, but no more memory
Sampler = Callable[..., Tensor]


@dataclass(frozen=True)
class Plan:
    """Who paints what, guided by which map; every field can be exchanged to ask what it is good for.

    Attributes:
        painters: which branch's networks paint the region, and which the holes.
        guides: which boundary map guides the painting of the region, and of the holes (S8); None is an empty map.
        evidence: whether readings inside the region are shown, to the optical branch and to the final step, where the
            configuration allows it.
        detail: whether the finer final step is taken where there is one.
        rim: pixels by which windows show the region wider than it is.
    """

    painters: tuple[str, str] = BRANCHES
    guides: tuple[int | None, int | None] = (M_DA, M_RGB)
    evidence: bool = True
    detail: bool = True
    rim: int = RIM


@dataclass(frozen=True)
class Views:
    """What one branch is given of B views.

    Attributes:
        rgb: (B, 3, H, W) in [-1, 1].
        depth_n: (B, 1, H, W) normalised raw depth, anything where not valid.
        valid: (B, 1, H, W) 0/1, where a reading is.
        region: (B, 1, H, W) 0/1, what the optical branch paints.
        guide: (B, 1, H, W) 0/1, the boundary map that guides the branch (S8).
        boundary: (B, 1, H, W) 0/1, M_RGB, which the final step sees.
    """

    rgb: Tensor
    depth_n: Tensor
    valid: Tensor
    region: Tensor
    guide: Tensor
    boundary: Tensor

    def without_evidence(self) -> "Views":
        """Return the same views without the readings inside their regions, which the final step would see, too."""
        return replace(self, valid=self.valid * (1 - self.region))


@dataclass(frozen=True)
class Painter:
    """The networks of one branch.

    Attributes:
        net: the denoiser, a ``unet.DenoisingUNet``.
        autoencoder: a ``autoencoder.VQAutoencoder``.
        encoder: pretrained, a ``region.ColourEncoder``; None where the denoiser takes no colour features.
        detail: the finer final step, a ``detail.DetailNet``; None leaves it out (the paper).
        evidence: whether the denoiser is shown the readings inside the region.
    """

    net: nn.Module
    autoencoder: nn.Module
    encoder: nn.Module | None
    detail: nn.Module | None
    evidence: bool


def paint(
    painter: Painter,
    views: Views,
    schedule: NoiseSchedule,
    steps: int = 1,
    samples: int = 1,
    prediction: str = "x0",
    generator: torch.Generator | None = None,
    sampler: Sampler = diffusion.sample,
) -> Tensor:
    """Let one branch paint B views.

    Args:
        painter: its networks.
        views: what it is given.
        schedule: of the noise.
        steps: denoising steps.
        samples: draws from the noise.
        prediction: what the denoiser predicts.
        generator: of the noise.
        sampler: called like :func:`diffusion.sample`.

    Returns:
        (samples, B, 1, H, W) normalised depth.
    """
    # 1. Condition: the mask is multiplied with the depth (Sec. IV-A)
    image, filled, known = condition(
        views.rgb, views.depth_n, views.valid, views.region, views.guide, painter.evidence
    )  # (B, 9, H, W), (B, 1, H, W), (B, 1, H/4, W/4)
    # 2. Encode what is known: L = Enc(D_in) (I3), and the picture: F(x) (Sec. IV-C, "Feature Extractor")
    masked = painter.autoencoder.encode(cl(filled))  # (B, C, H/4, W/4)
    features = encode_picture(painter, image, views.rgb)
    # 3. Denoise from L_T ~ N(0, I) (Eq. 7) with the network of Eq. 8
    latents = denoise(painter.net, masked, known, features, schedule, steps, samples, prediction, generator, sampler)
    # 4. Decode: D_out = Dec(L) (I3)
    groups = latents.split(GROUP * len(views.rgb))
    decoded = torch.cat([painter.autoencoder.decode(group) for group in groups])  # (S B, 1, H, W)
    # 5. Sharpen (not in the paper)
    if painter.detail is not None:
        decoded = sharpen(painter.detail, decoded, views)
    return decoded.unflatten(0, (samples, len(views.rgb)))


def encode_picture(painter: Painter, image: Tensor, rgb: Tensor) -> list[Tensor]:
    """Return F(x): the conditioning image (B, 9, H, W) and pretrained features of rgb (B, 3, H, W), level by level."""
    return painter.net.features(cl(image), colour_features(painter.encoder, rgb))


def colour_features(encoder: nn.Module | None, rgb: Tensor) -> list[Tensor]:
    """Return pretrained features of pictures (B, 3, H, W) at strides 4, 8 and 16; none without an encoder."""
    return [] if encoder is None else encoder(cl(rgb), levels=4)[1:]


def denoise(
    net: nn.Module,
    masked: Tensor,
    known: Tensor,
    features: list[Tensor],
    schedule: NoiseSchedule,
    steps: int,
    samples: int,
    prediction: str,
    generator: torch.Generator | None,
    sampler: Sampler = diffusion.sample,
) -> Tensor:
    """Return latents (samples B, C, h, w), sample by sample, of B views.

    Args:
        net: the denoiser.
        masked: (B, C, h, w) encoded known depth.
        known: (B, 1, h, w) share of known pixels in each cell.
        features: F(x).
        schedule: of the noise.
        steps: denoising steps.
        samples: draws.
        prediction: what the denoiser predicts.
        generator: of the noise.
        sampler: called like :func:`diffusion.sample`.
    """
    views = len(masked)
    noise = torch.randn((samples * views, *masked.shape[1:]), generator=generator).to(masked.device)
    drawn = []
    for start in noise.split(GROUP * views):
        group = len(start) // views
        given = [f.repeat(group, 1, 1, 1) for f in features]
        where = masked.repeat(group, 1, 1, 1), known.repeat(group, 1, 1, 1)
        predict = partial(_predict, net, given, where)
        drawn.append(sampler(predict, start.shape, schedule, steps, prediction, generator=generator, x_T=start))
    return torch.cat(drawn)


def _predict(net: nn.Module, features: list[Tensor], where: tuple[Tensor, Tensor], x: Tensor, t: Tensor) -> Tensor:
    return net(x, t, features, *where)


def sharpen(detail: nn.Module, decoded: Tensor, views: Views) -> Tensor:
    """Apply the finer final step to decoded depth (S B, 1, H, W).

    Residual, trust and affinities are predicted once for a view, from the mean of its samples.
    """
    count = len(views.rgb)
    mean = decoded.unflatten(0, (-1, count)).mean(dim=0)  # (S B, 1, H, W) -> (B, 1, H, W)
    given = detail_input(mean, views.depth_n, views.valid, views.region, views.rgb, views.boundary)
    return detail.spread(cl(given), decoded)


def cl(x: Tensor) -> Tensor:
    """Return a tensor in the memory format that convolutions are fastest in, channels last."""
    return x.contiguous(memory_format=torch.channels_last)
