"""How each network is trained: what a step sees and what it is scored by.

Paper: Sec. V-B. The lite recipes depart from it (AdamW, one cosine decay, minutes instead of days); the card of the
weights names the command, the steps and the data they were made with.
"""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .. import diffusion
from ..autoencoder import VQAutoencoder, autoencoder_loss
from ..conditioning import condition, fill
from ..config import Config
from ..pipeline import detail_input
from ..region import IGNORE, region_loss
from ..schedule import make_schedule
from .augment import grow, lose_patches, mistake, reframe
from .batches import Batch, Scenes, draw, draw_each
from .loop import Recipe

CLASS_WEIGHTS = (0.4, 1.0, 1.0)  # background, transparent, reflective
REFRAME_ALL, REFRAME_SHARE = 1000, 0.3  # stage one: every batch is reframed up to this step, then this share of them
StepLoss = Callable[[int], dict[str, Tensor]]

RECIPES = {
    "autoencoder": Recipe(steps=3000, batch=16, lr=2e-3),
    "region": Recipe(steps=5000, batch=8, lr=2e-3, weight_decay=1e-2),
    "optical": Recipe(steps=1700, batch=8, lr=1e-3),
    "geometric": Recipe(steps=800, batch=8, lr=1e-3),
    "detail": Recipe(steps=2400, batch=8, lr=2e-3),
}


def rng_of(seed: int, step: int) -> np.random.Generator:
    """Return the generator of one training step."""
    return np.random.default_rng([seed, step])


def region_step(model: nn.Module, scenes: Scenes, recipe: Recipe, seed: int = 0) -> StepLoss:
    """Stage one: three classes, deep supervision, boundary loss (Paper: Sec. IV-B)."""
    weight = torch.tensor(CLASS_WEIGHTS)

    def step_loss(step: int) -> dict[str, Tensor]:
        rng = rng_of(seed, step)
        batch = draw(scenes, rng.integers(0, len(scenes), recipe.batch), rng)
        readings = lose_patches(batch.depth_n, batch.valid, rng)
        rgb, maps = batch.rgb, [*readings, batch.material[:, None].float(), batch.gt_known]
        if step < REFRAME_ALL or rng.random() < REFRAME_SHARE:  # variety first, then frames as they will be met
            rgb, maps = reframe(rgb, maps, rng)
        depth_n, valid, material, known = maps
        target = torch.where(known > 0, material, IGNORE)[:, 0].long()
        return region_loss(model(_cl(rgb), depth_n, valid), target, weight)

    return step_loss


def autoencoder_step(model: VQAutoencoder, scenes: Scenes, recipe: Recipe, seed: int = 0, crop: int = 64) -> StepLoss:
    """Autoencoder: ground-truth depth, random crops (it is convolutional), edges weighted (Paper: Sec. IV-C)."""

    def step_loss(step: int) -> dict[str, Tensor]:
        rng = rng_of(seed, step)
        batch = draw(scenes, rng.integers(0, len(scenes), recipe.batch), rng, colour=False)
        y, x = (4 * int(rng.integers(0, (n - crop) // 4 + 1)) for n in batch.gt_n.shape[2:])
        gt, known = (a[..., y : y + crop, x : x + crop] for a in (fill(batch.gt_n, batch.gt_known), batch.gt_known))
        return autoencoder_loss(gt, model(_cl(gt)), known)

    return step_loss


def branch_inputs(
    branch: str, batch: Batch, config: Config, rng: np.random.Generator | None = None, region: Tensor | None = None
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Return what a branch is given (see ``condition``) and where it must paint, (B, 1, H, W) 0/1.

    With ``rng`` the region is the true one grown or shrunk at random, as stage one and its refinement would, and
    in-region evidence is withheld from one batch in five so that the branch learns to do without.
    """
    if region is None:
        region = (batch.material > 0)[:, None].float()
        if rng is not None:
            region = grow(region, int(rng.integers(-1, 5)))
    evidence = config.evidence and branch == "optical" and (rng is None or rng.random() > 0.2)
    guide = batch.guide_da if branch == "optical" else batch.guide_rgb
    given = condition(batch.rgb, batch.depth_n, batch.valid, region, guide, evidence)
    paint = region if branch == "optical" else (1 - region) * (1 - batch.valid)
    return given, paint


def branch_step(
    branch: str,
    model: nn.Module,
    autoencoder: VQAutoencoder,
    scenes: Scenes,
    config: Config,
    recipe: Recipe,
    seed: int = 0,
) -> StepLoss:
    """Denoiser of one branch (Paper: Eq. 8): cells that it must paint count fully, all others a little."""
    schedule = make_schedule(config.schedule)
    targets = encode_targets(autoencoder, scenes)

    def step_loss(step: int) -> dict[str, Tensor]:
        rng = rng_of(seed, step)
        batch = draw(scenes, rng.integers(0, len(scenes), recipe.batch), rng)
        (image, filled, known), paint = branch_inputs(branch, batch, config, rng)
        with torch.no_grad():
            masked = autoencoder.encode(_cl(filled))
        x0 = targets[batch.index, batch.flipped.astype(int)].float()
        t = torch.randint(0, schedule.timesteps, (len(x0),))
        t[: len(x0) // 3] = schedule.timesteps - 1  # few-step sampling leans on the first step: practise it
        eps = torch.randn_like(x0)
        x_t = diffusion.q_sample(x0, t, eps, schedule)
        out = model(x_t, t, model.features(_cl(image)), masked, known)
        mask = F.avg_pool2d(paint * batch.gt_known, 4) + 0.05
        return {"total": diffusion.loss(out, x0, eps, t, schedule, config.sampler.prediction, mask=mask)}

    return step_loss


@torch.no_grad()
def encode_targets(autoencoder: VQAutoencoder, scenes: Scenes) -> Tensor:
    """Return Enc(ground truth) of all scenes, as they are and mirrored: (N, 2, C, H/4, W/4) float16.

    The target of the diffusion. The paper's ``L = Enc(D_in)`` cannot be: it would teach the raw depth.
    """
    latents = []
    for batch in batches(scenes, 16, colour=False):
        gt = fill(batch.gt_n, batch.gt_known)
        both = [autoencoder.encode(_cl(g)) for g in (gt, gt.flip(3))]
        latents.append(torch.stack(both, dim=1).half())
    return torch.cat(latents)


def detail_step(
    model: nn.Module,
    painted: Callable[[np.ndarray, np.random.Generator], tuple],
    recipe: Recipe,
    count: int,
    seed: int = 0,
) -> StepLoss:
    """Finer final step: metric error of each kind of loss, root mean square per frame and L1 together."""

    def step_loss(step: int) -> dict[str, Tensor]:
        rng = rng_of(seed, step)
        batch, decoded, region = painted(rng.integers(0, count, recipe.batch), rng)
        x = detail_input(decoded, batch.depth_n, batch.valid, region, batch.rgb, batch.guide_rgb)
        error = (model(_cl(x)) - batch.gt_n) * batch.scale_m
        losses = {}
        for name, where in (("optical", region), ("geometric", (1 - region) * (1 - batch.valid))):
            weight = where * batch.gt_known
            share = weight.sum(dim=(1, 2, 3)).clamp(min=1)
            losses[f"{name}_l1"] = ((error.abs() * weight).sum(dim=(1, 2, 3)) / share).mean()
            losses[f"{name}_rms"] = ((error.square() * weight).sum(dim=(1, 2, 3)) / share + 1e-8).sqrt().mean()
        return {"total": 10 * sum(losses.values()), **losses}

    return step_loss


def batches(scenes: Scenes, size: int, colour: bool = True) -> Iterator[Batch]:
    """Yield all frames in order, without augmentation."""
    for start in range(0, len(scenes), size):
        yield draw(scenes, np.arange(start, min(start + size, len(scenes))), np.random.default_rng(0), False, colour)


def _cl(x: Tensor) -> Tensor:
    return x.contiguous(memory_format=torch.channels_last)


@torch.no_grad()
def one_step(net, autoencoder, given: tuple[Tensor, Tensor, Tensor], schedule, config: Config, seed: int) -> Tensor:
    """Return normalised depth (B, 1, H, W) that one denoising step from pure noise paints."""
    image, filled, known = given
    masked, features = autoencoder.encode(_cl(filled)), net.features(_cl(image))
    noise = torch.randn(masked.shape, generator=torch.Generator().manual_seed(seed))
    t = torch.full((len(noise),), schedule.timesteps - 1)
    out = net(noise, t, features, masked, known)
    return autoencoder.decode(diffusion.to_x0(out, noise, t, schedule, config.sampler.prediction))


@torch.no_grad()
def paint_all(parts: nn.ModuleDict, scenes: Scenes, config: Config, seed: int, variants: int = 2):
    """Let the frozen branches paint every scene ``variants`` times, and return a function that draws from the result.

    The first variant is the scene as it is, with its true region; the others have augmented readings and a region that
    is off, as stage one's is. The function takes indices and a generator (None: first variant) and returns the batch,
    the decoded depth of both branches composed by region, (B, 1, H, W), and that region.
    """
    schedule = make_schedule(config.schedule)
    shape = (len(scenes), variants, 1, *scenes.depth.shape[1:])
    decoded, regions = torch.empty(shape, dtype=torch.float16), torch.empty(shape, dtype=torch.bool)
    for variant in range(variants):
        for start in range(0, len(scenes), 8):
            index = np.arange(start, min(start + 8, len(scenes)))
            batch, region = _variant(scenes, index, variant, seed)
            drawn = []
            for branch in ("optical", "geometric"):
                given, _ = branch_inputs(branch, batch, config, region=region)
                drawn.append(one_step(parts[branch], parts["autoencoder"], given, schedule, config, seed + start))
            decoded[index, variant] = torch.where(region > 0, *drawn).half()
            regions[index, variant] = region > 0

    def painted(index: np.ndarray, rng: np.random.Generator | None) -> tuple[Batch, Tensor, Tensor]:
        variant = 0 if rng is None else int(rng.integers(variants))
        batch, _ = _variant(scenes, index, variant, seed)
        return batch, decoded[index, variant].float(), regions[index, variant].float()

    return painted


def _variant(scenes: Scenes, index: np.ndarray, variant: int, seed: int) -> tuple[Batch, Tensor]:
    """Return frames and region of one variant; each scene is drawn by itself, so any grouping gives the same frames."""
    rngs = [np.random.default_rng([seed, variant, int(i)]) for i in index]
    batch = draw_each(scenes, index, rngs, augment=variant > 0)
    region = (batch.material > 0)[:, None].float()
    if variant:
        region = torch.cat([mistake(r[None], rng) for r, rng in zip(region, rngs, strict=True)])
    return batch, region
