"""Fine-tune stage one through the frozen stage two: the final RMSE joins its loss.

Paper: Sec. IV-B, "we fix the Depth Inpainting stage and finetune the first stage. We modify the loss function and add
the final RMSE from a pre-trained inpainting model to it"; Sec. V-B, learning rate 1e-3, 50 epochs, all else kept.

As written, nothing flows back: between the network and the final depth stand a threshold, a median, a dilation and a
sampler. What stands in for each, here:

    threshold             a steep sigmoid, or straight-through: hard forwards, the sigmoid's gradient backwards
    median of a mask      the mean of the window, through the same sigmoid (the median of a mask is a vote)
    dilation              the maximum of the window, which is what it is; gradient reaches the largest value
    sampler               one step from pure noise, as the shipped system samples, on the whole frame, without a
                          gradient: each step paints for the region that stage one finds there, joined with the true one
    composition           m * optical + (1 - m) * (reading, or geometric where there is none)

So the gradient is a slope: it says, pixel by pixel, whether the final depth would gain if a *little* more of the pixel
belonged to the region, not whether it would gain if the whole pixel joined. How a change of the region changes what is
painted *elsewhere* is left out.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..boundary import get_backend
from ..config import Config, RefineConfig
from ..region import region_probability
from ..schedule import make_schedule
from ..stage_two import BRANCHES, Painter, Views, paint
from .as_the_paper import SGD
from .batches import Batch, epoch_frames
from .loop import Losses, Recipe, Share, Step, fit
from .losses import region_loss
from .parts import painter_of
from .recipes import CLASS_WEIGHTS
from .scenes import Pool, Scenes

RATE, EPOCHS = 1e-3, 50  # the paper's
STEEPNESS = 20.0
Paints = Callable[[Batch, Tensor], tuple[Tensor, Tensor]]  # of a batch and its region (B, 1, H, W), 0/1


def soft_region(
    probability: Tensor, refine: RefineConfig, steepness: float = STEEPNESS, straight_through: bool = False
) -> Tensor:
    """Return the refined region with a gradient.

    As the steepness grows this becomes ``refine_region(probability > refine.threshold)``; with ``straight_through`` it
    has exactly those values already and borrows the soft one's gradient.

    Args:
        probability: (B, 1, H, W) in [0, 1].
        refine: threshold and kernels.
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

    soft = _refine(probability, refine, lambda x, at: torch.sigmoid(steepness * (x - at)))
    if not straight_through:
        return soft
    with torch.no_grad():
        hard = _refine(probability, refine, lambda x, at: (x > at).to(x.dtype))
    return hard + (soft - soft.detach())


def _refine(x: Tensor, refine: RefineConfig, step: Callable[[Tensor, float], Tensor]) -> Tensor:
    x = step(x, refine.threshold)
    if refine.median > 1:
        pad = refine.median // 2
        x = step(F.avg_pool2d(F.pad(x, (pad,) * 4, mode="replicate"), refine.median, 1), 0.5)  # a majority
    for _ in range(refine.iterations if refine.dilate > 1 else 0):
        x = F.max_pool2d(x, refine.dilate, 1, refine.dilate // 2)  # pads with -inf: nothing grows in from outside
    return x


def soft_compose(region: Tensor, depth: Tensor, valid: Tensor, optical: Tensor, geometric: Tensor) -> Tensor:
    """Return the composed depth for a region between 0 and 1; for a hard one it is ``pipeline.compose``.

    Args:
        region: (B, 1, H, W) in [0, 1]; all others have this shape too.
        depth: raw metres, anything where not valid.
        valid: 0/1.
        optical: painting of the optical branch, metres.
        geometric: painting of the geometric branch, metres.
    """
    return region * optical + (1 - region) * torch.where(valid > 0, depth, geometric)


def final_rmse(depth_m: Tensor, batch: Batch) -> Tensor:
    """Return the mean over frames of the RMSE in metres where the truth is known (Paper: Eq. 4)."""
    squared = (depth_m - batch.truth_m).square() * batch.gt_known
    count = batch.gt_known.sum(dim=(1, 2, 3)).clamp(min=1)
    return (squared.sum(dim=(1, 2, 3)) / count + 1e-12).sqrt().mean()  # + 1e-12: the root's slope at 0 is infinite


def frame_painters(parts: nn.ModuleDict, config: Config) -> dict[str, Painter]:
    """Return both branches, trained, with the finer final step where there is one."""
    detail = parts["detail"] if "detail" in parts else None
    return {branch: replace(painter_of(branch, parts, config), detail=detail) for branch in BRANCHES}


def whole_frames(painters: Mapping[str, Painter], config: Config, seed: int = 0) -> Paints:
    """Return what lets both frozen branches paint whole frames in one step from pure noise.

    Args:
        painters: as :func:`frame_painters` makes them.
        config: of the schedule and the sampler.
        seed: of the noise.

    Returns:
        batch with guides, region -> optical and geometric painting, (B, 1, H, W) metres each.
    """
    schedule = make_schedule(config.schedule)

    @torch.no_grad()
    def paints(batch: Batch, region: Tensor) -> tuple[Tensor, Tensor]:
        drawn = []
        for branch, guide in zip(BRANCHES, (batch.guide_da, batch.guide_rgb), strict=True):  # S8
            views = Views(batch.rgb, batch.depth_n, batch.valid, region, guide, batch.guide_rgb)
            views = views if config.evidence else views.without_evidence()
            generator = torch.Generator().manual_seed(seed)
            painted = paint(
                painters[branch], views, schedule, prediction=config.sampler.prediction, generator=generator
            )
            drawn.append(batch.bounds.denormalise(painted[0]))  # (1, B, 1, H, W) -> (B, 1, H, W)
        return drawn[0], drawn[1]

    return paints


def final_depth(batch: Batch, region: Tensor, paints: Paints) -> Tensor:
    """Return the final depth (B, 1, H, W) in metres for a soft region; only the composition has a gradient.

    The branches paint for the hard region, joined with the true one: wherever a step may move the region, the optical
    branch has painted.

    Args:
        batch: with guides.
        region: (B, 1, H, W) in [0, 1].
        paints: see :func:`whole_frames`.
    """
    hard = (region.detach() > 0.5).to(region.dtype)
    optical, geometric = paints(batch, torch.maximum(hard, batch.region))
    readings = batch.bounds.denormalise(batch.depth_n)
    return soft_compose(region, readings, batch.valid, optical, geometric)


def finetune_region(
    model: nn.Module,
    scenes: Scenes,
    paints: Paints,
    config: Config,
    steps: int,
    rmse_weight: float = 1.0,
    straight_through: bool = False,
    batch: int = 16,
    rate: float = RATE,
    seed: int = 0,
    boundary: str = "classical",
) -> list[dict[str, float]]:
    """Fine-tune stage one in place, with stage two frozen.

    Args:
        model: a trained ``region.RegionNet``.
        scenes: to learn from.
        paints: the frozen stage two; :func:`whole_frames` makes one.
        config: of the working size, and of the refinement that will be used with the result.
        steps: of SGD; the paper's are :data:`EPOCHS` passes over all scenes.
        rmse_weight: per metre; 0 goes on with the segmentation loss alone, which is the control.
        straight_through: see :func:`soft_region`.
        batch: scenes a step.
        rate: constant learning rate.
        seed: of everything random.
        boundary: backend of the guides.

    Returns:
        one row a step: ``total``, ``segmentation`` and ``rmse_m``, all before that step.

    Raises:
        ValueError: for fewer than one step.
    """
    if steps < 1 or batch < 1:
        raise ValueError(f"expected steps and batch of at least 1, got {steps} and {batch}")
    model.requires_grad_(True)
    recipe = Recipe(steps, batch, rate, law="constant", **SGD)
    draw = partial(epoch_frames, Pool([scenes]), config.size, batch, seed, get_backend(boundary))
    rows: list[dict[str, float]] = []
    score = partial(score_final, model, paints, config, rmse_weight, straight_through)
    fit("fine-tuning", model, Step(draw, score), recipe, None, seed=seed, watch=lambda _, losses: rows.append(losses))
    model.eval().requires_grad_(False)
    return rows


def score_final(
    model: nn.Module,
    paints: Paints,
    config: Config,
    rmse_weight: float,
    straight_through: bool,
    drawn: Batch,
    step: int,
    share: Share,
) -> Losses:
    """Score stage one by its classes and by the final depth that follows from its region."""
    outputs = at_first_look(model, drawn, config)
    weight = drawn.rgb.new_tensor(CLASS_WEIGHTS)
    segmentation = region_loss(outputs, drawn.material, weight)["total"]
    calibrated = region_probability({"logits": outputs["logits"] / config.refine.temperature})  # as the threshold asks
    region = soft_region(calibrated, config.refine, straight_through=straight_through)
    rmse = final_rmse(final_depth(drawn, region, paints), drawn)
    return {"total": segmentation + rmse_weight * rmse, "segmentation": segmentation, "rmse_m": rmse}


def at_first_look(model: nn.Module, batch: Batch, config: Config) -> dict[str, Any]:
    """Return what stage one says of a batch at the working size, looking at it at the size that it is trained for."""
    size = config.look()
    rgb = F.interpolate(batch.rgb, size=size, mode="bilinear", align_corners=False)
    depth_n, valid = (F.interpolate(x, size=size, mode="nearest-exact") for x in (batch.depth_n, batch.valid))
    outputs = model(rgb, depth_n, valid)
    back = partial(F.interpolate, size=config.size, mode="bilinear", antialias=True)
    return outputs | {key: back(outputs[key]) for key in ("logits", "boundary")}
