"""Arms as systems: whatever paints, it is called as DITR is, on the same windows, frames and bounds.

A peer inherits all that surrounds the painting from :class:`pipeline.Ditr`: the working size, what is hidden as stray,
the windows around the region, the bounds of each view, the level of a hole's rim, the composition.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from ..conditioning import CHANNELS, Bounds
from ..config import Config, from_dict
from ..pipeline import Ditr, build
from ..stage_two import BRANCHES, Plan, Views, colour_features
from ..store import load_part, read_card
from ..unet import DenoisingUNet
from ..units import MIN_DEPTH_M
from .ideas import IDEAS, Idea, RgbOnly, build_idea

GIVEN = ("autoencoder", "encoder")  # what every arm is handed
OWN = (*BRANCHES, "detail")  # DITR's own networks
SINGLE = ("bb", "single_latent_diffusion")  # one denoiser in the place of two branches
ALIGNED = "rgb_only_aligned"  # another reading of rgb_only's weights
PEERS = (*IDEAS, ALIGNED, "single_latent_diffusion")


class PeerSystem(Ditr):
    """An idea in the place of both branches. The region must be given: stage one is none of its networks."""

    def __init__(self, idea: Idea, encoder: nn.Module | None, config: Config):
        parts = {"idea": idea} if encoder is None else {"idea": idea, "encoder": encoder}
        super().__init__(nn.ModuleDict(parts), config)

    def paint(
        self, target: int, views: Views, bounds: Bounds, steps: int, samples: int, seed: int, plan: Plan
    ) -> tuple[np.ndarray, np.ndarray]:
        """Paint views: metres and their spread, which is 0, (B, h, w) each."""
        colour = colour_features(self.parts["encoder"] if "encoder" in self.parts else None, views.rgb)
        metres = self.parts["idea"].metres(views, colour, bounds)
        metres = metres.float().clamp(min=MIN_DEPTH_M)[:, 0].numpy()  # an idea may say anything
        return metres, np.zeros_like(metres)


class SingleSystem(Ditr):
    """One latent denoiser for everything. It is told of no region: every reading counts as known."""

    def paint(
        self, target: int, views: Views, bounds: Bounds, steps: int, samples: int, seed: int, plan: Plan
    ) -> tuple[np.ndarray, np.ndarray]:
        """Paint views with the one denoiser: mean and spread, (B, h, w) metres each."""
        views = replace(views, region=torch.zeros_like(views.region))
        plan = replace(plan, painters=("geometric", "geometric"), evidence=False, detail=False)
        return super().paint(target, views, bounds, steps, samples, seed, plan)


def build_network(name: str, config: Config) -> nn.Module:
    """Return the untrained network of an arm: a branch, the finer final step, a single denoiser or an idea.

    Raises:
        ValueError: for an unknown name.
    """
    if name in OWN:
        return build(config)[name]
    if name in SINGLE:
        return DenoisingUNet(config.unet, config.autoencoder.latent_channels, len(CHANNELS))
    return build_idea(name, config)


def load_arm(folder: Path | str, arm: str, seed: int = 0) -> Ditr:
    """Return a trained arm as a system that is called with a region.

    Args:
        folder: weights folder that ``tools/train_peers.py`` wrote; it holds what the arms were given, too.
        arm: "ditr", "dp", "bb", or a peer.
        seed: that it was trained with.

    Raises:
        ValueError: when the arm has not been trained.
    """
    config = from_dict(read_card(folder)["config"])
    if arm == "dp":
        config = replace(config, detail=replace(config.detail, width=0))
    if arm in ("dp", "ditr", *SINGLE):
        return _latent_arm(Path(folder), arm, seed, config)
    name = "rgb_only" if arm == ALIGNED else arm
    idea = build_idea(name, config)
    idea.load_state_dict(load_part(f"{name}-{seed}", folder))
    if isinstance(idea, RgbOnly):
        idea.aligned = arm == ALIGNED
    return PeerSystem(idea, given(folder, config).get("encoder"), config)


def _latent_arm(folder: Path, arm: str, seed: int, config: Config) -> Ditr:
    parts = nn.ModuleDict(given(folder, config))
    if arm in SINGLE:
        parts["geometric"] = build_network(arm, config)
        parts["geometric"].load_state_dict(load_part(f"{arm}-{seed}", folder))
        return SingleSystem(parts, config)
    for name in OWN if config.detail.width else BRANCHES:
        parts[name] = build_network(name, config)
        parts[name].load_state_dict(load_part(f"{arm}_{name}-{seed}", folder))
    return Ditr(parts, config)


def given(folder: Path | str, config: Config) -> dict[str, nn.Module]:
    """Return the autoencoder, and the colour encoder if the sizes ask for one, of a weights folder; frozen.

    Raises:
        ValueError: when one of them is missing.
    """
    parts = build(config)
    found = {name: parts[name] for name in GIVEN if name in parts}
    for name, module in found.items():
        module.load_state_dict(load_part(name, folder))
        module.eval().requires_grad_(False)
    return found


def trained(folder: Path | str) -> dict[str, tuple[int, ...]]:
    """Return arm -> seeds that are complete in a folder of ``tools/train_peers.py``.

    Raises:
        ValueError: when there is no such folder.
    """
    parts = read_card(folder)["parts"]
    networks = {"ditr": [f"ditr_{name}" for name in OWN], "dp": [f"dp_{name}" for name in BRANCHES]}
    networks |= {name: [name] for name in ("bb", *PEERS)} | {ALIGNED: ["rgb_only"]}
    found = {}
    for arm, names in networks.items():
        seeds = {part["seed"] for part in parts.values() if "seed" in part and "arm" in part}
        complete = tuple(s for s in sorted(seeds) if all(f"{name}-{s}" in parts for name in names))
        if complete:
            found[arm] = complete
    return found
