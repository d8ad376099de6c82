"""How the paper trains, as far as it says (Paper: Sec. V-B): stage one in epochs of SGD, the denoiser's rate.

Stage one: "we set batch size, momentum, and weight decay to 16, 0.9, and 0.0001. We implement a mix of a trigonometric
factor and an exponential factor as the learning rate. We train with an epoch number of 200." Stage two: batches of 64
at a rate of 1e-6. The shipped weights were made by ``recipes`` instead (AdamW, one cosine, minutes); this file is what
the paper says, run by tests and in notebook 02 at a small size.
"""

import math
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import nn
from tqdm.auto import tqdm

from .batches import frames_shuffled
from .losses import region_loss
from .recipes import CLASS_WEIGHTS, rng_of
from .scenes import Scenes

EPOCHS, BATCH, MOMENTUM, WEIGHT_DECAY = 200, 16, 0.9, 1e-4  # stage one
DENOISER_BATCH, BASE_RATE = 64, 1e-6  # stage two
PEAK = 0.01  # not in the paper; its fine-tuning rate, 1e-3, is a tenth of it
FALL = math.log(10)  # our exponential factor ends at a tenth
Law = Callable[[int, int, int], float]  # (epoch, iteration, epochs) -> learning rate


def paper_learning_rate(
    epoch: int, iteration: int = 0, epochs: int = EPOCHS, peak: float = PEAK, fall: float = FALL
) -> float:
    """Return the rate of an epoch: half a cosine times an exponential.

    Paper: Sec. V-B names the two kinds of factor and no formula. Our reading, with p = epoch / epochs, is
    ``peak * (1 + cos(pi p)) / 2 * exp(-fall p)``: the cosine ends at 0, and the exponential moves most of the training
    to smaller rates.

    Args:
        epoch: counted from 0.
        iteration: ignored, so that all laws are called alike.
        epochs: after which the rate is 0.
        peak: rate of epoch 0.
        fall: logarithm by which the exponential factor falls in all.

    Raises:
        ValueError: for an epoch outside 0 to ``epochs``.
    """
    if not 0 <= epoch <= epochs or epochs < 1:
        raise ValueError(f"expected an epoch from 0 to {epochs}, got {epoch}")
    p = epoch / epochs
    return peak * (1 + math.cos(math.pi * p)) / 2 * math.exp(-fall * p)


def trosnet_learning_rate(epoch: int, iteration: int, epochs: int = EPOCHS) -> float:
    """Return the rate of TROSNet's public training script: a slow linear fall plus a sine; nothing is exponential.

    ``0.001 - 0.0004 i/150 + (0.0005 - 0.0002 i/150) sin(2 pi iter / 228)`` with epoch i and iteration iter.

    Args:
        epoch: counted from 0.
        iteration: counted from 0; the sine has a period of 228 of them.
        epochs: ignored, so that all laws are called alike.
    """
    fallen = epoch / 150
    return 0.001 - 0.0004 * fallen + (0.0005 - 0.0002 * fallen) * math.sin(2 * math.pi * iteration / 228)


def sgd(model: nn.Module, momentum: float = MOMENTUM, weight_decay: float = WEIGHT_DECAY) -> torch.optim.SGD:
    """Return the paper's optimiser over what is not frozen; the rate is set before every step."""
    parameters = [p for p in model.parameters() if p.requires_grad]
    return torch.optim.SGD(parameters, lr=PEAK, momentum=momentum, weight_decay=weight_decay)


def train_region(
    model: nn.Module,
    scenes: Scenes,
    epochs: int = EPOCHS,
    batch: int = BATCH,
    rate: Law = paper_learning_rate,
    momentum: float = MOMENTUM,
    weight_decay: float = WEIGHT_DECAY,
    class_weights: tuple[float, ...] = CLASS_WEIGHTS,
    seed: int = 0,
    validate: Callable[[], dict[str, float]] | None = None,
    size: tuple[int, int] | None = None,
) -> list[dict[str, float]]:
    """Train stage one in place, in epochs (Paper: Sec. V-B; three classes, deep supervision and boundary as in IV-B).

    Args:
        model: a ``region.RegionNet``.
        scenes: to learn from; drawn with augmentation.
        epochs: passes over all scenes.
        batch: scenes a step.
        rate: law of the learning rate.
        momentum: of SGD.
        weight_decay: of SGD.
        class_weights: of the cross-entropy: background, transparent, reflective.
        seed: of everything random.
        validate: called after every epoch in eval mode, without gradients; its figures join the row.
        size: (H, W) that frames are brought to; None for the scenes' own.

    Returns:
        one row an epoch: ``epoch``, the ``rate`` of its last step, the mean of each loss, ``seconds`` since the start.

    Raises:
        ValueError: for fewer than one epoch or scene a step, or no scenes.
    """
    if epochs < 1 or batch < 1 or not len(scenes):
        raise ValueError(f"expected epochs, batch and scenes of at least 1, got {epochs}, {batch}, {len(scenes)}")
    optimiser = sgd(model, momentum, weight_decay)
    weight = torch.tensor(class_weights)
    size = scenes.depth.shape[1:] if size is None else size
    started = time.monotonic()
    rows = []
    iteration = 0
    for epoch in tqdm(range(epochs), desc="region", unit="epoch"):
        model.train()
        losses = []
        for drawn in frames_shuffled(scenes, size, batch, rng_of(seed, epoch)):
            step_rate = rate(epoch, iteration, epochs)
            parts = region_loss(model(drawn.rgb, drawn.depth_n, drawn.valid), drawn.material, weight)
            descend(optimiser, parts["total"], step_rate)
            losses.append({k: float(v.detach()) for k, v in parts.items()})
            iteration += 1
        row = {"epoch": epoch, "rate": step_rate}
        for name in losses[0]:
            row[name] = float(np.mean([x[name] for x in losses]))
        if validate is not None:
            model.eval()
            with torch.no_grad():
                row |= validate()
        rows.append(row | {"seconds": time.monotonic() - started})
    model.eval()
    return rows


def descend(optimiser: torch.optim.Optimizer, loss: torch.Tensor, rate: float) -> None:
    """Take one step down the gradient of ``loss`` at the given learning rate."""
    for group in optimiser.param_groups:
        group["lr"] = rate
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    optimiser.step()


def scaled_rate(base: float = BASE_RATE, batch: int = DENOISER_BATCH, gpus: int = 1) -> float:
    """Return the rate that latent diffusion's script trains with when told ``base``: times batch size and GPUs.

    The paper's 1e-6 is also latent diffusion's *base* rate. The paper, which follows latent diffusion, does not say
    whether it multiplied it so.

    Raises:
        ValueError: for a rate that is not positive, or a batch or number of GPUs below 1.
    """
    if not base > 0 or batch < 1 or gpus < 1:
        raise ValueError(f"expected a positive base, batch and gpus of at least 1, got {base}, {batch}, {gpus}")
    return base * batch * gpus
