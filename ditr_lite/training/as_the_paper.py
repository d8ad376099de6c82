"""How the paper trains, as far as it says (Paper: Sec. V-B): stage one in epochs of SGD, the denoiser's rate.

Stage one: "we set batch size, momentum, and weight decay to 16, 0.9, and 0.0001. We implement a mix of a trigonometric
factor and an exponential factor as the learning rate. We train with an epoch number of 200." Stage two: batches of 64
at a rate of 1e-6. The shipped weights were made by ``recipes`` instead (AdamW, a warm-up and a cosine in each run,
hours); this file is what the paper says of optimiser, batch, epochs and rate, run by tests and in notebook 02. What a
step makes small follows from the preset: ``sampler.objective``, for one.
"""

import math
from collections.abc import Callable
from functools import partial

from torch import nn

from .batches import Batch, epoch_frames, steps_of_an_epoch
from .loop import FALL, Losses, Recipe, Share, Step, fall_by, fit
from .losses import region_loss
from .recipes import CLASS_WEIGHTS
from .scenes import Pool, Scenes

EPOCHS, BATCH, MOMENTUM, WEIGHT_DECAY = 200, 16, 0.9, 1e-4  # stage one
# its optimiser; nothing is clipped or averaged: the last weights are what remains
SGD = {"optimiser": "sgd", "momentum": MOMENTUM, "weight_decay": WEIGHT_DECAY, "clip": 0.0, "decay": 0.0, "warmup": 0}
DENOISER_BATCH, BASE_RATE = 64, 1e-6  # stage two
PEAK = 0.01  # not in the paper; its fine-tuning rate, 1e-3, is a tenth of it
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
    return peak * fall_by(p, fall)


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


def paper_recipe(part: str, scenes: int, epochs: int = EPOCHS) -> Recipe:
    """Return how the paper trains a part, for a number of scenes.

    Args:
        part: "region" (S3), "optical" or "geometric" (S6), or "autoencoder", of which the paper says nothing: batches
            of the denoiser's size, at latent diffusion's rate for such autoencoders, 4.5e-6 for each frame of a batch.
        scenes: that an epoch has.
        epochs: 200 for stage one; the paper gives none for stage two, and we take as many.

    Raises:
        ValueError: for another part, or fewer than one scene or epoch.
    """
    if scenes < 1 or epochs < 1:
        raise ValueError(f"expected scenes and epochs of at least 1, got {scenes} and {epochs}")
    if part == "region":
        per_epoch = steps_of_an_epoch(scenes, BATCH)
        return Recipe(epochs * per_epoch, BATCH, PEAK, law="falling", epoch=per_epoch, **SGD)
    rates = {"optical": BASE_RATE, "geometric": BASE_RATE, "autoencoder": scaled_rate(4.5e-6, DENOISER_BATCH)}
    if part not in rates:
        raise ValueError(f"the paper trains no {part!r}; choose region, {', '.join(rates)}")
    per_epoch = steps_of_an_epoch(scenes, DENOISER_BATCH)
    how = {"warmup": 0, "law": "constant", "epoch": per_epoch, "clip": 0.0, "decay": 0.9999}
    return Recipe(epochs * per_epoch, DENOISER_BATCH, rates[part], **how)


def train_region(
    model: nn.Module,
    scenes: Scenes,
    epochs: int = EPOCHS,
    batch: int = BATCH,
    rate: Law = paper_learning_rate,
    class_weights: tuple[float, ...] = CLASS_WEIGHTS,
    seed: int = 0,
    validate: Callable[[], dict[str, float]] | None = None,
    size: tuple[int, int] | None = None,
) -> list[dict[str, float]]:
    """Train stage one in place, in epochs (Paper: Sec. V-B), by our loss: the paper names none.

    Args:
        model: a ``region.RegionNet``.
        scenes: to learn from; drawn with augmentation.
        epochs: passes over all scenes.
        batch: scenes a step.
        rate: law of the learning rate.
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
    per_epoch = steps_of_an_epoch(len(scenes), batch)
    recipe = Recipe(epochs * per_epoch, batch, PEAK, **SGD)
    size = scenes.depth.shape[1:] if size is None else size
    draw = partial(epoch_frames, Pool([scenes]), size, batch, seed, None)
    seen: list[dict[str, float]] = []
    rates: list[float] = []

    def law(step: int, _: Recipe) -> float:
        rates.append(rate(step // per_epoch, step, epochs))
        return rates[-1]

    notes = fit(
        "region",
        model,
        Step(draw, partial(score_epoch, model, class_weights)),
        recipe,
        None,
        validate,
        every=per_epoch,
        seed=seed,
        watch=lambda _, losses: seen.append(losses),
        rate=law,
    )
    model.eval()
    rows = []
    for epoch, last in enumerate(notes["curve"]):
        steps = seen[epoch * per_epoch : (epoch + 1) * per_epoch]
        means = {name: sum(s[name] for s in steps) / len(steps) for name in steps[0]}
        rows.append({"epoch": epoch} | last | means | {"rate": rates[(epoch + 1) * per_epoch - 1]})
    return rows


def score_epoch(model: nn.Module, class_weights: tuple[float, ...], drawn: Batch, step: int, share: Share) -> Losses:
    """Score what stage one says of frames."""
    weight = drawn.rgb.new_tensor(class_weights)
    return region_loss(model(drawn.rgb, drawn.depth_n, drawn.valid), drawn.material, weight)


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
