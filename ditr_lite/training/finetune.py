"""Fine-tune stage one through the frozen stage two: the final RMSE joins its loss.

Paper: Sec. IV-B, "we fix the Depth Inpainting stage and finetune the first stage. We modify the loss function and add
the final RMSE from a pre-trained inpainting model to it"; Sec. V-B, learning rate 1e-3, 50 epochs, all else kept.

As written, nothing flows back: between the network and the final depth stand a threshold, a median, a dilation and a
sampler. What stands in for each, here:

    threshold at 1/2      a steep sigmoid, or straight-through: hard forwards, the sigmoid's gradient backwards
    median of a mask      the mean of the window, through the same sigmoid (the median of a mask is a vote)
    dilation              the maximum of the window, which is what it is; gradient reaches the largest value
    sampler               one step from pure noise, as the shipped system samples; painted once per scene, from the
                          region that stage one finds before fine-tuning, joined with the true one, and kept
    composition           m * optical + (1 - m) * (reading, or geometric where there is none)

So the gradient is a slope: it says, pixel by pixel, whether the final depth would gain if a *little* more of the pixel
belonged to the region, not whether it would gain if the whole pixel joined. How a change of the region changes what is
painted *elsewhere* is left out.
"""

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from tqdm.auto import tqdm

from ..config import Config, RefineConfig
from ..detail import detail_input
from ..region import region_loss, region_probability
from ..schedule import make_schedule
from . import recipes
from .batches import Batch, Scenes
from .region_training import descend, epoch_batches, known_classes, sgd

RATE, EPOCHS = 1e-3, 50  # the paper's
STEEPNESS = 20.0
Painted = Callable[[Batch], tuple[Tensor, Tensor]]


def soft_region(
    probability: Tensor, refine: RefineConfig, steepness: float = STEEPNESS, straight_through: bool = False
) -> Tensor:
    """Return the refined region with a gradient.

    As the steepness grows this becomes ``refine_region(probability > 0.5)``; with ``straight_through`` it has exactly
    those values already and borrows the soft one's gradient.

    Args:
        probability: (B, 1, H, W) in [0, 1].
        refine: kernels.
        steepness: of the sigmoid that stands in for the threshold.
        straight_through: hard values, soft gradient.

    Returns:
        (B, 1, H, W) in [0, 1].

    Raises:
        ValueError: for a probability of another shape, or a steepness that is not positive.
    """
    if probability.ndim != 4 or probability.shape[1] != 1:
        raise ValueError(f"expected a probability (B, 1, H, W), got {tuple(probability.shape)}")
    if steepness <= 0:
        raise ValueError(f"expected a steepness above 0, got {steepness}; 20 is a good start")

    def soft_threshold(x: Tensor) -> Tensor:
        return torch.sigmoid(steepness * (x - 0.5))

    soft = _refine(probability, refine, soft_threshold)
    if not straight_through:
        return soft
    with torch.no_grad():
        hard = _refine(probability, refine, lambda x: (x > 0.5).to(x.dtype))
    return hard + (soft - soft.detach())


def _refine(x: Tensor, refine: RefineConfig, threshold: Callable[[Tensor], Tensor]) -> Tensor:
    x = threshold(x)
    if refine.median > 1:
        pad = refine.median // 2
        x = threshold(F.avg_pool2d(F.pad(x, (pad,) * 4, mode="replicate"), refine.median, 1))
    for _ in range(refine.iterations if refine.dilate > 1 else 0):
        x = F.max_pool2d(x, refine.dilate, 1, refine.dilate // 2)  # pads with -inf: nothing grows in from outside
    return x


def soft_compose(region: Tensor, depth_n: Tensor, valid: Tensor, optical: Tensor, geometric: Tensor) -> Tensor:
    """Return the composed depth for a region between 0 and 1; for a hard one it is ``pipeline.compose``.

    Args:
        region: (B, 1, H, W) in [0, 1]; all others have this shape too.
        depth_n: normalised raw depth, anything where not valid.
        valid: 0/1.
        optical: normalised painting of the optical branch.
        geometric: normalised painting of the geometric branch.
    """
    return region * optical + (1 - region) * torch.where(valid > 0, depth_n, geometric)


def final_rmse(depth_n: Tensor, batch: Batch) -> Tensor:
    """Return the mean over frames of the RMSE in metres where the truth is known (Paper: Eq. 4)."""
    squared = ((depth_n - batch.gt_n) * batch.scale_m).square() * batch.gt_known
    count = batch.gt_known.sum(dim=(1, 2, 3)).clamp(min=1)
    return (squared.sum(dim=(1, 2, 3)) / count + 1e-12).sqrt().mean()  # + 1e-12: the root's slope at 0 is infinite


@torch.no_grad()
def paint(parts: nn.ModuleDict, batch: Batch, region: Tensor, config: Config, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return what both frozen branches paint in one step from pure noise, (B, 1, H, W) normalised each.

    Args:
        parts: the trained networks.
        batch: with guides.
        region: (B, 1, H, W) 0/1.
        config: of the system.
        seed: of the noise.
    """
    schedule, drawn = make_schedule(config.schedule), []
    for branch in ("optical", "geometric"):
        given, _ = recipes.branch_inputs(branch, batch, config, region=region)
        drawn.append(recipes.one_step(parts[branch], parts["autoencoder"], given, schedule, config, seed))
    if "detail" in parts:
        together = torch.where(region > 0, *drawn)
        x = detail_input(together, batch.depth_n, batch.valid, region, batch.rgb, batch.guide_rgb)
        finer = parts["detail"](x)  # each branch is sharpened where it will be used
        drawn = [torch.where(region > 0, finer, drawn[0]), torch.where(region > 0, drawn[1], finer)]
    return tuple(drawn)


@torch.no_grad()
def paint_once(parts: nn.ModuleDict, scenes: Scenes, config: Config, seed: int = 0) -> Painted:
    """Paint every scene once and return a function that looks a batch's paintings up, mirrored where the batch is.

    The region is what stage one finds and refines, joined with the true one: wherever fine-tuning may move it, the
    optical branch has painted there.
    """
    shape = (len(scenes), 2, *scenes.depth.shape[1:])
    store = torch.empty(shape, dtype=torch.float16)
    for batch in tqdm(recipes.batches(scenes, 8), total=-(-len(scenes) // 8), desc="painting", unit="batch"):
        probability = region_probability(parts["region"](batch.rgb, batch.depth_n, batch.valid))
        found = soft_region(probability, config.refine, straight_through=True)
        region = torch.maximum(found, (batch.material > 0)[:, None].float())
        store[batch.index] = torch.cat(paint(parts, batch, region, config, seed), dim=1).half()

    def painted(batch: Batch) -> tuple[Tensor, Tensor]:
        both = store[batch.index].float()
        flipped = torch.from_numpy(np.asarray(batch.flipped))[:, None, None, None]
        return torch.where(flipped, both.flip(3), both).split(1, dim=1)

    return painted


def finetune_region(
    model: nn.Module,
    scenes: Scenes,
    painted: Painted,
    refine: RefineConfig,
    steps: int,
    rmse_weight: float = 1.0,
    straight_through: bool = False,
    batch: int = 16,
    rate: float = RATE,
    seed: int = 0,
) -> list[dict[str, float]]:
    """Fine-tune stage one in place, with stage two frozen.

    Args:
        model: a trained ``region.RegionNet``.
        scenes: to learn from.
        painted: batch -> optical and geometric painting, normalised; :func:`paint_once` makes one.
        refine: kernels that will be used with the result.
        steps: of SGD; the paper's are :data:`EPOCHS` passes over all scenes.
        rmse_weight: per metre; 0 goes on with the segmentation loss alone, which is the control.
        straight_through: see :func:`soft_region`.
        batch: scenes a step.
        rate: constant learning rate.
        seed: of everything random.

    Returns:
        one row a step: ``total``, ``segmentation`` and ``rmse_m``, all before that step.

    Raises:
        ValueError: for fewer than one step.
    """
    if steps < 1 or batch < 1:
        raise ValueError(f"expected steps and batch of at least 1, got {steps} and {batch}")
    model.requires_grad_(True).train()
    optimiser, weight = sgd(model), torch.tensor(recipes.CLASS_WEIGHTS)
    rows, epoch = [], 0
    with tqdm(total=steps, desc="fine-tuning", unit="step") as bar:
        while len(rows) < steps:
            for drawn in epoch_batches(scenes, batch, epoch, seed):
                outputs = model(drawn.rgb, drawn.depth_n, drawn.valid)
                segmentation = region_loss(outputs, known_classes(drawn), weight)["total"]
                region = soft_region(region_probability(outputs), refine, straight_through=straight_through)
                rmse = final_rmse(soft_compose(region, drawn.depth_n, drawn.valid, *painted(drawn)), drawn)
                total = segmentation + rmse_weight * rmse
                figures = {"total": total, "segmentation": segmentation, "rmse_m": rmse}
                rows.append({k: float(v.detach()) for k, v in figures.items()})
                descend(optimiser, total, rate)
                bar.update()
                if len(rows) == steps:
                    break
            epoch += 1
    model.eval().requires_grad_(False)
    return rows
