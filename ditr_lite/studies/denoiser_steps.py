"""Training steps of variants of the optical denoiser: other losses, a second output, a teacher.

All begin like the branch's own step (``recipes.score_branch``; Paper: Eq. 8) and change one thing. Errors of depth are
those of log depth, ``Batch.relative_error``: their difference between neighbours is the error of its gradient.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from .. import diffusion
from ..conditioning import CHANNELS, fill
from ..config import Config
from ..schedule import NoiseSchedule, make_schedule
from ..stage_two import Painter, cl, denoise, encode_picture
from ..training import recipes
from ..training.batches import Batch
from ..training.loop import Losses, Share
from ..training.losses import depth_steps, orientation_loss
from ..unet import STRIDE, DenoisingUNet, Maps

EDGE_WEIGHT, EDGE_STEP = 4.0, 0.05  # extra weight of a pixel at a full edge, and its height, as for the autoencoder
ORIENTED = 0.1  # weight of the loss of the second output
TEACHER_STEPS, TEACHER_SAMPLES = 2, 4  # with which a teacher is asked; the mean of the samples is learnt


@dataclass(frozen=True)
class Question:
    """A noised batch and what a denoiser is given of it.

    Attributes:
        batch: of views.
        where: (B, 1, H, W) 0/1, what must be painted and whose truth is known.
        mask: (B, 1, h, w) weight of each latent cell.
        image: (B, 9, H, W), the conditioning image.
        masked: (B, C, h, w) encoded known depth.
        known: (B, 1, h, w) share of known pixels in each cell.
        x0: (B, C, h, w) encoded truth.
        eps: like x0, the noise.
        t: (B,) steps.
        x_t: like x0, the noised truth.
    """

    batch: Batch
    where: Tensor
    mask: Tensor
    image: Tensor
    masked: Tensor
    known: Tensor
    x0: Tensor
    eps: Tensor
    t: Tensor
    x_t: Tensor

    def shown_to(self, painter: Painter) -> tuple[Maps, Tensor, Tensor]:
        """Return what a denoiser is given besides noised latents and their step; F(x) is its own."""
        return encode_picture(painter, self.image, self.batch.rgb), self.masked, self.known


def ask(painter: Painter, config: Config, drawn: tuple[Batch, bool], share: Share) -> Question:
    """Noise the encoded truth of a batch (Paper: Eq. 7)."""
    batch, evidence = drawn
    schedule = make_schedule(config.schedule)
    (image, filled, known), paint = recipes.branch_inputs("optical", batch, config, evidence=evidence)
    where = paint * batch.gt_known
    with torch.no_grad():
        masked = painter.autoencoder.encode(cl(filled))
        x0 = painter.autoencoder.encode(cl(fill(batch.gt_n, batch.gt_known)))
    t, eps = recipes.noise_of(x0, schedule.timesteps, share)
    x_t = diffusion.q_sample(x0, t, eps, schedule)
    mask = F.avg_pool2d(where, STRIDE) + 0.05
    return Question(batch, where, mask, image, masked, known, x0, eps, t, x_t)


# --- the loss looks at decoded depth, too -----------------------------------------------------------------------------


def depth_error(decoded: Tensor, batch: Batch, where: Tensor) -> Tensor:
    """Return the mean relative error of decoded depth (B, 1, H, W) where ``where`` is 1."""
    error = batch.relative_error(decoded).abs()
    return (error * where).sum() / where.sum().clamp(min=1)


def edge_error(decoded: Tensor, batch: Batch, where: Tensor) -> Tensor:
    """Return the same, but pixels at depth edges count more, as they do for the autoencoder."""
    steps = depth_steps(batch.gt_n, batch.gt_known.bool())
    return depth_error(decoded, batch, where * (1 + EDGE_WEIGHT * (steps / EDGE_STEP).clamp(max=1)))


def gradient_error(decoded: Tensor, batch: Batch, where: Tensor) -> Tensor:
    """Return the mean error of the gradient of log depth, between neighbours that both are where ``where`` is 1."""
    error = batch.relative_error(decoded)
    total, pairs = error.new_zeros(()), error.new_zeros(())
    for dim in (2, 3):
        size = where.shape[dim] - 1
        both = where.narrow(dim, 0, size) * where.narrow(dim, 1, size)
        total = total + (error.diff(dim=dim).abs() * both).sum()
        pairs = pairs + both.sum()
    return total / pairs.clamp(min=1)


# name -> error of decoded depth, and its weight beside the latent loss
DECODED = {"depth": (depth_error, 5.0), "edges": (edge_error, 5.0), "gradients": (gradient_error, 20.0)}


def score_decoded(
    painter: Painter, config: Config, kind: str, drawn: tuple[Batch, bool], step: int, share: Share
) -> Losses:
    """Score a denoiser by its latents and by the depth that they decode to; ``kind`` is one of :data:`DECODED`."""
    q = ask(painter, config, drawn, share)
    schedule, prediction = make_schedule(config.schedule), config.sampler.prediction
    out = painter.net(q.x_t, q.t, *q.shown_to(painter))
    latent = diffusion.loss(out, q.x0, q.eps, q.t, schedule, prediction, mask=q.mask)
    decoded = painter.autoencoder.decode(diffusion.to_x0(out, q.x_t, q.t, schedule, prediction), quantize=False)
    measure, weight = DECODED[kind]
    error = measure(decoded, q.batch, q.where)
    return {"total": latent + weight * error, "latent": latent, kind: error}


# --- a second output: the orientation of surfaces ---------------------------------------------------------------------


class OrientedUNet(DenoisingUNet):
    """A denoiser that also says how surfaces are turned and where they end, at the size of the picture.

    Orientation is the gradient of log depth on the image (see ``peers.gradient_solve``). Called as usual, it is the
    denoiser alone.
    """

    def __init__(self, config: Config):
        super().__init__(config.unet, config.autoencoder.latent_channels, len(CHANNELS))
        self.orientation = torch.nn.Conv2d(config.unet.width, 3 * STRIDE**2, 3, padding=1)

    def both(self, *given: Tensor | Maps) -> tuple[Tensor, Tensor]:
        """Return what the denoiser does, and (B, 3, H, W): gradients to the right and down, and an edge's logit."""
        last = []
        handle = self.norm.register_forward_hook(lambda module, inputs, out: last.append(out))
        try:
            latents = self(*given)
        finally:
            handle.remove()
        return latents, F.pixel_shuffle(self.orientation(F.silu(last[0])), STRIDE)


def score_oriented(painter: Painter, config: Config, drawn: tuple[Batch, bool], step: int, share: Share) -> Losses:
    """Score both outputs of an :class:`OrientedUNet`."""
    q = ask(painter, config, drawn, share)
    latents, orientation = painter.net.both(q.x_t, q.t, *q.shown_to(painter))
    schedule, prediction = make_schedule(config.schedule), config.sampler.prediction
    latent = diffusion.loss(latents, q.x0, q.eps, q.t, schedule, prediction, mask=q.mask)
    oriented = orientation_loss(orientation, q.batch, q.where)["total"]
    return {"total": latent + ORIENTED * oriented, "latent": latent, "orientation": oriented}


# --- many steps and samples in one: a teacher -------------------------------------------------------------------------


def score_student(
    painter: Painter, config: Config, teacher: Painter, drawn: tuple[Batch, bool], step: int, share: Share
) -> Losses:
    """Score one step from pure noise by the mean of several samples of several steps of a trained denoiser."""
    q = ask(painter, config, drawn, share)
    schedule, prediction = make_schedule(config.schedule), config.sampler.prediction
    target = taught(teacher, q, schedule, prediction)
    t = torch.full_like(q.t, schedule.timesteps - 1)
    out = painter.net(q.eps, t, *q.shown_to(painter))
    x0 = diffusion.to_x0(out, q.eps, t, schedule, prediction)
    return {"total": diffusion.loss(x0, target, q.eps, t, schedule, "x0", mask=q.mask)}


@torch.no_grad()
def taught(teacher: Painter, q: Question, schedule: NoiseSchedule, prediction: str) -> Tensor:
    """Return the mean (B, C, h, w) of what a teacher draws; the noise is from torch's generator."""
    features, masked, known = q.shown_to(teacher)
    asked = schedule, TEACHER_STEPS, TEACHER_SAMPLES, prediction, None
    drawn = denoise(teacher.net, masked, known, features, *asked)
    return drawn.unflatten(0, (TEACHER_SAMPLES, -1)).mean(dim=0)
