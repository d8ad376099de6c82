"""How the paper trains, as far as it says, as data and as the optimisers and rates that follow from it.

Paper: Sec. V-B. Our own recipes (``recipes``) depart from it: AdamW, one cosine decay, minutes instead of days. Two
statements need a reading, which is ours:

* "a mix of a trigonometric factor and an exponential factor as the learning rate" is not written out. TROSNet's public
  script, which the paper follows, has a slow linear decay plus a sine and no exponential (:func:`trosnet_rate`); we
  take the words as they stand, cosine times exponential (:func:`region_rate`).
* a rate of 1e-6 at a batch of 64 is latent diffusion's *base* rate, which its script multiplies by batch size and
  number of GPUs (:func:`scaled_rate`); the paper does not say whether it did.
"""

import math
from dataclasses import dataclass

import torch
from torch import nn


@dataclass(frozen=True)
class Stated:
    """What the paper states about the training of one part; None where it is silent."""

    optimiser: str  # "SGD" as stated, or "Adam", latent diffusion's, where the paper is silent
    batch: int | None = None
    lr: float | None = None
    epochs: int | None = None
    momentum: float = 0.0
    weight_decay: float = 0.0


REGION = Stated("SGD", batch=16, epochs=200, momentum=0.9, weight_decay=1e-4)
FINE_TUNING = Stated("SGD", batch=16, lr=1e-3, epochs=50, momentum=0.9, weight_decay=1e-4)  # stage two is frozen
DENOISER = Stated("Adam", batch=64, lr=1e-6)


def make_optimiser(model: nn.Module, stated: Stated, lr: float | None = None) -> torch.optim.Optimizer:
    """Return the optimiser that the paper states, over the parameters of ``model`` that are not frozen.

    Args:
        model: to be trained.
        stated: what the paper says.
        lr: learning rate where it says nothing, or to use instead.

    Raises:
        ValueError: when neither the paper nor the caller gives a rate, or nothing is left to train.
    """
    lr = stated.lr if lr is None else lr
    if lr is None:
        raise ValueError("the paper states no learning rate here: give lr, e.g. region_rate(0)")
    parameters = [p for p in model.parameters() if p.requires_grad]
    if not parameters:
        raise ValueError("expected a model with parameters to train, all of them are frozen; call requires_grad_()")
    if stated.optimiser == "SGD":
        return torch.optim.SGD(parameters, lr, stated.momentum, weight_decay=stated.weight_decay)
    return torch.optim.Adam(parameters, lr)


def region_rate(epoch: float, lr: float = 1e-2, epochs: int = 200, decay: float = 0.99) -> float:
    """Return stage one's learning rate, lr * (1 + cos(pi e / epochs)) / 2 * decay^e: our reading of the paper's words.

    Args:
        epoch: e, 0 to ``epochs``; fractions count.
        lr: rate at the start, which the paper does not give.
        epochs: the paper's 200.
        decay: exponential factor of one epoch, which the paper does not give.

    Raises:
        ValueError: for an epoch outside [0, epochs].
    """
    if not 0 <= epoch <= epochs:
        raise ValueError(f"epoch: expected 0 to {epochs}, got {epoch}")
    return lr * 0.5 * (1 + math.cos(math.pi * epoch / epochs)) * decay**epoch


def trosnet_rate(epoch: float, iteration: int) -> float:
    """Return the learning rate of TROSNet's public training script: a linear decay plus a sine, no exponential.

    Args:
        epoch: 0 to 150, over which both terms shrink.
        iteration: counted from 0; the sine has a period of 228 of them.
    """
    base, swing = 0.001 - 0.0004 * epoch / 150, 0.0005 - 0.0002 * epoch / 150
    return base + swing * math.sin(2 * math.pi * iteration / 228)


def scaled_rate(base: float = 1e-6, batch: int = 64, gpus: int = 1) -> float:
    """Return the rate that latent diffusion's script trains with when told ``base``: times batch size and GPUs."""
    return base * batch * gpus
