"""Train DITR's peers, and the arms of its ablation, for a given time on a given number of scenes.

Equal time is the condition of the comparison: M minutes of one core for the training steps of each arm (loading and
rendering are not counted). So the number of steps follows from the processor time that one takes. All arms see the same
scenes with the same augmentation and are handed the shipped autoencoder. An arm of several networks shares the minutes
out:

==========  ==================================================================================================
arm         networks and their share of the time
==========  ==================================================================================================
a peer      itself, all of it
dp          "+DP" of Table IV: the optical and the geometric branch, one half each
ditr        the whole recipe: optical, geometric and the detail network
==========  ==================================================================================================
"""

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..boundary import Backend, get_backend
from ..conditioning import condition
from ..config import Config, preset
from ..files import write_json
from ..pipeline import build
from ..schedule import make_schedule
from ..stage_two import BRANCHES, Painter
from ..store import WEIGHTS, load_part, save_part
from ..training import recipes
from ..training.batches import Batch, draw_frames
from ..training.loop import Losses, Recipe, Share, Step, fit
from ..training.parts import painter_of
from ..training.scenes import Pool, checksum, first, load_scenes
from . import networks

ARMS = {
    **{name: {name: 1.0} for name in networks.NAMES},
    "dp": {"optical": 0.5, "geometric": 0.5},
    "ditr": {"optical": 0.42, "geometric": 0.25, "detail": 0.33},
}
RECIPE = Recipe(steps=1, batch=8, lr=1e-3)  # the steps follow from the time
OWN = (*BRANCHES, "detail")  # DITR's own networks
GIVEN = ("autoencoder", "encoder")  # what every arm is handed
TIMED_SCENES = 16  # are enough to time a step on
Times = dict[str, float]
EDGE = 0.02  # a step of log depth between neighbours, 2 % of the depth, is an occlusion boundary


def train_peers(
    arm: str,
    minutes: float,
    seed: int = 0,
    data: Path | str | Sequence[Path | str] = ("outputs/scenes/train", "outputs/scenes/rooms_train"),
    out: Path | str = "outputs/peers",
    work: Path | str = "outputs/training/peers",
    limit: int | None = 600,
    config: Config | None = None,
    weights: Path | str = WEIGHTS,
) -> dict[str, Any]:
    """Train all networks of an arm and write each as ``out/NAME-SEED.safetensors``; a stopped run goes on.

    Args:
        arm: one of :data:`ARMS`.
        minutes: of processor time for training steps.
        seed: of everything random.
        data: folder of rendered scenes, or several, drawn from by their number of scenes.
        out: weights folder of the peers.
        work: for checkpoints.
        limit: use only the first scenes of each folder.
        config: sizes; the lite preset by default.
        weights: folder that holds the autoencoder, and the colour encoder if the sizes ask for one.

    Returns:
        network -> its entry in the card.

    Raises:
        ValueError: for an unknown arm, a time that is not positive, no scenes, or no autoencoder.
    """
    if arm not in ARMS:
        raise ValueError(f"unknown arm {arm!r}; choose one of {', '.join(ARMS)}")
    if not minutes > 0:
        raise ValueError(f"expected a positive number of minutes, got {minutes}")
    config = config or preset("lite")
    folders = [data] if isinstance(data, str | Path) else data
    scenes = [load_scenes(folder, limit) for folder in folders]
    parts = build(config)
    for name in GIVEN:
        if name in parts:
            parts[name].load_state_dict(load_part(name, weights))
            parts[name].eval().requires_grad_(False)
    few = Pool([first(group, TIMED_SCENES) for group in scenes])
    times = step_times(Path(out) / "times.json", few, config, parts)
    entries = {}
    for name, share in ARMS[arm].items():
        torch.manual_seed(seed)
        net = parts[name] if name in parts else networks.build_peer(name, config)
        net = net.to(memory_format=torch.channels_last)
        tag = name if arm in networks.NAMES else f"{arm}_{name}"
        if name == "detail":  # it learns from what the branches paint that this arm has just trained
            for branch in BRANCHES:
                parts[branch].eval().requires_grad_(False)
        step = _step_loss(name, net, parts, Pool(scenes), config, seed)
        recipe = replace(RECIPE, steps=max(1, round(60 * minutes * share / times[name])))
        notes = fit(f"{tag}-{seed}", net, step, recipe, work, seed=seed, key=checksum(*scenes))
        notes |= {"arm": arm, "minutes": minutes * share, "seed": seed, "recipe": vars(recipe)}
        notes |= {"scenes": sum(len(group) for group in scenes), "threads": torch.get_num_threads()}
        save_part(f"{tag}-{seed}", net.state_dict(), config, out, notes)
        entries[tag] = notes
    return entries


def step_times(file: Path, pool: Pool, config: Config, given: nn.ModuleDict, rounds: int = 8) -> Times:
    """Return network -> seconds of processor time that a training step takes here.

    Measured once, all networks in turn, so that a slow moment of the machine falls on all alike and a resumed run ends
    where it should.

    Args:
        file: where the times are kept.
        pool: of a few scenes.
        config: sizes.
        given: autoencoder and colour encoder, trained or not.
        rounds: over all networks; the median counts.
    """
    if not file.is_file():
        parts = build(config)
        for name in GIVEN:
            if name in given:
                parts[name] = given[name]
        nets = {name: networks.build_peer(name, config) for name in networks.NAMES}
        nets |= {name: net for name, net in parts.items() if name in OWN}
        losses = {name: _step_loss(name, net, parts, pool, config, 0) for name, net in nets.items()}
        took: dict[str, list[float]] = {name: [] for name in nets}
        for k in range(rounds):
            for name, loss in losses.items():
                nets[name].requires_grad_(True).to(memory_format=torch.channels_last)
                start = time.process_time()
                loss(k)["total"].backward()
                took[name].append(time.process_time() - start)
        write_json(file, {name: sorted(seconds)[rounds // 2] for name, seconds in took.items()})
    return json.loads(file.read_text())


def _step_loss(name: str, net: nn.Module, parts: nn.ModuleDict, pool: Pool, config: Config, seed: int):
    backend = get_backend("classical")
    painters = {branch: painter_of(branch, parts, config) for branch in BRANCHES}
    if name in BRANCHES:
        return recipes.branch_step(name, painters[name], pool, config, RECIPE, backend, seed)
    if name == "detail":
        return recipes.detail_step(net, painters, pool, config, RECIPE, backend, seed)
    if name == "single_latent_diffusion":
        single = replace(painters["geometric"], net=net)
        return single_step(single, pool, config, seed)
    return peer_step(name, net, pool, config, seed)


def peer_step(name: str, net: nn.Module, pool: Pool, config: Config, seed: int = 0) -> Step:
    """Return the step of a peer at pixel size."""
    return Step(partial(draw_whole, pool, config, None, seed), partial(score_peer, name, net))


def draw_whole(pool: Pool, config: Config, backend: Backend | None, seed: int, step: int, share: Share) -> Batch:
    """Draw whole frames."""
    return draw_frames(pool, RECIPE.batch, config.size, recipes.rng_of(seed, step), backend, share=share)


def score_peer(name: str, net: nn.Module, batch: Batch, step: int, share: Share) -> Losses:
    """Score what a peer makes of frames."""
    out = net(recipes.cl(networks.network_input(name, batch.rgb, batch.depth_n, batch.valid)))
    if name == "normals_optimisation":
        return orientation_loss(out, batch)
    if name == "rgb_only":
        return depth_loss(batch.relative_error_m(networks.TYPICAL_M * out.exp()), batch)
    depth_n = networks.predicted_depth(name, out, batch.depth_n, batch.valid)
    return depth_loss(batch.relative_error(depth_n), batch)


def depth_loss(error: Tensor, batch: Batch) -> dict[str, Tensor]:
    """Score relative errors (B, 1, H, W) as the detail network's recipe does: L1 and RMS, each pixel set alike."""
    holes = (1 - batch.region) * (1 - batch.valid)
    sets = {"optical": batch.region, "geometric": holes, "whole": torch.ones_like(holes)}
    losses = {}
    for name, where in sets.items():
        weight = where * batch.gt_known
        share = weight.sum(dim=(1, 2, 3)).clamp(min=1)
        losses[f"{name}_l1"] = ((error.abs() * weight).sum(dim=(1, 2, 3)) / share).mean()
        losses[f"{name}_rms"] = ((error.square() * weight).sum(dim=(1, 2, 3)) / share + 1e-8).sqrt().mean()
    return {"total": 10 * sum(losses.values()), **losses}


def orientation_loss(out: Tensor, batch: Batch) -> dict[str, Tensor]:
    """Score predicted gradients of log depth (L1, off edges) and edges (cross-entropy)."""
    truth = batch.truth_m.clamp(min=0.05).log()
    known = batch.gt_known
    gx = F.pad(truth[..., 1:] - truth[..., :-1], (0, 1, 0, 0))
    gy = F.pad(truth[..., 1:, :] - truth[..., :-1, :], (0, 0, 0, 1))
    pairs = (known[..., 1:] * known[..., :-1], known[..., 1:, :] * known[..., :-1, :])
    both = F.pad(pairs[0], (0, 1, 0, 0)) * F.pad(pairs[1], (0, 0, 0, 1))
    gradients = torch.cat([gx, gy], dim=1)
    edge = (gradients.abs().amax(dim=1, keepdim=True) > EDGE).float()
    smooth = both * (1 - edge)
    l1 = ((out[:, :2] - gradients).abs() * smooth).sum() / smooth.sum().clamp(min=1)
    cross = F.binary_cross_entropy_with_logits(out[:, 2:], edge, weight=both)
    return {"total": 100 * l1 + cross, "gradient_l1": l1, "edge": cross}


def single_step(painter: Painter, pool: Pool, config: Config, seed: int = 0) -> Step:
    """Return the step of the single denoiser: a branch's (Paper: Eq. 8), every known cell counting alike."""
    draw = partial(draw_whole, pool, config, get_backend("classical"), seed)
    return Step(draw, partial(score_single, painter, config), recipes.frozen_of(painter))


def score_single(painter: Painter, config: Config, batch: Batch, step: int, share: Share) -> Losses:
    """Score what the single denoiser makes of frames."""
    views = networks.single_views(batch.rgb, batch.depth_n, batch.valid, batch.guide_rgb)
    given = condition(views.rgb, views.depth_n, views.valid, views.region, views.guide, evidence=False)
    mask = F.avg_pool2d(batch.gt_known, 4)
    schedule, prediction = make_schedule(config.schedule), config.sampler.prediction
    return {"total": recipes.denoising_loss(painter, batch, given, mask, schedule, prediction, share)}
