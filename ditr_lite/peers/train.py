"""Train DITR, its peers and the arms of its ablation for the same time on the same scenes.

Equal time is the condition of the comparison: M minutes of processor time for the training steps of each arm, drawing
of batches included. So the number of steps follows from the processor time that one takes; how busy the machine is does
not matter. All arms see the same scenes with the same augmentation and are handed the same autoencoder and encoder of
colour. An arm of several networks shares the minutes out:

=======================  ===========================================================================================
arm                      networks and their share of the time
=======================  ===========================================================================================
a peer                   itself, all of it; windows and whole frames in turn, as it must paint both
bb                       "BB" of Table IV: one denoiser, whole frames only
dp                       "+DP" of Table IV: the optical and the geometric branch, one half each
ditr                     the whole recipe: optical, geometric and the detail network
=======================  ===========================================================================================
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..boundary import Backend, get_backend
from ..conditioning import condition
from ..config import Config, override, preset
from ..data import Sample
from ..files import write_json
from ..metrics import rmse
from ..pipeline import build
from ..schedule import make_schedule
from ..stage_two import BRANCHES, Painter, Views, colour_features
from ..store import WEIGHTS, copy_part, read_card, save_part
from ..training import recipes
from ..training.batches import Batch
from ..training.loop import ROUNDS, Losses, Recipe, Share, Step, fit, time_steps
from ..training.parts import painter_of
from ..training.scenes import Pool, checkpoint_key, checksum, first, load_scenes
from . import system
from .ideas import IDEAS, Idea

ARMS = {
    "ditr": {"optical": 0.42, "geometric": 0.25, "detail": 0.33},
    "bb": {"bb": 1.0},
    "dp": {"optical": 0.5, "geometric": 0.5},
    **{name: {name: 1.0} for name in (*IDEAS, "single_latent_diffusion")},
}
TWICE = ("ditr", "bb", "dp")  # arms that are trained with two seeds, beside the best two peers
RECIPE = Recipe(steps=1, batch=4, lr=1e-3)  # the steps follow from the time
TIMED_SCENES = 16  # are enough to time a step on
EVERY = 100  # steps between checkpoints
Times = dict[str, float]


def peer_config() -> Config:
    """Return the sizes of the arms: the lite preset at half its working size, with a denoiser of the peers' size.

    A few minutes of one core are few steps at full size. One draw is painted, not the mean of several.
    """
    settings = {"size": (96, 128), "window": 96, "unet.width": 16, "sampler.samples": 1}
    return replace(override(preset("lite"), **settings), name="peers")


def train_peers(
    arm: str,
    minutes: float,
    seed: int,
    pool: Pool,
    out: Path | str,
    work: Path | str,
    config: Config | None = None,
    weights: Path | str = WEIGHTS,
) -> dict[str, Any]:
    """Train all networks of an arm and write each as ``out/NAME-SEED.safetensors``; a stopped run goes on.

    A network that is there already, of the same scenes and time, is left as it is.

    Args:
        arm: one of :data:`ARMS`.
        minutes: of processor time for training steps.
        seed: of everything random.
        pool: of the scenes to train on.
        out: weights folder of the arms; what they are given is copied there first.
        work: for checkpoints.
        config: sizes; :func:`peer_config` by default.
        weights: folder that holds the autoencoder, and the colour encoder if the sizes ask for one.

    Returns:
        network -> its entry in the card.

    Raises:
        ValueError: for an unknown arm, a time that is not positive, no autoencoder, or a network that is there but of
            other scenes or another time.
    """
    if arm not in ARMS:
        raise ValueError(f"unknown arm {arm!r}; choose one of {', '.join(ARMS)}")
    if not minutes > 0:
        raise ValueError(f"expected a positive number of minutes, got {minutes}")
    config, out = config or peer_config(), Path(out)
    parts = build(config)
    for name in system.GIVEN:
        if name in parts:
            copy_part(name, weights, out)
            ours, theirs = (read_card(folder)["parts"][name]["sha256"] for folder in (out, weights))
            if ours != theirs:
                raise ValueError(f"{out} has the {name} of other weights than {weights}: choose another folder (--out)")
    for name, module in system.given(out, config).items():
        parts[name] = module
    few = Pool([first(group, TIMED_SCENES) for group in pool.groups])
    times = step_times(out / "times.json", few, config, parts)
    scenes = checksum(*pool.groups)
    entries = {}
    for name, share in ARMS[arm].items():
        tag = f"{arm}_{name}" if name in system.OWN else name
        own = {"arm": arm, "minutes": minutes * share, "seed": seed, "scenes_sha256": scenes}
        torch.manual_seed(seed)
        net = system.build_network(name, config).to(memory_format=torch.channels_last)
        there = read_card(out)["parts"].get(f"{tag}-{seed}")
        if there is None:
            steps = max(1, round(60 * minutes * share / times[name]))
            recipe = replace(RECIPE, steps=steps, warmup=max(1, min(RECIPE.warmup, steps // 10)))
            loss = step_loss(name, net, parts, pool, config, seed)
            started = time.process_time()
            key = checkpoint_key(config, pool.groups, {given: parts[given] for given in system.GIVEN if given in parts})
            notes = fit(f"{tag}-{seed}", net, loss, recipe, work, every=EVERY, seed=seed, key=key)
            own |= {"recipe": vars(recipe), "cpu_seconds": round(time.process_time() - started, 1)}
            own |= {"scenes": len(pool), "parameters": sum(p.numel() for p in net.parameters())}
            save_part(f"{tag}-{seed}", net.state_dict(), config, out, notes | own)
        elif any(there.get(key) != value for key, value in own.items()):
            raise ValueError(f"{out} holds {tag}-{seed} of other scenes or another time: choose another folder (--out)")
        if name in BRANCHES:  # the detail network learns from what the branches paint that this arm has just trained
            net.load_state_dict(system.load_part(f"{tag}-{seed}", out))
            parts[name] = net.eval().requires_grad_(False)
        entries[tag] = read_card(out)["parts"][f"{tag}-{seed}"]
    return entries


def train_all(
    minutes: float,
    data: Sequence[Path | str],
    out: Path | str,
    work: Path | str,
    arms: Sequence[str] = tuple(ARMS),
    held_out: Callable[[], Sequence[Sample]] | None = None,
    limit: int | None = None,
    config: Config | None = None,
    weights: Path | str = WEIGHTS,
) -> None:
    """Train arms once, then those of :data:`TWICE` and the best two peers on held-out scenes with a second seed.

    Args:
        minutes: of processor time an arm.
        data: folders of rendered scenes, drawn from by their number of scenes.
        out: weights folder of the arms.
        work: for checkpoints.
        arms: of :data:`ARMS`.
        held_out: returns the scenes by which the best two peers are chosen; None leaves the second seeds out.
        limit: use only the first scenes of each folder.
        config: sizes; :func:`peer_config` by default.
        weights: folder that holds what the arms are given.

    Raises:
        ValueError: as :func:`train_peers`, and for a folder without scenes.
    """
    pool = Pool([load_scenes(folder, limit) for folder in data])
    for arm in arms:
        train_peers(arm, minutes, 0, pool, out, work, config, weights)
    if held_out is None:
        return
    file = Path(out) / "validation.json"
    if not file.is_file():
        frames = held_out()
        peers = [arm for arm in arms if arm in system.PEERS]
        write_json(file, {arm: validate(system.load_arm(out, arm), frames) for arm in peers})
    errors = json.loads(file.read_text(encoding="utf-8"))
    best = sorted(errors, key=errors.get)[:2]
    for arm in [arm for arm in arms if arm in (*TWICE, *best)]:
        train_peers(arm, minutes, 1, pool, out, work, config, weights)


def validate(ditr: system.Ditr, frames: Sequence[Sample]) -> float:
    """Return the mean optical RMSE in metres over frames, the true region being given."""
    errors = [rmse(ditr(s.rgb, s.depth, s.region).depth, s.depth_gt, s.region) for s in frames if s.region.any()]
    return float(sum(errors) / len(errors))


def step_times(file: Path, pool: Pool, config: Config, given: Mapping[str, nn.Module], rounds: int = ROUNDS) -> Times:
    """Return network -> seconds of processor time that a training step takes here.

    Measured once, so that a resumed run ends where it should; see ``training.loop.time_steps``.

    Args:
        file: where the times are kept.
        pool: of a few scenes.
        config: sizes.
        given: autoencoder and colour encoder, trained or not.
        rounds: over all networks; the median counts.
    """
    if not file.is_file():
        parts = build(config)
        for name in system.GIVEN:
            if name in given:
                parts[name] = given[name]
        nets = {name: parts[name] for name in system.OWN if name in parts}
        nets |= {name: system.build_network(name, config) for name in (*IDEAS, *system.SINGLE)}
        losses = {name: step_loss(name, net, parts, pool, config, 0) for name, net in nets.items()}
        for net in nets.values():
            net.to(memory_format=torch.channels_last)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, time_steps(nets, losses, rounds))
    return json.loads(file.read_text(encoding="utf-8"))


def step_loss(name: str, net: nn.Module, parts: nn.ModuleDict, pool: Pool, config: Config, seed: int):
    """Return the step loss of a network of an arm, by its name."""
    backend = get_backend("classical")
    painters = {branch: painter_of(branch, parts, config) for branch in BRANCHES}
    if name in BRANCHES:
        return recipes.branch_step(name, replace(painters[name], net=net), pool, config, RECIPE, backend, seed)
    if name == "detail":
        return recipes.detail_step(net, painters, pool, config, RECIPE, backend, seed)
    if name in system.SINGLE:
        single = replace(painters["geometric"], net=net)
        return single_step(single, pool, config, backend, seed, windows=name != "bb")
    encoder = parts["encoder"] if "encoder" in parts else None
    return idea_step(net, encoder, pool, config, backend, seed)


def idea_step(
    idea: Idea, encoder: nn.Module | None, pool: Pool, config: Config, backend: Backend, seed: int = 0
) -> Step:
    """Return the step of an idea: windows and whole frames in turn."""
    draw = partial(recipes.draw_in_turn, BRANCHES, pool, config, RECIPE, backend, seed)
    return Step(draw, partial(score_idea, idea, encoder), () if encoder is None else (encoder,))


def score_idea(idea: Idea, encoder: nn.Module | None, drawn: tuple[str, Batch], step: int, share: Share) -> Losses:
    """Score what an idea makes of a batch."""
    branch, batch = drawn
    views, paint = shown_views(branch, batch)
    with torch.no_grad():
        colour = colour_features(encoder, batch.rgb)
    return idea.losses(views, colour, batch, paint)


def shown_views(branch: str, batch: Batch) -> tuple[Views, Tensor]:
    """Return what painters are shown of a batch, and where they must paint, (B, 1, H, W) 0/1."""
    guide, paint = recipes.guide_and_paint(branch, batch)
    return Views(batch.rgb, batch.depth_n, batch.valid, batch.region, guide, batch.guide_rgb), paint


def single_step(
    painter: Painter, pool: Pool, config: Config, backend: Backend, seed: int = 0, windows: bool = True
) -> Step:
    """Return the step of the single denoiser: a branch's (Paper: Eq. 8), without a region.

    Args:
        painter: whose denoiser it is.
        pool: of scenes.
        config: sizes.
        backend: finds the guides.
        seed: of everything random.
        windows: every other batch shows windows; where False all are whole frames, every known cell counting alike.
    """
    turns = BRANCHES if windows else ("geometric",)
    draw = partial(recipes.draw_in_turn, turns, pool, config, RECIPE, backend, seed)
    return Step(draw, partial(score_single, painter, config, windows), recipes.frozen_of(painter))


def score_single(
    painter: Painter, config: Config, windows: bool, drawn: tuple[str, Batch], step: int, share: Share
) -> Losses:
    """Score what the single denoiser makes of a batch."""
    branch, batch = drawn
    views, paint = shown_views(branch, batch)
    nowhere = torch.zeros_like(batch.region)
    given = condition(views.rgb, views.depth_n, views.valid, nowhere, views.guide, evidence=False)
    where = paint if windows else torch.ones_like(paint)
    mask = F.avg_pool2d(where * batch.gt_known, 4) + (0.05 if windows else 0.0)
    schedule = make_schedule(config.schedule)
    return {"total": recipes.denoising_loss(painter, batch, given, mask, schedule, config.sampler, share)}
