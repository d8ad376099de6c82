"""How a reconstructed depth map is scored in training: L1 that weighs depth edges, gradients, commitment.

Paper: Sec. IV-C states no loss for the autoencoder. Few pixels lie at depth edges, and they hold most of the error.
"""

import torch
from torch import Tensor


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
