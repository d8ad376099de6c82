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
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .. import diffusion
from ..autoencoder import VQAutoencoder
from ..config import Config, preset
from ..files import write_json
from ..pipeline import build
from ..schedule import make_schedule
from ..store import WEIGHTS, load_part, save_part
from ..training import recipes
from ..training.batches import Batch, Scenes, checksum, draw, first, load_scenes
from ..training.loop import Recipe, fit
from . import networks

ARMS = {
    **{name: {name: 1.0} for name in networks.NAMES},
    "dp": {"optical": 0.5, "geometric": 0.5},
    "ditr": {"optical": 0.42, "geometric": 0.25, "detail": 0.33},
}
RECIPE = Recipe(steps=1, batch=8, lr=1e-3)  # the steps follow from the time
OWN = ("optical", "geometric", "detail")  # DITR's own networks
TIMED_SCENES = 16  # are enough to time a step on
Times = dict[str, float]
EDGE = 0.02  # a step of log depth between neighbours, 2 % of the depth, is an occlusion boundary


def train_arm(
    arm: str,
    minutes: float,
    seed: int = 0,
    data: Path | str = "outputs/scenes/train",
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
        data: folder of rendered scenes.
        out: weights folder of the peers.
        work: for checkpoints.
        limit: use only the first scenes.
        config: sizes; the lite preset by default.
        weights: folder that holds the autoencoder.

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
    Path(work).mkdir(parents=True, exist_ok=True)
    scenes = load_scenes(data, limit, "classical", Path(work) / "maps.npz")
    parts = build(config)
    parts["autoencoder"].load_state_dict(load_part("autoencoder", weights))
    parts["autoencoder"].eval().requires_grad_(False)
    times = step_times(Path(out) / "times.json", first(scenes, TIMED_SCENES), config, parts["autoencoder"])
    entries = {}
    for name, share in ARMS[arm].items():
        torch.manual_seed(seed)
        net = parts[name] if name in parts else networks.build_peer(name, config)
        net = net.to(memory_format=torch.channels_last)
        tag = name if arm in networks.NAMES else f"{arm}_{name}"
        # data for the detail network is painted by the branches that this arm has just trained
        for other in ("optical", "geometric") if name == "detail" else ():
            parts[other].eval().requires_grad_(False)
        step = _step_loss(name, net, parts, scenes, config, seed)
        recipe = replace(RECIPE, steps=max(1, round(60 * minutes * share / times[name])))
        notes = fit(f"{tag}-{seed}", net, step, recipe, work, seed=seed, key=checksum(scenes))
        notes |= {"arm": arm, "minutes": minutes * share, "seed": seed, "scenes": len(scenes), "recipe": vars(recipe)}
        notes |= {"threads": torch.get_num_threads()}
        save_part(f"{tag}-{seed}", net.state_dict(), config, out, notes)
        entries[tag] = notes
    return entries


def step_times(file: Path, scenes: Scenes, config: Config, autoencoder: VQAutoencoder, rounds: int = 8) -> Times:
    """Return network -> seconds of processor time that a training step takes here.

    Measured once, all networks in turn, so that a slow moment of the machine falls on all alike and a resumed run ends
    where it should.

    Args:
        file: where the times are kept.
        scenes: a few.
        config: sizes.
        autoencoder: trained or not.
        rounds: over all networks; the median counts.
    """
    if not file.is_file():
        parts = build(config)
        parts["autoencoder"] = autoencoder
        nets = {name: networks.build_peer(name, config) for name in networks.NAMES}
        nets |= {name: net for name, net in parts.items() if name in OWN}
        losses = {name: _step_loss(name, net, parts, scenes, config, 0) for name, net in nets.items()}
        took: dict[str, list[float]] = {name: [] for name in nets}
        for k in range(rounds):
            for name, loss in losses.items():
                nets[name].requires_grad_(True).to(memory_format=torch.channels_last)
                start = time.process_time()
                loss(k)["total"].backward()
                took[name].append(time.process_time() - start)
        write_json(file, {name: sorted(seconds)[rounds // 2] for name, seconds in took.items()})
    return json.loads(file.read_text())


def _step_loss(name: str, net: nn.Module, parts: nn.ModuleDict, scenes: Scenes, config: Config, seed: int):
    if name in ("optical", "geometric"):
        return recipes.branch_step(name, net, parts["autoencoder"], scenes, config, RECIPE, seed)
    if name == "detail":
        return recipes.detail_step(net, recipes.paint_all(parts, scenes, config, seed), RECIPE, len(scenes), seed)
    if name == "single_latent_diffusion":
        return single_step(net, parts["autoencoder"], scenes, config, seed)
    return peer_step(name, net, scenes, seed)


def peer_step(name: str, net: nn.Module, scenes: Scenes, seed: int = 0) -> Callable[[int], dict[str, Tensor]]:
    """Return the step loss of a peer at pixel size."""

    def step_loss(step: int) -> dict[str, Tensor]:
        rng = recipes.rng_of(seed, step)
        batch = draw(scenes, rng.integers(0, len(scenes), RECIPE.batch), rng)
        image = networks.network_input(name, batch.rgb, batch.depth_n, batch.valid)
        out = net(image.contiguous(memory_format=torch.channels_last))
        if name == "normals_optimisation":
            return orientation_loss(out, batch, scenes)
        if name == "rgb_only":
            error = networks.TYPICAL_M * out.exp() - true_metres(batch, scenes)
        else:
            depth = networks.predicted_depth(name, out, batch.depth_n, batch.valid)
            error = (depth - batch.gt_n) * batch.scale_m
        return depth_loss(error, batch)

    return step_loss


def depth_loss(error_m: Tensor, batch: Batch) -> dict[str, Tensor]:
    """Score metric errors as the detail network's recipe does: L1 and RMS of region, holes and whole frame alike."""
    region = (batch.material > 0)[:, None].float()
    losses = {}
    sets = {"optical": region, "geometric": (1 - region) * (1 - batch.valid), "whole": torch.ones_like(region)}
    for name, where in sets.items():
        weight = where * batch.gt_known
        share = weight.sum(dim=(1, 2, 3)).clamp(min=1)
        losses[f"{name}_l1"] = ((error_m.abs() * weight).sum(dim=(1, 2, 3)) / share).mean()
        losses[f"{name}_rms"] = ((error_m.square() * weight).sum(dim=(1, 2, 3)) / share + 1e-8).sqrt().mean()
    return {"total": 10 * sum(losses.values()), **losses}


def true_metres(batch: Batch, scenes: Scenes) -> Tensor:
    """Return ground truth (B, 1, H, W) in metres, 0 where unknown, mirrored where the frame is."""
    truth = torch.from_numpy(scenes.depth_gt[batch.index].astype("float32") / 1000)[:, None]
    return torch.where(torch.from_numpy(batch.flipped).view(-1, 1, 1, 1), truth.flip(3), truth)


def orientation_loss(out: Tensor, batch: Batch, scenes: Scenes) -> dict[str, Tensor]:
    """Score predicted gradients of log depth (L1, off edges) and edges (cross-entropy)."""
    truth = true_metres(batch, scenes).clamp(min=0.05).log()
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


def single_step(
    net: nn.Module, autoencoder: VQAutoencoder, scenes: Scenes, config: Config, seed: int = 0
) -> Callable[[int], dict[str, Tensor]]:
    """Return the step loss of the single denoiser: a branch's (Paper: Eq. 8), every cell counting alike."""
    schedule, targets = make_schedule(config.schedule), recipes.encode_targets(autoencoder, scenes)

    def step_loss(step: int) -> dict[str, Tensor]:
        rng = recipes.rng_of(seed, step)
        batch = draw(scenes, rng.integers(0, len(scenes), RECIPE.batch), rng)
        image, filled, known = networks.single_latent_input(batch.rgb, batch.depth_n, batch.valid, batch.guide_rgb)
        with torch.no_grad():
            masked = autoencoder.encode(filled)
        x0 = targets[batch.index, batch.flipped.astype(int)].float()
        t = torch.randint(0, schedule.timesteps, (len(x0),))
        t[: len(x0) // 3] = schedule.timesteps - 1  # as for the branches
        eps = torch.randn_like(x0)
        features = net.features(image.contiguous(memory_format=torch.channels_last))
        out = net(diffusion.q_sample(x0, t, eps, schedule), t, features, masked, known)
        mask = F.avg_pool2d(batch.gt_known, 4)
        return {"total": diffusion.loss(out, x0, eps, t, schedule, config.sampler.prediction, mask=mask)}

    return step_loss
