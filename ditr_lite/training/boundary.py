"""Train the two networks of the ``learned`` boundary backend on the exact outlines of rendered scenes."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ..boundary import precision_recall_f, true_maps
from ..boundary.learned import begin_with_stage_one, build, depth_image, thin
from ..config import from_dict, preset
from ..data import read_sample
from ..store import CARD, load_part, read_card, save_part
from .batches import Scenes, checksum, draw, load_scenes
from .loop import Recipe, fit

RECIPE = Recipe(steps=3000, batch=8, lr=3e-3, warmup=30, decay=0.99)
DEPTH_SHARE = 1 / 3  # of the steps, for the depth network: there is less to see in depth
VALIDATE = 24  # scenes on which the thresholds are chosen
CROP = (96, 128)  # pixels of a frame that a step looks at: outlines are everywhere, so many small views teach more
THRESHOLDS = (0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6)


def with_outlines(scenes: Scenes, folder: Path | str) -> Scenes:
    """Return the scenes with their exact outlines in the place of guides, so that batches carry them.

    Args:
        scenes: from :func:`training.batches.load_scenes`.
        folder: they were loaded from; instances are read there.

    Raises:
        ValueError: for a scene without instances.
    """
    truth = np.empty((len(scenes), 2, *scenes.depth.shape[1:]), np.uint8)
    for i, name in enumerate(scenes.names):
        truth[i] = true_maps(read_sample(Path(folder) / name))
    return replace(scenes, guides=truth)


def boundary_step(
    mode: str, model: nn.Module, scenes: Scenes, recipe: Recipe, seed: int = 0
) -> Callable[[int], dict[str, Tensor]]:
    """Return the step loss of one network: cross-entropy of "a boundary lies within a pixel of here".

    That is what scoring at a tolerance of one pixel asks, and it does not punish a network for not knowing on which of
    two neighbouring pixels an edge lies. Depth is unknown where the truth is: nothing is asked there.
    """

    def step_loss(step: int) -> dict[str, Tensor]:
        rng = np.random.default_rng([seed, step])
        index = rng.integers(0, len(scenes), recipe.batch)
        top, left = (int(rng.integers(0, n - c + 1)) for n, c in zip(scenes.depth.shape[1:], CROP, strict=True))
        here = np.s_[..., top : top + CROP[0], left : left + CROP[1]]
        if mode == "rgb":  # colours are costly to vary: cut first
            batch = draw(_cut(scenes, index, here), np.arange(recipe.batch), rng)
            x, near, known = batch.rgb, _near(batch.guide_rgb), batch.gt_known
        else:  # the bounds are those of the whole frame: cut last
            batch = draw(scenes, index, rng, colour=False)
            x, near, known = depth_image(batch.depth_n[here], batch.valid[here]), batch.guide_da[here], batch.gt_known
            near, known = _near(near), known[here]
        logits = model(x.contiguous(memory_format=torch.channels_last))
        return {"total": F.binary_cross_entropy_with_logits(logits, near, known)}

    return step_loss


def _near(boundary: Tensor) -> Tensor:
    return F.max_pool2d(boundary, 3, 1, 1)  # within a pixel, diagonals too


def _cut(scenes: Scenes, index: np.ndarray, here: tuple) -> Scenes:
    """Return a window of some scenes; its raw depth is all one, because nothing will look at it."""
    rgb = scenes.rgb[index][:, *here[1:]]
    maps = {k: getattr(scenes, k)[index][here] for k in ("depth_gt", "material", "guides")}
    return Scenes([scenes.names[i] for i in index], rgb, np.full(rgb.shape[:3], 1000, np.uint16), **maps)


@torch.no_grad()
def probabilities(mode: str, model: nn.Module, scenes: Scenes) -> list[np.ndarray]:
    """Return what a network says of each scene, (H, W) float32."""
    found, none = [], np.random.default_rng(0)
    for start in range(0, len(scenes), 8):
        batch = draw(scenes, np.arange(start, min(start + 8, len(scenes))), none, augment=False)
        x = batch.rgb if mode == "rgb" else depth_image(batch.depth_n, batch.valid)
        found += list(torch.sigmoid(model(x.contiguous(memory_format=torch.channels_last)))[:, 0].numpy())
    return found


def best_threshold(found: Sequence[np.ndarray], truths: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the threshold with the highest mean F at a pixel's tolerance, and that F."""
    scored = [
        (float(np.nanmean([precision_recall_f(thin(p, cut), t)[2] for p, t in zip(found, truths, strict=True)])), cut)
        for cut in THRESHOLDS
    ]
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
    **changes: Any,
) -> dict[str, Any]:
    """Train both networks and write ``boundary.safetensors`` with its entry in the card; a stopped run goes on.

    Args:
        data: folder of rendered scenes to train on.
        val: folder of rendered scenes on which the thresholds are chosen.
        out: weights folder; the card's other entries stay.
        work: folder for checkpoints and logs. Where ``out`` holds stage one, the encoders begin with its.
        limit: use only the first scenes.
        seed: of everything random.
        command: that asked for it, for the card.
        changes: ``steps``, ``batch``, ``lr`` instead of the recipe's; the depth network takes a third of the steps.

    Returns:
        the entry of the card.

    Raises:
        ValueError: for no scenes, or a checkpoint of another run in ``work``.
    """
    out = Path(out)
    scenes, held_out = (with_outlines(load_scenes(f, n), f) for f, n in ((data, limit), (val, VALIDATE)))
    torch.manual_seed(seed)
    nets, notes, thresholds = build().to(memory_format=torch.channels_last), {}, []
    key = [checksum(scenes)]
    if (out / "region.safetensors").is_file():
        begin_with_stage_one(nets, load_part("region", out))
        key.append(read_card(out)["parts"]["region"]["sha256"])
    colour = replace(RECIPE, **changes)
    depth = replace(colour, steps=max(1, round(colour.steps * DEPTH_SHARE)))
    for channel, (mode, recipe) in enumerate((("rgb", colour), ("depth", depth))):
        step = boundary_step(mode, nets[mode], scenes, recipe, seed)
        notes[mode] = fit(f"boundary-{mode}", nets[mode], step, recipe, work, every=100, seed=seed, key=json.dumps(key))
        found = probabilities(mode, nets[mode].eval(), held_out)
        cut, score = best_threshold(found, [g[channel] > 0 for g in held_out.guides])
        notes[mode] |= {"recipe": vars(recipe), "threshold": cut, "val_f": round(score, 4)}
        thresholds.append(cut)
    notes |= {"command": command, "seed": seed}
    notes |= {"scenes": len(scenes), "first_scene": scenes.names[0], "last_scene": scenes.names[-1]}
    config = from_dict(read_card(out)["config"]) if (out / CARD).is_file() else preset("lite")
    save_part("boundary", nets.state_dict() | {"thresholds": torch.tensor(thresholds)}, config, out, notes)
    return notes
