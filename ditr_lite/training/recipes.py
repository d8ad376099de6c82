"""How each network is trained: what a step sees and what it is scored by.

Paper: Sec. V-B. The lite recipes depart from it (AdamW, one cosine decay, minutes instead of days); the card of the
weights names the command, the steps and the data they were made with.

A step has two halves (``loop.Step``): ``draw_*`` takes pictures and NumPy's random numbers, on the CPU and maybe in a
worker; ``score_*`` runs the networks. What a share of a batch draws is its part of what the whole batch draws.
"""

from functools import partial

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .. import diffusion
from ..autoencoder import VQAutoencoder
from ..boundary import Backend
from ..conditioning import condition, fill
from ..config import Config, SamplerConfig
from ..detail import detail_input
from ..region import ColourEncoder
from ..schedule import NoiseSchedule, eq8_weight, make_schedule
from ..stage_two import Painter, cl, encode_picture
from .batches import Batch, draw_frames, draw_windows, epoch_frames
from .loop import WHOLE, Losses, Recipe, Share, Step
from .losses import autoencoder_loss, region_loss
from .scenes import Pool

CLASS_WEIGHTS = (0.4, 1.0, 1.0)  # background, transparent, reflective
FROZEN_STAGES = 2  # of the pretrained encoder, in stage one: what edges look like is known, and these cost most
STILL, STILL_SHARE = 0.5, 0.7  # last part of stage one's training, and the share of its batches, in which frames stay
MIXED_SHARE = 0.4  # of stage one's frames, before that, in which two scenes are mixed: scenes are few
CROP = 64  # pixels a side that the autoencoder sees: it is convolutional
LAST_STEP_SHARE = 0.5  # of a batch is noised fully: one-step sampling begins, and ends, there

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


def region_step(model: nn.Module, pool: Pool, config: Config, recipe: Recipe, seed: int = 0) -> Step:
    """Stage one (Paper: Sec. IV-B; three classes, deep supervision and a loss of its boundary are ours).

    Variety first, then frames as they will be met: in the last :data:`STILL` of the steps most frames are not moved. A
    recipe in epochs, the paper's, shows every frame once an epoch instead, where all frames are to be seen alike often.
    """
    freeze_early(model)
    draw = partial(draw_region, pool, config, recipe, seed)
    if recipe.law == "falling" and pool.even:
        draw = partial(epoch_frames, pool, config.look(), recipe.batch, seed, None)
    return Step(draw, partial(score_region, model))


def draw_region(pool: Pool, config: Config, recipe: Recipe, seed: int, step: int, share: Share) -> Batch:
    """Draw whole frames for stage one."""
    rng = rng_of(seed, step)
    still = step >= (1 - STILL) * recipe.steps and rng.random() < STILL_SHARE
    mixed = 0.0 if still else MIXED_SHARE
    return draw_frames(pool, recipe.batch, config.look(), rng, still=still, mixed=mixed, share=share)


def score_region(model: nn.Module, batch: Batch, step: int, share: Share) -> Losses:
    """Score what stage one says of frames."""
    weight = batch.rgb.new_tensor(CLASS_WEIGHTS)
    return region_loss(model(cl(batch.rgb), batch.depth_n, batch.valid), batch.material, weight)


def freeze_early(model: nn.Module) -> None:
    """Keep the first stages of a pretrained encoder in stage one as they are; do nothing where there is none."""
    encoder = getattr(model.encoder_rgb, "encoder", None)
    if isinstance(encoder, ColourEncoder):
        for part in (encoder.stem, *encoder.stages[:FROZEN_STAGES]):
            part.requires_grad_(False)


def autoencoder_step(
    model: VQAutoencoder, pool: Pool, config: Config, recipe: Recipe, seed: int = 0, crop: int = CROP
) -> Step:
    """Autoencoder (Paper: Sec. IV-C; its loss is ours): true depth in random crops of windows and frames."""
    draw = partial(draw_crops, pool, config, recipe, seed, crop, model.factor)
    return Step(draw, partial(score_autoencoder, model))


def draw_crops(
    pool: Pool, config: Config, recipe: Recipe, seed: int, crop: int, factor: int, step: int, share: Share
) -> tuple[Tensor, Tensor]:
    """Draw crops of the truth and where it is known, (B, 1, crop, crop) each."""
    rng = rng_of(seed, step)
    batches = [branch_batch("optical", pool, config, recipe.batch - recipe.batch // 3, rng)]
    if recipe.batch >= 3:
        batches.append(branch_batch("geometric", pool, config, recipe.batch // 3, rng))
    crops = []
    for batch in batches:
        for gt, known in zip(fill(batch.gt_n, batch.gt_known), batch.gt_known, strict=True):
            side = min(crop, *gt.shape[1:])
            height, width = gt.shape[1:]
            y = factor * int(rng.integers(0, (height - side) // factor + 1))
            x = factor * int(rng.integers(0, (width - side) // factor + 1))
            crops.append((gt[:, y : y + side, x : x + side], known[:, y : y + side, x : x + side]))
    gt, known = (torch.stack(parts) for parts in zip(*share.take(crops), strict=True))
    return gt, known


def score_autoencoder(model: VQAutoencoder, crops: tuple[Tensor, Tensor], step: int, share: Share) -> Losses:
    """Score the reconstruction of crops."""
    gt, known = crops
    return autoencoder_loss(gt, model(cl(gt)), known)


def branch_batch(
    branch: str,
    pool: Pool,
    config: Config,
    count: int,
    rng: np.random.Generator,
    backend: Backend | None = None,
    share: Share = WHOLE,
) -> Batch:
    """Draw what a branch trains on: windows for the optical one, whole frames for the geometric one."""
    if branch == "optical" and config.window:
        return draw_windows(pool, count, config.window, rng, backend, share)
    return draw_frames(pool, count, config.size, rng, backend, share=share)


def branch_inputs(
    branch: str, batch: Batch, config: Config, evidence: bool = True
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Return what a branch is given (see ``condition``) and where it must paint, (B, 1, H, W) 0/1."""
    shown = evidence and config.evidence and branch == "optical"
    guide, paint = guide_and_paint(branch, batch)
    return condition(batch.rgb, batch.depth_n, batch.valid, batch.region, guide, shown), paint


def guide_and_paint(branch: str, batch: Batch) -> tuple[Tensor, Tensor]:
    """Return the boundary map that guides a branch and where it must paint, (B, 1, H, W) 0/1 each."""
    if branch == "optical":
        return batch.guide_da, batch.region
    return batch.guide_rgb, (1 - batch.region) * (1 - batch.valid)


def branch_step(
    branch: str, painter: Painter, pool: Pool, config: Config, recipe: Recipe, backend: Backend, seed: int = 0
) -> Step:
    """Denoiser of one branch: by ``sampler.objective`` Eq. 8, or that with cells to be painted counting most.

    The target is Enc(ground truth). The paper's ``L = Enc(D_in)`` cannot be: it would teach the raw depth. In-region
    evidence is withheld from some batches, so that the branch learns to do without.
    """
    draw = partial(draw_branch, branch, pool, config, recipe, backend, seed)
    score = partial(score_branch, branch, painter, config, make_schedule(config.schedule))
    return Step(draw, score, frozen_of(painter))


def frozen_of(*painters: Painter) -> tuple[nn.Module, ...]:
    """Return the networks of painters that their denoisers build on."""
    return tuple(net for p in painters for net in (p.autoencoder, p.encoder) if net is not None)


def draw_branch(
    branch: str, pool: Pool, config: Config, recipe: Recipe, backend: Backend, seed: int, step: int, share: Share
) -> tuple[Batch, bool]:
    """Draw a batch for a branch, and whether it may see the readings inside the region."""
    rng = rng_of(seed, step)
    batch = branch_batch(branch, pool, config, recipe.batch, rng, backend, share)
    return batch, bool(rng.random() > 0.15)


def score_branch(
    branch: str,
    painter: Painter,
    config: Config,
    schedule: NoiseSchedule,
    drawn: tuple[Batch, bool],
    step: int,
    share: Share,
) -> Losses:
    """Score what a branch makes of a batch."""
    batch, evidence = drawn
    given, paint = branch_inputs(branch, batch, config, evidence=evidence)
    mask = F.avg_pool2d(paint * batch.gt_known, 4) + 0.05
    if config.sampler.objective == "eq8":  # every cell alike, but for those of unknown truth
        mask = F.avg_pool2d(batch.gt_known, 4)
    return {"total": denoising_loss(painter, batch, given, mask, schedule, config.sampler, share)}


def denoising_loss(
    painter: Painter,
    batch: Batch,
    given: tuple[Tensor, Tensor, Tensor],
    mask: Tensor,
    schedule: NoiseSchedule,
    sampler: SamplerConfig,
    share: Share = WHOLE,
) -> Tensor:
    """Noise the encoded truth of a batch and score what the denoiser makes of it (Paper: Eq. 8).

    Args:
        painter: whose denoiser is trained; its autoencoder is frozen.
        batch: of views.
        given: what the denoiser is given, from ``condition``.
        mask: (B, 1, h, w) weight of each latent cell.
        schedule: of the noise.
        sampler: what the denoiser predicts, and what it is trained for: by "eq8" all steps are drawn alike and the
            distance is that of the noise; otherwise :data:`LAST_STEP_SHARE` of them is the last, and the distance is
            that of the prediction.
        share: of the whole batch that these views are.
    """
    image, filled, known = given
    with torch.no_grad():
        masked = painter.autoencoder.encode(cl(filled))
        x0 = painter.autoencoder.encode(cl(fill(batch.gt_n, batch.gt_known))).float()  # also where bfloat16 computes
    eq8 = sampler.objective == "eq8"
    t, eps = noise_of(x0, schedule.timesteps, share, 0.0 if eq8 else LAST_STEP_SHARE)
    x_t = diffusion.q_sample(x0, t, eps, schedule)
    out = painter.net(x_t, t, encode_picture(painter, image, batch.rgb), masked, known)
    weight = eq8_weight(schedule, sampler.prediction) if eq8 else None
    return diffusion.loss(out.float(), x0, eps, t, schedule, sampler.prediction, weight, mask)


def noise_of(x0: Tensor, timesteps: int, share: Share = WHOLE, last: float = LAST_STEP_SHARE) -> tuple[Tensor, Tensor]:
    """Draw a share's steps t (B,) and noise like ``x0``, (B, C, h, w), out of those of the whole batch.

    Of the steps the share ``last`` is T - 1; all others are drawn alike. Steps and noise come from torch's generator of
    the CPU, so that a seed means the same on every device.
    """
    whole = torch.cat([x0] * share.of) if share.of > 1 else x0
    t = torch.randint(0, timesteps, (len(whole),))
    t[: int(last * len(whole))] = timesteps - 1
    eps = torch.randn_like(whole, device="cpu")
    return share.take(t).to(x0.device), share.take(eps).to(x0.device)


@torch.no_grad()
def one_step(
    branch: str, painter: Painter, batch: Batch, config: Config, seed: int = 0, share: Share = WHOLE
) -> tuple[Tensor, Tensor]:
    """Let one denoising step from pure noise paint a batch.

    Returns:
        normalised depth (B, 1, H, W), before the finer final step, and where it had to be painted, 0/1.
    """
    schedule = make_schedule(config.schedule)
    (image, filled, known), paint = branch_inputs(branch, batch, config)
    masked = painter.autoencoder.encode(cl(filled))
    shape = (share.of * len(masked), *masked.shape[1:])
    noise = share.take(torch.randn(shape, generator=torch.Generator().manual_seed(seed))).to(masked.device)
    t = torch.full((len(noise),), schedule.timesteps - 1, device=masked.device)
    out = painter.net(noise, t, encode_picture(painter, image, batch.rgb), masked, known)
    return painter.autoencoder.decode(diffusion.to_x0(out, noise, t, schedule, config.sampler.prediction)), paint


def sharpened(model: nn.Module, decoded: Tensor, batch: Batch, config: Config) -> Tensor:
    """Return what the finer final step makes of decoded depth (B, 1, H, W)."""
    valid = batch.valid if config.evidence else batch.valid * (1 - batch.region)
    x = detail_input(decoded, batch.depth_n, valid, batch.region, batch.rgb, batch.guide_rgb)
    return model(cl(x))


def detail_step(
    model: nn.Module,
    painters: dict[str, Painter],
    pool: Pool,
    config: Config,
    recipe: Recipe,
    backend: Backend,
    seed: int = 0,
) -> Step:
    """Finer final step: what each frozen branch paints, in turn; relative error, L1 and RMS of a view together."""
    draw = partial(draw_in_turn, tuple(painters), pool, config, recipe, backend, seed)
    frozen = (*frozen_of(*painters.values()), *(p.net for p in painters.values()))
    return Step(draw, partial(score_detail, model, painters, config), frozen)


def draw_in_turn(
    branches: tuple[str, ...],
    pool: Pool,
    config: Config,
    recipe: Recipe,
    backend: Backend,
    seed: int,
    step: int,
    share: Share,
) -> tuple[str, Batch]:
    """Return the branch whose turn it is and a batch for it."""
    branch = branches[step % len(branches)]
    return branch, branch_batch(branch, pool, config, recipe.batch, rng_of(seed, step), backend, share)


def score_detail(
    model: nn.Module,
    painters: dict[str, Painter],
    config: Config,
    drawn: tuple[str, Batch],
    step: int,
    share: Share,
) -> Losses:
    """Score the finer final step on what a branch paints."""
    branch, batch = drawn
    decoded, paint = one_step(branch, painters[branch], batch, config, seed=step, share=share)
    error = batch.relative_error(sharpened(model, decoded, batch, config))
    weight = paint * batch.gt_known
    count = weight.sum(dim=(1, 2, 3))
    some = (count > 0).float()
    views = some.sum().clamp(min=1)
    l1 = ((error.abs() * weight).sum(dim=(1, 2, 3)) / count.clamp(min=1) * some).sum() / views
    mean_square = (error.square() * weight).sum(dim=(1, 2, 3)) / count.clamp(min=1)
    rms = ((mean_square + 1e-8).sqrt() * some).sum() / views
    return {"total": 10 * (l1 + rms), "l1": l1, "rms": rms}
