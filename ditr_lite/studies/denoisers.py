"""What would make the denoiser better: variants of the optical branch, each trained for the same processor time.

Paper: Sec. IV-C ("Denoising Step") and Eq. 8 to 10 fix what is predicted and where conditions enter; this asks what
other choices are worth. One thing is changed at a time. All variants see the same scenes and the same autoencoder.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .. import diffusion
from ..boundary import get_backend
from ..conditioning import CHANNELS, fill
from ..config import Config, override
from ..evaluation.statistics import bootstrap_mean, format_interval, paired_bootstrap
from ..files import read_json, write_json
from ..schedule import make_schedule
from ..stage_two import Painter, Views, encode_picture, paint
from ..training import recipes
from ..training.batches import Batch
from ..training.loop import Losses, Recipe, Share, Step, fit
from ..training.parts import held_out_batches, root_mean_square
from ..training.scenes import Pool, Scenes, checksum, first
from ..unet import DenoisingUNet

ROUNDS = 7  # in which a step is timed; the median counts
TIMED_SCENES = 16
ASKED = ((1, 1), (1, 8), (5, 1))  # steps and samples with which every variant is asked
DECODED = 5.0  # weight of the relative error of decoded depth beside the latent loss


@dataclass(frozen=True)
class DenoiserVariant:
    """One change.

    Attributes:
        says: what, in words.
        settings: of the configuration, see ``config.override``.
        decoded: whether the loss looks at decoded depth, too.
        decay: of the moving average of the weights; 0 for none.
    """

    says: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    decoded: bool = False
    decay: float = 0.995


NOT_ANCHORED = {"unet.anchor": False}
DENOISERS = {
    "default": DenoiserVariant("predicts what to add to the encoded known depth; loss on latents"),
    "x0": DenoiserVariant("predicts the clean latents themselves (Eq. 9)", NOT_ANCHORED),
    "v": DenoiserVariant("predicts v", {**NOT_ANCHORED, "sampler.prediction": "v"}),
    "eps": DenoiserVariant("predicts the noise", {**NOT_ANCHORED, "sampler.prediction": "eps"}),
    "decoded depth": DenoiserVariant("the loss looks at decoded depth, too", decoded=True),
    "concatenation": DenoiserVariant("no attention: conditions are only concatenated", {"unet.attention_levels": ()}),
    "latent asks": DenoiserVariant("in cross-attention the latents ask the picture", {"unet.query": "latent"}),
    "wider": DenoiserVariant("half as many channels again", {"unet.width": 24}),
    "shallower": DenoiserVariant(
        "three levels instead of four", {"unet.multipliers": (1, 2, 4), "unet.attention_levels": (2,)}
    ),
    "no average": DenoiserVariant("the last weights instead of their moving average", decay=0.0),
}


def train_denoiser(
    name: str,
    minutes: float,
    pool: Pool,
    given: Mapping[str, nn.Module],
    config: Config,
    work: Path | str,
    batch: int = 4,
    seed: int = 0,
) -> tuple[Painter, Config, dict[str, Any]]:
    """Train one variant for a given processor time; a stopped run goes on.

    Args:
        name: of :data:`DENOISERS`.
        minutes: of processor time.
        pool: of scenes.
        given: trained ``autoencoder`` and, if the sizes ask for one, ``encoder``.
        config: that the variant changes.
        work: for checkpoints and measured times.
        batch: views a step.
        seed: of everything random.

    Returns:
        the painter, its configuration, and notes: steps, seconds a step, parameters.

    Raises:
        ValueError: for an unknown variant or a time that is not positive.
    """
    if name not in DENOISERS:
        raise ValueError(f"unknown variant {name!r}; choose one of {', '.join(DENOISERS)}")
    if not minutes > 0:
        raise ValueError(f"expected a positive number of minutes, got {minutes}")
    variant = DENOISERS[name]
    config = override(config, **variant.settings)
    torch.manual_seed(seed)
    net = DenoisingUNet(config.unet, config.autoencoder.latent_channels, len(CHANNELS))
    net = net.to(memory_format=torch.channels_last)
    painter = Painter(net, given["autoencoder"], given.get("encoder"), None, config.evidence)
    recipe = Recipe(steps=1, batch=batch, lr=1e-3, decay=variant.decay)
    tag = name.replace(" ", "_")
    file = Path(work) / f"{tag}.seconds.json"
    if not file.is_file():  # kept, so that a resumed run ends where it should
        few = Pool([first(group, TIMED_SCENES) for group in pool.groups])
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, {"seconds": time_step(variant_step(variant, painter, few, config, recipe, seed), net)})
    seconds = read_json(file)["seconds"]
    steps = max(1, round(60 * minutes / seconds))
    recipe = replace(recipe, steps=steps, warmup=max(1, min(recipe.warmup, steps // 10)))
    step = variant_step(variant, painter, pool, config, recipe, seed)
    fit(tag, net, step, recipe, work, every=100, seed=seed, key=f"{name} {checksum(*pool.groups)}")
    net.eval().requires_grad_(False)
    notes = {
        "steps": steps,
        "seconds_a_step": round(seconds, 4),
        "parameters": sum(p.numel() for p in net.parameters()),
    }
    return painter, config, notes


def variant_step(
    variant: DenoiserVariant, painter: Painter, pool: Pool, config: Config, recipe: Recipe, seed: int
) -> Step:
    """Return the training step of a variant: the optical branch's, and if so asked with decoded depth."""
    usual = recipes.branch_step("optical", painter, pool, config, recipe, get_backend("classical"), seed)
    if not variant.decoded:
        return usual
    return replace(usual, score=partial(score_decoded, painter, config))


def score_decoded(painter: Painter, config: Config, drawn: tuple[Batch, bool], step: int, share: Share) -> Losses:
    """Score a denoiser by its latents and by the depth that they decode to, where must be painted."""
    batch, evidence = drawn
    (image, filled, known), where = recipes.branch_inputs("optical", batch, config, evidence=evidence)
    schedule, prediction = make_schedule(config.schedule), config.sampler.prediction
    with torch.no_grad():
        masked = painter.autoencoder.encode(recipes.cl(filled))
        x0 = painter.autoencoder.encode(recipes.cl(fill(batch.gt_n, batch.gt_known)))
    t = torch.randint(0, schedule.timesteps, (len(x0),))
    t[: len(x0) // 2] = schedule.timesteps - 1
    eps = torch.randn_like(x0)
    x_t = diffusion.q_sample(x0, t, eps, schedule)
    out = painter.net(x_t, t, encode_picture(painter, image, batch.rgb), masked, known)
    mask = nn.functional.avg_pool2d(where * batch.gt_known, 4) + 0.05
    latent = diffusion.loss(out, x0, eps, t, schedule, prediction, mask=mask)
    decoded = painter.autoencoder.decode(diffusion.to_x0(out, x_t, t, schedule, prediction), quantize=False)
    weight = where * batch.gt_known
    depth = (batch.relative_error(decoded).abs() * weight).sum() / weight.sum().clamp(min=1)
    return {"total": latent + DECODED * depth, "latent": latent, "depth": depth}


def time_step(step: Step, net: nn.Module, rounds: int = ROUNDS) -> float:
    """Return the median processor time of a training step in seconds; the weights stay as they are."""
    optimiser, took = torch.optim.AdamW(net.parameters(), lr=0.0, weight_decay=0.0), []
    for k in range(rounds):
        start = time.process_time()
        optimiser.zero_grad(set_to_none=True)
        step(k)["total"].backward()
        optimiser.step()
        took.append(time.process_time() - start)
    optimiser.zero_grad(set_to_none=True)
    return sorted(took)[rounds // 2]


@torch.no_grad()
def denoiser_errors(painter: Painter, config: Config, scenes: Scenes, steps: int, samples: int) -> np.ndarray:
    """Return, per scene with a region, the relative RMSE in its windows, of the mean of the draws.

    Args:
        painter: trained.
        config: of net and schedule.
        scenes: held out.
        steps: of the sampler.
        samples: draws whose mean counts.
    """
    schedule, errors = make_schedule(config.schedule), []
    for batch in held_out_batches("optical", scenes, config):
        views = Views(batch.rgb, batch.depth_n, batch.valid, batch.region, batch.guide_da, batch.guide_rgb)
        generator = torch.Generator().manual_seed(0)
        drawn = paint(painter, views, schedule, steps, samples, config.sampler.prediction, generator)
        error: Tensor = batch.relative_error(drawn.mean(dim=0))
        errors += root_mean_square(error, batch.region * batch.gt_known)
    return np.array([e for e in errors if np.isfinite(e)])


def summarise_denoisers(errors: Mapping[str, Mapping[str, Sequence[float]]]) -> dict[str, Any]:
    """Return variant -> how it was asked -> ``error``, ``minus_default``: [mean, low, high] each, paired by scene."""
    out: dict[str, Any] = {}
    for name, by_way in errors.items():
        out[name] = {}
        for way, values in by_way.items():
            minus = paired_bootstrap(values, errors["default"][way])
            out[name][way] = {"error": bootstrap_mean(values), "minus_default": minus}
    return out


def way_of(steps: int, samples: int) -> str:
    """Return how a variant was asked, in words."""
    return f"{steps} step{'s' * (steps > 1)}, {samples} sample{'s' * (samples > 1)}"


def format_denoisers(report: Mapping[str, Any]) -> str:
    """Return the table: relative RMSE in % of the distance, and the paired difference with one step and one sample."""
    ways = [way_of(*asked) for asked in ASKED]
    lines = ["% of the distance".ljust(16) + "".join(w.rjust(20) for w in ways) + "   minus the default"]
    for name, row in report["summary"].items():
        cells = "".join(f"{100 * row[w]['error'][0]:20.2f}" for w in ways)
        gap = format_interval(row[ways[0]]["minus_default"], 100, "+.2f")
        lines.append(f"{name.ljust(16)}{cells}   {gap}  {DENOISERS[name].says}")
    return "\n".join(lines)
