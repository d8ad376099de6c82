"""Train the two networks of the ``learned`` boundary backend on the exact outlines of rendered scenes."""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ..boundary import boundaries_from_labels, depth_boundaries, precision_recall_f
from ..boundary.learned import begin_with_stage_one, build_nets, depth_input, thin
from ..conditioning import to_tensor
from ..config import from_dict, preset
from ..stage_two import cl
from ..store import CARD, load_part, read_card, save_part
from .augment import colours
from .loop import ENGINE, Engine, Losses, Recipe, Share, Step, fit, is_first, wait_for_all
from .recipes import rng_of
from .scenes import Scenes, checksum, load_scenes
from .views import lose

RECIPE = Recipe(steps=3000, batch=8, lr=3e-3, warmup=30, decay=0.99)
DEPTH_SHARE = 1 / 3  # of the steps, for the depth network: there is less to see in depth
VALIDATE = 24  # scenes on which the thresholds are chosen
CROP = (96, 128)  # pixels of a frame that a step looks at: outlines are everywhere, so many small views teach more
THRESHOLDS = (0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6)


def exact_outlines(scenes: Scenes) -> dict[str, np.ndarray]:
    """Return what each network should find, "rgb" and "depth", (N, H, W) bool each."""
    found = {"rgb": [], "depth": []}
    for instances, gt in zip(scenes.instances, scenes.depth_gt, strict=True):
        found["rgb"].append(boundaries_from_labels(instances))
        found["depth"].append(depth_boundaries(instances, gt.astype(np.float32) / 1000))
    return {mode: np.stack(maps) for mode, maps in found.items()}


def boundary_step(mode: str, model: nn.Module, scenes: Scenes, recipe: Recipe, seed: int = 0) -> Step:
    """Return the step of one network: cross-entropy of "a boundary lies within a pixel of here".

    That is what scoring at a tolerance of one pixel asks, and it does not punish a network for not knowing on which of
    two neighbouring pixels an edge lies. Depth is unknown where the truth is: nothing is asked there.
    """
    draw = partial(draw_outlines, mode, scenes, exact_outlines(scenes)[mode], recipe.batch, seed)
    return Step(draw, partial(score_crops, model))


def draw_outlines(
    mode: str, scenes: Scenes, outlines: np.ndarray, count: int, seed: int, step: int, share: Share
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a share of the crops of a step, stacked; see :func:`draw_crop`."""
    own = share.take(rng_of(seed, step).spawn(count))  # a generator for each crop: a share draws only its own crops
    crops = [draw_crop(mode, scenes, outlines, rng) for rng in own]
    x, boundary, known = (torch.cat(column) for column in zip(*crops, strict=True))
    return x, boundary, known


def score_crops(model: nn.Module, crops: tuple[Tensor, Tensor, Tensor], step: int, share: Share) -> Losses:
    """Score what a network says of crops."""
    x, boundary, known = crops
    near = F.max_pool2d(boundary, 3, 1, 1)  # within a pixel, diagonals too
    return {"total": F.binary_cross_entropy_with_logits(model(cl(x)), near, known)}


def draw_crop(
    mode: str, scenes: Scenes, outlines: np.ndarray, rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a crop of a random scene, now and then mirrored, its colours varied or readings lost.

    Args:
        mode: "rgb" or "depth".
        scenes: to draw from.
        outlines: (N, H, W) bool, the exact ones.
        rng: everything random comes from it.

    Returns:
        what the network is shown, (1, 3, h, w); the outlines in it and where the true depth is known, (1, 1, h, w) 0/1.
    """
    i = int(rng.integers(len(scenes)))
    top, left = (int(rng.integers(0, n - c + 1)) for n, c in zip(scenes.depth.shape[1:], CROP, strict=True))
    here = np.s_[..., top : top + CROP[0], left : left + CROP[1]]
    if mode == "rgb":  # colours are costly to vary: cut first
        x = to_tensor(colours(scenes.rgb[i][here[1:]], rng)[None])
    else:  # the units are those of the whole frame: cut last
        depth = scenes.depth[i].astype(np.float32) / 1000
        left_over = lose(depth, rng)
        x = depth_input(left_over if left_over.any() else depth)[here]
    truth = torch.from_numpy(outlines[i][here]).float()[None, None]
    known = torch.from_numpy(scenes.depth_gt[i][here] > 0).float()[None, None]
    if rng.random() < 0.5:
        return x.flip(3), truth.flip(3), known.flip(3)
    return x, truth, known


@torch.no_grad()
def probabilities(mode: str, model: nn.Module, scenes: Scenes) -> list[np.ndarray]:
    """Return what a network says of each scene, (H, W) float32."""
    found = []
    for rgb, depth in zip(scenes.rgb, scenes.depth, strict=True):
        x = to_tensor(rgb[None]) if mode == "rgb" else depth_input(depth.astype(np.float32) / 1000)
        found.append(torch.sigmoid(model(cl(x)))[0, 0].numpy())
    return found


def best_threshold(found: Sequence[np.ndarray], truths: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the threshold with the highest mean F at a pixel's tolerance, and that F."""
    scored = []
    for cut in THRESHOLDS:
        each = [precision_recall_f(thin(p, cut), t)[2] for p, t in zip(found, truths, strict=True)]
        scored.append((float(np.nanmean(each)), cut))
    score, cut = max(scored)
    return float(cut), score


def train_boundary(
    data: Path | str,
    val: Path | str,
    out: Path | str,
    work: Path | str,
    limit: int | None = None,
    seed: int = 0,
    command: str | None = None,
    engine: Engine = ENGINE,
    **changes: Any,
) -> dict[str, Any]:
    """Train both networks and write ``boundary.safetensors`` with its entry in the card; a stopped run goes on.

    Args:
        data: folder of rendered scenes to train on.
        val: folder of rendered scenes on which the thresholds are chosen.
        out: weights folder; the card's other entries stay.
        work: folder for checkpoints and logs. Where ``out`` holds stage one, encoders of its sizes begin with
            its weights.
        limit: use only the first scenes.
        seed: of everything random.
        command: that asked for it, for the card.
        engine: on what and how it runs.
        changes: ``steps``, ``batch``, ``lr`` instead of the recipe's; the depth network takes a third of the steps.

    Returns:
        the entry of the card.

    Raises:
        ValueError: for no scenes, or a checkpoint of another run in ``work``.
    """
    out = Path(out)
    scenes = load_scenes(data, limit)
    held_out = load_scenes(val, VALIDATE)
    truths = exact_outlines(held_out)
    torch.manual_seed(seed)
    nets = build_nets().to(memory_format=torch.channels_last)
    notes, thresholds = {}, []
    key = [checksum(scenes)]
    if (out / "region.safetensors").is_file():
        begin_with_stage_one(nets, load_part("region", out))
        key.append(read_card(out)["parts"]["region"]["sha256"])
    colour = replace(RECIPE, **changes)
    depth = replace(colour, steps=max(1, round(colour.steps * DEPTH_SHARE)))
    for mode, recipe in (("rgb", colour), ("depth", depth)):
        step = boundary_step(mode, nets[mode], scenes, recipe, seed)
        how = {"every": 100, "seed": seed, "key": json.dumps(key), "engine": engine}
        notes[mode] = fit(f"boundary-{mode}", nets[mode], step, recipe, work, **how)
        found = probabilities(mode, nets[mode].eval(), held_out)
        cut, score = best_threshold(found, truths[mode])
        notes[mode] |= {"recipe": vars(recipe), "threshold": cut, "val_f": round(score, 4)}
        thresholds.append(cut)
    notes |= {"command": command, "seed": seed}
    notes |= {"scenes": len(scenes), "first_scene": scenes.names[0], "last_scene": scenes.names[-1]}
    config = from_dict(read_card(out)["config"]) if (out / CARD).is_file() else preset("lite")
    if is_first():
        save_part("boundary", nets.state_dict() | {"thresholds": torch.tensor(thresholds)}, config, out, notes)
    wait_for_all()
    return notes
