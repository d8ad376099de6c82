"""How each network is trained: what a step sees and what it is scored by.

Paper: Sec. V-B. The lite recipes depart from it (AdamW, one cosine decay, minutes instead of days); the card of the
weights names the command, the steps and the data they were made with.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .. import diffusion
from ..autoencoder import VQAutoencoder, autoencoder_loss
from ..boundary import Backend
from ..conditioning import condition, fill
from ..config import Config
from ..detail import detail_input
from ..region import ColourEncoder, region_loss
from ..schedule import NoiseSchedule, make_schedule
from ..stage_two import Painter, encode_picture
from .batches import Batch, draw_frames, draw_windows
from .loop import Recipe
from .scenes import Pool

CLASS_WEIGHTS = (0.4, 1.0, 1.0)  # background, transparent, reflective
FROZEN_STAGES = 2  # of the pretrained encoder, in stage one: what edges look like is known, and these cost most
STILL, STILL_SHARE = 0.25, 0.7  # last part of stage one's training, and the share of its batches, in which frames stay
MIXED_SHARE = 0.4  # of stage one's frames, before that, in which two scenes are mixed: scenes are few
CROP = 64  # pixels a side that the autoencoder sees: it is convolutional
LAST_STEP_SHARE = 0.5  # of a batch is noised fully: one-step sampling begins, and ends, there
StepLoss = Callable[[int], dict[str, Tensor]]

RECIPES = {
    "autoencoder": Recipe(steps=2500, batch=16, lr=2e-3),
    "region": Recipe(steps=4000, batch=8, lr=1.5e-3, weight_decay=1e-2),
    "optical": Recipe(steps=4000, batch=8, lr=1e-3),
    "geometric": Recipe(steps=2500, batch=8, lr=1e-3),
    "detail": Recipe(steps=2000, batch=8, lr=2e-3),
}


def rng_of(seed: int, step: int) -> np.random.Generator:
    """Return the generator of one training step."""
    return np.random.default_rng([seed, step])


def region_step(model: nn.Module, pool: Pool, config: Config, recipe: Recipe, seed: int = 0) -> StepLoss:
    """Stage one: three classes, deep supervision, boundary loss (Paper: Sec. IV-B).

    Variety first, then frames as they will be met: in the last :data:`STILL` of the steps most frames are not moved.
    """
    weight = torch.tensor(CLASS_WEIGHTS)
    freeze_early(model)

    def step_loss(step: int) -> dict[str, Tensor]:
        rng = rng_of(seed, step)
        still = step >= (1 - STILL) * recipe.steps and rng.random() < STILL_SHARE
        mixed = 0.0 if still else MIXED_SHARE
        batch = draw_frames(pool, recipe.batch, config.size, rng, still=still, mixed=mixed)
        return region_loss(model(cl(batch.rgb), batch.depth_n, batch.valid), batch.material, weight)

    return step_loss


def freeze_early(model: nn.Module) -> None:
    """Keep the first stages of a pretrained encoder in stage one as they are; do nothing where there is none."""
    encoder = getattr(model.encoder_rgb, "encoder", None)
    if isinstance(encoder, ColourEncoder):
        for part in (encoder.stem, *encoder.stages[:FROZEN_STAGES]):
            part.requires_grad_(False)


def autoencoder_step(
    model: VQAutoencoder, pool: Pool, config: Config, recipe: Recipe, seed: int = 0, crop: int = CROP
) -> StepLoss:
    """Autoencoder: ground-truth depth, random crops of windows and frames, edges weighted (Paper: Sec. IV-C)."""
    factor = model.factor

    def step_loss(step: int) -> dict[str, Tensor]:
        rng = rng_of(seed, step)
        batches = [branch_batch("optical", pool, config, recipe.batch - recipe.batch // 3, rng)]
        if recipe.batch >= 3:
            batches.append(branch_batch("geometric", pool, config, recipe.batch // 3, rng))
        crops = []
        for batch in batches:
            for gt, known in zip(fill(batch.gt_n, batch.gt_known), batch.gt_known, strict=True):
                side = min(crop, *gt.shape[1:])
                y, x = (factor * int(rng.integers(0, (n - side) // factor + 1)) for n in gt.shape[1:])
                crops.append((gt[:, y : y + side, x : x + side], known[:, y : y + side, x : x + side]))
        gt, known = (torch.stack(parts) for parts in zip(*crops, strict=True))  # (B, 1, crop, crop) each
        return autoencoder_loss(gt, model(cl(gt)), known)

    return step_loss


def branch_batch(
    branch: str, pool: Pool, config: Config, count: int, rng: np.random.Generator, backend: Backend | None = None
) -> Batch:
    """Draw what a branch trains on: windows for the optical one, whole frames for the geometric one."""
    if branch == "optical" and config.window:
        return draw_windows(pool, count, config.window, rng, backend)
    return draw_frames(pool, count, config.size, rng, backend)


def branch_inputs(
    branch: str, batch: Batch, config: Config, evidence: bool = True
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Return what a branch is given (see ``condition``) and where it must paint, (B, 1, H, W) 0/1."""
    shown = evidence and config.evidence and branch == "optical"
    guide = batch.guide_da if branch == "optical" else batch.guide_rgb
    given = condition(batch.rgb, batch.depth_n, batch.valid, batch.region, guide, shown)
    paint = batch.region if branch == "optical" else (1 - batch.region) * (1 - batch.valid)
    return given, paint


def branch_step(
    branch: str, painter: Painter, pool: Pool, config: Config, recipe: Recipe, backend: Backend, seed: int = 0
) -> StepLoss:
    """Denoiser of one branch (Paper: Eq. 8): cells that it must paint count fully, all others a little.

    The target is Enc(ground truth). The paper's ``L = Enc(D_in)`` cannot be: it would teach the raw depth. In-region
    evidence is withheld from some batches, so that the branch learns to do without.
    """
    schedule = make_schedule(config.schedule)

    def step_loss(step: int) -> dict[str, Tensor]:
        rng = rng_of(seed, step)
        batch = branch_batch(branch, pool, config, recipe.batch, rng, backend)
        given, paint = branch_inputs(branch, batch, config, evidence=rng.random() > 0.15)
        mask = F.avg_pool2d(paint * batch.gt_known, 4) + 0.05
        return {"total": denoising_loss(painter, batch, given, mask, schedule, config.sampler.prediction)}

    return step_loss


def denoising_loss(
    painter: Painter,
    batch: Batch,
    given: tuple[Tensor, Tensor, Tensor],
    mask: Tensor,
    schedule: NoiseSchedule,
    prediction: str,
) -> Tensor:
    """Noise the encoded truth of a batch and score what the denoiser makes of it (Paper: Eq. 8).

    Args:
        painter: whose denoiser is trained; its autoencoder is frozen.
        batch: of views.
        given: what the denoiser is given, from ``condition``.
        mask: (B, 1, h, w) weight of each latent cell.
        schedule: of the noise.
        prediction: what the denoiser predicts.
    """
    image, filled, known = given
    with torch.no_grad():
        masked = painter.autoencoder.encode(cl(filled))
        x0 = painter.autoencoder.encode(cl(fill(batch.gt_n, batch.gt_known)))
    t = torch.randint(0, schedule.timesteps, (len(x0),))
    t[: int(LAST_STEP_SHARE * len(x0))] = schedule.timesteps - 1
    eps = torch.randn_like(x0)
    x_t = diffusion.q_sample(x0, t, eps, schedule)
    out = painter.net(x_t, t, encode_picture(painter, image, batch.rgb), masked, known)
    return diffusion.loss(out, x0, eps, t, schedule, prediction, mask=mask)


@torch.no_grad()
def one_step(branch: str, painter: Painter, batch: Batch, config: Config, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Let one denoising step from pure noise paint a batch.

    Returns:
        normalised depth (B, 1, H, W), before the finer final step, and where it had to be painted, 0/1.
    """
    schedule = make_schedule(config.schedule)
    (image, filled, known), paint = branch_inputs(branch, batch, config)
    masked = painter.autoencoder.encode(cl(filled))
    noise = torch.randn(masked.shape, generator=torch.Generator().manual_seed(seed))
    t = torch.full((len(noise),), schedule.timesteps - 1)
    out = painter.net(noise, t, encode_picture(painter, image, batch.rgb), masked, known)
    return painter.autoencoder.decode(diffusion.to_x0(out, noise, t, schedule, config.sampler.prediction)), paint


def sharpened(model: nn.Module, decoded: Tensor, batch: Batch) -> Tensor:
    """Return what the finer final step makes of decoded depth (B, 1, H, W)."""
    x = detail_input(decoded, batch.depth_n, batch.valid, batch.region, batch.rgb, batch.guide_rgb)
    return model(cl(x))


def detail_step(
    model: nn.Module,
    painters: dict[str, Painter],
    pool: Pool,
    config: Config,
    recipe: Recipe,
    backend: Backend,
    seed: int = 0,
) -> StepLoss:
    """Finer final step: what each frozen branch paints, in turn; relative error, L1 and RMS of a view together."""

    def step_loss(step: int) -> dict[str, Tensor]:
        branch = tuple(painters)[step % len(painters)]
        batch = branch_batch(branch, pool, config, recipe.batch, rng_of(seed, step), backend)
        decoded, paint = one_step(branch, painters[branch], batch, config, seed=step)
        error = batch.relative_error(sharpened(model, decoded, batch))
        weight = paint * batch.gt_known
        count = weight.sum(dim=(1, 2, 3))
        some = (count > 0).float()
        views = some.sum().clamp(min=1)
        l1 = ((error.abs() * weight).sum(dim=(1, 2, 3)) / count.clamp(min=1) * some).sum() / views
        mean_square = (error.square() * weight).sum(dim=(1, 2, 3)) / count.clamp(min=1)
        rms = ((mean_square + 1e-8).sqrt() * some).sum() / views
        return {"total": 10 * (l1 + rms), "l1": l1, "rms": rms}

    return step_loss


def cl(x: Tensor) -> Tensor:
    """Return a tensor in the memory format that convolutions are fastest in."""
    return x.contiguous(memory_format=torch.channels_last)
