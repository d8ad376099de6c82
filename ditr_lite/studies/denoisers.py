"""What would make the denoiser better: variants of the optical branch, each trained for the same processor time.

Paper: Sec. IV-C ("Denoising Step") and Eq. 8 and 9 fix what is predicted and where conditions enter; this asks what
other choices are worth. One thing is changed at a time. All variants see the same scenes and the same autoencoder.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..boundary import get_backend
from ..conditioning import CHANNELS
from ..config import Config, override
from ..evaluation.statistics import bootstrap_mean, format_interval, paired_bootstrap
from ..files import read_json, write_json
from ..schedule import make_schedule
from ..stage_two import Painter, Views, paint
from ..training import recipes
from ..training.loop import Recipe, Step, fit, time_steps
from ..training.parts import held_out_batches, root_mean_square
from ..training.scenes import Pool, Scenes, checkpoint_key, first
from ..unet import DenoisingUNet
from .denoiser_steps import OrientedUNet, score_decoded, score_oriented, score_student

TIMED_SCENES = 16
RECIPE = Recipe(steps=1, batch=4, lr=1e-3)  # the steps follow from the time
TEACHING = 0.5  # share of the time in which a teacher is trained, where there is one
ASKED = ((1, 1), (1, 8), (5, 1))  # steps and samples with which every variant is asked


@dataclass(frozen=True)
class DenoiserVariant:
    """One change.

    Attributes:
        says: what, in words.
        settings: of the configuration, see ``config.override``.
        decoded: what the loss looks at in decoded depth, one of ``denoiser_steps.DECODED``; "" for nothing.
        oriented: whether the network has a second output, the orientation of surfaces.
        taught: whether a teacher is trained first, in :data:`TEACHING` of the time, and the rest goes into learning in
            one step what it draws in several.
        decay: of the moving average of the weights; 0 for none.
    """

    says: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    decoded: str = ""
    oriented: bool = False
    taught: bool = False
    decay: float = RECIPE.decay


NOT_ANCHORED = {"unet.anchor": False}
DENOISERS = {
    "default": DenoiserVariant("predicts what to add to the encoded known depth; loss on latents"),
    "x0": DenoiserVariant("predicts the clean latents themselves (Eq. 9)", NOT_ANCHORED),
    "v": DenoiserVariant("predicts v", {**NOT_ANCHORED, "sampler.prediction": "v"}),
    "eps": DenoiserVariant("predicts the noise", {**NOT_ANCHORED, "sampler.prediction": "eps"}),
    "decoded depth": DenoiserVariant("the loss looks at decoded depth, too", decoded="depth"),
    "edges": DenoiserVariant("the same, and pixels at depth edges count more", decoded="edges"),
    "gradients": DenoiserVariant("the loss looks at gradients of decoded depth, too", decoded="gradients"),
    "orientation": DenoiserVariant("a second output, orientation and edges of surfaces, with its loss", oriented=True),
    "distilled": DenoiserVariant(
        "half of the time trains a teacher, half learns in one step the mean of what it draws in several", taught=True
    ),
    "concatenation": DenoiserVariant("no attention: conditions are only concatenated", {"unet.attention_levels": ()}),
    "latent asks": DenoiserVariant("in cross-attention the latents ask the picture", {"unet.query": "latent"}),
    "wider": DenoiserVariant("half as many channels again", {"unet.width": 24}),
    "shallower": DenoiserVariant(
        "three levels instead of four", {"unet.multipliers": (1, 2, 4), "unet.attention_levels": (2,)}
    ),
    "no average": DenoiserVariant(
        "the last weights instead of their moving average, which lags by a tenth of so short a run", decay=0.0
    ),
}


def train_denoiser(
    name: str,
    minutes: float,
    pool: Pool,
    given: Mapping[str, nn.Module],
    config: Config,
    work: Path | str,
    seed: int = 0,
) -> tuple[Painter, Config, dict[str, Any]]:
    """Train one variant for a given processor time; a stopped run goes on.

    Args:
        name: of :data:`DENOISERS`.
        minutes: of processor time, a teacher's included.
        pool: of scenes.
        given: trained ``autoencoder`` and, if the sizes ask for one, ``encoder``.
        config: that the variant changes.
        work: for checkpoints and measured times; one for each seed.
        seed: of everything random.

    Returns:
        the painter, its configuration, and notes: steps, seconds a step, parameters; of the teacher, too.

    Raises:
        ValueError: for an unknown variant or a time that is not positive.
    """
    if name not in DENOISERS:
        raise ValueError(f"unknown variant {name!r}; choose one of {', '.join(DENOISERS)}")
    if not minutes > 0:
        raise ValueError(f"expected a positive number of minutes, got {minutes}")
    seconds = variant_times(Path(work) / "times.json", pool, given, config)
    variant = DENOISERS[name]
    torch.manual_seed(seed)
    painter, own = build_denoiser(variant, given, config)
    notes, teacher = {}, None

    def train(called: str, change: DenoiserVariant, share: float) -> int:
        """Fit the network as ``change`` says for a share of the time, and return in how many steps."""
        steps = max(1, round(60 * minutes * share / seconds[called]))
        recipe = replace(RECIPE, steps=steps, decay=change.decay, warmup=max(1, min(RECIPE.warmup, steps // 10)))
        step = variant_step(change, painter, pool, own, seed, teacher)
        file, key = f"{name}-{called}".replace(" ", "_"), checkpoint_key(own, pool.groups, given)
        fit(file, painter.net, step, recipe, work, every=100, seed=seed, key=key)
        painter.net.eval()
        return steps

    if variant.taught:
        notes["teacher_steps"] = train("default", DENOISERS["default"], TEACHING)
        teacher = replace(painter, net=copy.deepcopy(painter.net))
    notes["steps"] = train(name, variant, 1 - TEACHING if variant.taught else 1.0)
    painter.net.requires_grad_(False)
    notes["seconds_a_step"] = round(seconds[name], 4)
    notes["parameters"] = sum(p.numel() for p in painter.net.parameters())
    return painter, own, notes


def build_denoiser(variant: DenoiserVariant, given: Mapping[str, nn.Module], config: Config) -> tuple[Painter, Config]:
    """Return an untrained variant and its configuration."""
    own = override(config, **variant.settings)
    if variant.oriented:
        net = OrientedUNet(own)
    else:
        net = DenoisingUNet(own.unet, own.autoencoder.latent_channels, len(CHANNELS))
    net = net.to(memory_format=torch.channels_last)
    return Painter(net, given["autoencoder"], given.get("encoder"), None, own.evidence), own


def variant_step(
    variant: DenoiserVariant, painter: Painter, pool: Pool, config: Config, seed: int, teacher: Painter | None = None
) -> Step:
    """Return the training step of a variant: the optical branch's, scored as the variant says."""
    usual = recipes.branch_step("optical", painter, pool, config, RECIPE, get_backend("classical"), seed)
    if variant.decoded:
        return replace(usual, score=partial(score_decoded, painter, config, variant.decoded))
    if variant.oriented:
        return replace(usual, score=partial(score_oriented, painter, config))
    if variant.taught:
        return replace(usual, score=partial(score_student, painter, config, teacher))
    return usual


def variant_times(file: Path, pool: Pool, given: Mapping[str, nn.Module], config: Config) -> dict[str, float]:
    """Return variant -> seconds of processor time that a training step takes here.

    Measured once, all variants in turn, so that a slow moment of the machine falls on all alike, and a resumed run
    ends where it should.

    Args:
        file: where the times are kept.
        pool: of scenes, of which few are enough.
        given: see :func:`train_denoiser`.
        config: that the variants change.
    """
    if not file.is_file():
        few = Pool([first(group, TIMED_SCENES) for group in pool.groups])
        nets, steps = {}, {}
        for name, variant in DENOISERS.items():
            painter, own = build_denoiser(variant, given, config)
            nets[name] = painter.net
            steps[name] = variant_step(variant, painter, few, own, 0, replace(painter, net=copy.deepcopy(painter.net)))
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, time_steps(nets, steps))
    return read_json(file)


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
    lines = [
        "% of the distance".ljust(16) + "".join(w.rjust(20) for w in ways) + "   minus the default, one step and sample"
    ]
    for name, row in report["summary"].items():
        cells = "".join(f"{100 * row[w]['error'][0]:20.2f}" for w in ways)
        gap = format_interval(row[ways[0]]["minus_default"], 100, "+.2f")
        lines.append(f"{name.ljust(16)}{cells}   {gap}  {DENOISERS[name].says}")
    return "\n".join(lines)
