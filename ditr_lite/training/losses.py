"""What stage one and the autoencoder are trained to make small.

The paper states neither. What it does state, Eq. 8 of the denoiser, is ``diffusion.loss``.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..region import IGNORE
from .batches import Batch

ELSEWHERE = 0.05  # weight of pixels that need not be painted, as for DITR's branches
STEP = 0.02  # of log depth between neighbours, 2 % of the depth: an occlusion boundary


def class_boundary(classes: Tensor) -> Tensor:
    """Return (B, H, W) bool: known pixels whose 3x3 neighbourhood holds more than one class (two pixels wide).

    What is not known, such as the padding around a picture, is no class: no outline runs along it.
    """
    x, unknown = classes[:, None].float(), (classes == IGNORE)[:, None]
    largest = F.max_pool2d(x.masked_fill(unknown, -1), 3, 1, padding=1)
    smallest = -F.max_pool2d((-x).masked_fill(unknown, -IGNORE - 1), 3, 1, padding=1)
    return ((largest != smallest) & ~unknown)[:, 0]


def region_loss(
    outputs: dict[str, Any],
    target_classes: Tensor,
    weight: Tensor | None = None,
    side_weight: float = 0.4,
    boundary_weight: float = 0.5,
    boundary_positive: float = 5.0,
) -> dict[str, Tensor]:
    """Score the main output, every side output and the boundary.

    Each class output costs weighted cross-entropy plus soft Dice: the region covers few pixels, and Dice does not care
    how many. Side outputs are scored at half the target's size: thin stems still count, at a quarter of the cost.

    Args:
        outputs: what ``region.RegionNet`` returned.
        target_classes: (B, H, W) int64; 255 = unknown, not scored.
        weight: (classes,) float, class weights of the cross-entropy; None for equal ones.
        side_weight: weight of the mean of the side outputs' losses.
        boundary_weight: weight of the boundary's binary cross-entropy.
        boundary_positive: weight of a boundary pixel against any other.

    Returns:
        Scalars ``ce`` and ``dice`` of the main output, ``side``, ``boundary`` and ``total``.

    Raises:
        ValueError: when ``target_classes`` is not (B, H, W) int64 of the logits' size.
    """
    logits = outputs["logits"]
    shape = (logits.shape[0], *logits.shape[2:])
    if target_classes.dtype != torch.int64 or target_classes.shape != shape:
        got = f"{tuple(target_classes.shape)} {target_classes.dtype}"
        raise ValueError(f"expected target_classes {shape} int64, got {got}")
    known = target_classes != IGNORE
    ce, dice = _class_loss(logits, target_classes, known, weight)
    half = target_classes[:, ::2, ::2]
    sides = []
    for coarse in outputs["side"]:
        full = F.interpolate(coarse, size=shape[1:], mode="bilinear", align_corners=False)
        sides.append(sum(_class_loss(full[..., ::2, ::2], half, half != IGNORE, weight)))  # the very pixels of `half`
    side = torch.stack(sides).mean() if sides else logits.new_zeros(())
    edge, true_edge = outputs["boundary"][:, 0], class_boundary(target_classes).to(logits.dtype)
    positive = edge.new_tensor(boundary_positive)
    bce = F.binary_cross_entropy_with_logits(edge, true_edge, pos_weight=positive, reduction="none")
    boundary = (bce * known).sum() / known.sum().clamp_min(1)
    total = ce + dice + side_weight * side + boundary_weight * boundary
    return {"ce": ce, "dice": dice, "side": side, "boundary": boundary, "total": total}


def _class_loss(logits: Tensor, target: Tensor, known: Tensor, weight: Tensor | None) -> tuple[Tensor, Tensor]:
    safe = torch.where(known, target, 0)
    pixel_weight = known.to(logits.dtype) if weight is None else weight[safe] * known
    ce = (F.cross_entropy(logits, safe, reduction="none") * pixel_weight).sum() / pixel_weight.sum().clamp_min(1e-6)
    p = logits.softmax(dim=1)[:, 1:] * known[:, None]  # foreground classes, (B, classes - 1, H, W)
    t = F.one_hot(safe, logits.shape[1]).movedim(-1, 1)[:, 1:] * known[:, None]
    both, either = (p * t).sum(dim=(0, 2, 3)), (p + t).sum(dim=(0, 2, 3))
    return ce, (1 - (2 * both + 1) / (either + 1)).mean()  # + 1: an absent class that is not predicted costs nothing


def depth_steps(x: Tensor, valid: Tensor) -> Tensor:
    """Return the largest absolute difference of each pixel to a valid 4-neighbour.

    Args:
        x: (B, 1, H, W) depth.
        valid: (B, 1, H, W) bool; an invalid pixel is nobody's neighbour.

    Returns:
        (B, 1, H, W), 0 where no pair is valid. Both sides of a step get its height.
    """
    steps = torch.zeros_like(x)
    for dim in (2, 3):
        size = x.shape[dim] - 1
        pair = valid.narrow(dim, 0, size) & valid.narrow(dim, 1, size)
        step = x.diff(dim=dim).abs() * pair  # (B, 1, H-1, W) or (B, 1, H, W-1)
        for start in (0, 1):
            part = steps.narrow(dim, start, size)
            torch.maximum(part, step, out=part)
    return steps


def autoencoder_loss(
    x: Tensor,
    out: dict[str, Tensor],
    valid: Tensor,
    edge_weight: float = 4.0,
    edge_step: float = 0.05,
    gradient_weight: float = 0.5,
) -> dict[str, Tensor]:
    """Score a reconstruction: weighted L1, difference of gradients, commitment.

    The L1 weight of a pixel is ``1 + edge_weight * min(1, step / edge_step)``, ``step`` being the ground truth's
    largest difference to a neighbour: few pixels lie at depth edges, and they hold most of the error.

    Args:
        x: (B, 1, H, W) normalised ground truth, anything finite where invalid.
        out: the dictionary that :class:`autoencoder.VQAutoencoder` returns.
        valid: (B, 1, H, W) bool or 0/1, the pixels with ground truth.
        edge_weight: extra weight at a full edge.
        edge_step: the step, in units of ``x``, that counts as a full edge.
        gradient_weight: weight of the gradient term.

    Returns:
        Scalars ``l1`` (plain, for reading), ``weighted_l1``, ``gradient``, ``commitment`` and ``total``.

    Raises:
        ValueError: when the shapes differ.
    """
    y = out["reconstruction"]
    if not x.shape == y.shape == valid.shape:
        raise ValueError(f"expected one shape, got x {tuple(x.shape)}, y {tuple(y.shape)}, valid {tuple(valid.shape)}")
    valid = valid.bool()
    error = torch.where(valid, (y - x).abs(), 0.0)
    weight = valid * (1 + edge_weight * (depth_steps(x, valid) / edge_step).clamp_max(1))
    l1 = error.sum() / valid.sum().clamp_min(1)
    weighted = (weight * error).sum() / weight.sum().clamp_min(1)
    gradient = _gradient_difference(x, y, valid)
    total = weighted + gradient_weight * gradient + out["commitment"]
    return {
        "l1": l1.detach(),
        "weighted_l1": weighted,
        "gradient": gradient,
        "commitment": out["commitment"],
        "total": total,
    }


def _gradient_difference(x: Tensor, y: Tensor, valid: Tensor) -> Tensor:
    total, pairs = x.new_zeros(()), x.new_zeros(())
    for dim in (2, 3):
        pair = valid.narrow(dim, 0, x.shape[dim] - 1) & valid.narrow(dim, 1, x.shape[dim] - 1)
        difference = (y.diff(dim=dim) - x.diff(dim=dim)).abs()
        total = total + torch.where(pair, difference, 0.0).sum()
        pairs = pairs + pair.sum()
    return total / pairs.clamp_min(1)


def orientation_loss(out: Tensor, batch: Batch, paint: Tensor) -> dict[str, Tensor]:
    """Return the losses of gradients and edges (B, 3, H, W); pixels to be painted count fully, others a little."""
    truth = batch.truth_m.clamp(min=0.05).log()
    known = batch.gt_known
    gx = F.pad(truth[..., 1:] - truth[..., :-1], (0, 1, 0, 0))
    gy = F.pad(truth[..., 1:, :] - truth[..., :-1, :], (0, 0, 0, 1))
    pairs = (known[..., 1:] * known[..., :-1], known[..., 1:, :] * known[..., :-1, :])
    both = F.pad(pairs[0], (0, 1, 0, 0)) * F.pad(pairs[1], (0, 0, 0, 1)) * (paint + ELSEWHERE).clamp(max=1)
    gradients = torch.cat([gx, gy], dim=1)
    edge = (gradients.abs().amax(dim=1, keepdim=True) > STEP).float()
    smooth = both * (1 - edge)
    l1 = ((out[:, :2] - gradients).abs() * smooth).sum() / smooth.sum().clamp(min=1)
    cross = (F.binary_cross_entropy_with_logits(out[:, 2:], edge, reduction="none") * both).sum()
    cross = cross / both.sum().clamp(min=1)
    return {"total": 100 * l1 + cross, "gradient_l1": l1, "edge": cross}
