"""Fine-tune trained weights on frames of another camera or place, and keep them only where that helped.

Not in the paper. What went wrong without this: a recipe made for training afresh, at its full rate, moves weights far
before its average has followed, and its last figure says nothing about what there was before. So here the rate is
small, the average begins with the weights at the start, part of the draws are scenes of the first training (what is no
longer seen is forgotten), training stops when held-out frames gain no more, and *other* held-out frames, which chose
nothing, decide whether the result is better than the start. If it is not, the start is what is written.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from ..config import Config, to_dict
from ..metrics import iou
from ..stage_two import BRANCHES
from ..store import WEIGHTS, copy_weights, load_part, read_card, save_part
from .loop import ENGINE, Engine, Recipe, fit, is_first, wait_for_all
from .parts import (
    NETWORKS,
    assemble,
    check_same_system,
    claims_in_order,
    count_scenes,
    drawn_from,
    needs,
    painter_of,
    parts_with,
    scene_errors,
    sharpened_errors,
)
from .scenes import Pool, Scenes, every

GENTLE = {"warmup": 10, "decay": 0.98, "ramp": False, "patience": 4, "law": "constant"}
RECIPES = {
    "region": Recipe(steps=300, batch=8, lr=1e-4, weight_decay=1e-2, **GENTLE),
    "optical": Recipe(steps=300, batch=8, lr=1e-4, **GENTLE),
    "geometric": Recipe(steps=300, batch=8, lr=1e-4, **GENTLE),
    "detail": Recipe(steps=120, batch=4, lr=5e-4, **GENTLE | {"decay": 0.95}),  # follows a sensor in some hundred views
}
EVERY = 20  # steps between looks at the held-out frames
LEAST = 3  # held-out frames: one chooses, two judge
WATCHED = "held_out"


def split_held_out(scenes: Scenes, part: str, errors: np.ndarray | None = None) -> tuple[Scenes, Scenes]:
    """Return the held-out frames that say when to stop, every third, and those that judge the result, all others.

    Args:
        scenes: held out.
        part: that is fine-tuned.
        errors: what it gets wrong of each, (N,); a frame that asks nothing of it, NaN, neither chooses nor judges.

    Raises:
        ValueError: for fewer than :data:`LEAST` such frames.
    """
    asking = list(range(len(scenes))) if errors is None else np.flatnonzero(~np.isnan(errors)).tolist()
    if len(asking) < LEAST:
        got = f"{len(asking)} of {len(scenes)}: give more with --val-root"
        raise ValueError(f"fine-tuning asks for {LEAST} held-out frames or more that concern {part!r}, got {got}")
    (judges,), (chooses,) = hold_out([every(scenes, asking)])
    return chooses, judges


def hold_out(groups: Sequence[Scenes]) -> tuple[list[Scenes], list[Scenes]]:
    """Return all frames but every third, to train on, and every third, for where nobody gives frames to validate on.

    Groups are counted through, so that one of a single frame is no special case.
    """
    learns, held_out, count = [], [], 0
    for scenes in groups:
        thirds = [i for i in range(len(scenes)) if (count + i) % 3 == 0]
        others = [i for i in range(len(scenes)) if (count + i) % 3]
        learns += [every(scenes, others)] if others else []
        held_out += [every(scenes, thirds)] if thirds else []
        count += len(scenes)
    return learns, held_out


def check_out(out: Path | str, start: Path | str) -> None:
    """Refuse to write over the weights that are the start, or over those of the package.

    Raises:
        ValueError: for such a folder.
    """
    for taken, whose in ((Path(start), "the weights to start from"), (WEIGHTS, "the package's own weights")):
        if Path(out).resolve() == taken.resolve():
            raise ValueError(f"{out} holds {whose}, which fine-tuning never replaces: give --out another folder")


def adapt(
    part: str,
    config: Config,
    pool: Pool,
    held_out: Scenes,
    start: Path | str,
    out: Path | str,
    work: Path | str,
    recipe: Recipe | None = None,
    seed: int = 0,
    boundary: str = "classical",
    command: str | None = None,
    engine: Engine = ENGINE,
    every: int = EVERY,
) -> dict[str, Any]:
    """Fine-tune one part and write the better of the weights before and after.

    Args:
        part: a key of :data:`RECIPES`. Not the autoencoder: all that builds on it would have to be trained again.
        config: of the weights.
        pool: what is drawn from.
        held_out: frames of the kind that it should become better at.
        start: weights folder.
        out: another weights folder; the other parts are copied there.
        work: folder for checkpoints; a stopped run goes on from there.
        recipe: the part's own by default.
        seed: of everything random.
        boundary: backend of the guides.
        command: that asked for it, for the card.
        engine: on what and how it runs.
        every: steps between validations, each with a checkpoint.

    Returns:
        the entry of the card. ``judged`` holds "before" and "after", the errors of the judging frames, and "kept",
        which is "fine-tuned" or "start". Frames that ask nothing of this part do not judge.

    Raises:
        ValueError: for another part, too few frames, a folder that must not be written into, or another system.
    """
    if part not in RECIPES:
        raise ValueError(f"cannot fine-tune {part!r}: choose one of {', '.join(RECIPES)}; train the autoencoder afresh")
    engine.join()
    check_out(out, start)
    check_same_system(config, start, NETWORKS)
    check_same_system(config, out)
    recipe = recipe or RECIPES[part]
    split_held_out(held_out, part)  # too few are too few before anything is written
    if is_first() and not (Path(out) / "card.json").is_file():
        copy_weights(start, out, config)
    wait_for_all()
    parts = parts_with(part, config, out, seed)
    parts[part].load_state_dict(load_part(part, start))
    model = parts[part].to(memory_format=torch.channels_last)
    errors = errors_of(part, parts, config, boundary)
    step, _ = assemble(part, parts, pool, None, config, recipe, boundary, seed)
    chooses, judges = split_held_out(held_out, part, model_errors(model, errors, held_out))
    before = model_errors(model, errors, judges)
    remarks = {"start_sha256": read_card(start)["parts"][part]["sha256"]}
    below = [read_card(out)["parts"][name]["sha256"] for name in needs(part, config)]
    seen = drawn_from(pool, boundary, held_out)
    key = json.dumps([to_dict(config), seen, below, boundary, remarks], sort_keys=True)
    notes = fit(
        part,
        model,
        step,
        recipe,
        work,
        lambda: {WATCHED: float(np.mean(errors(chooses)))},
        every=min(every, recipe.steps),
        seed=seed,
        key=key,
        engine=engine,
        best=WATCHED,
    )
    after = model_errors(model, errors, judges)
    better = float(np.mean(after - before)) < 0
    judged = {"before": before.tolist(), "after": after.tolist(), "kept": "fine-tuned" if better else "start"}
    notes |= {"command": command, "recipe": vars(recipe), "seed": seed, "judged": judged, **remarks}
    notes |= {"scenes": count_scenes(pool.groups)}
    state = model.state_dict() if better else load_part(part, start)
    if is_first():
        save_part(part, state, config, out, notes)
    wait_for_all()
    return notes


def model_errors(model: nn.Module, errors: Callable[[Scenes], np.ndarray], scenes: Scenes) -> np.ndarray:
    """Return a model's error of each frame, in eval mode; it is left in that mode."""
    model.eval()
    with torch.no_grad():
        return errors(scenes)


def errors_of(part: str, parts: nn.ModuleDict, config: Config, boundary: str) -> Callable[[Scenes], np.ndarray]:
    """Return scenes -> what a part gets wrong of each, (N,), NaN where a scene asks nothing of it.

    Stage one: 1 - IoU at threshold 1/2. Branches and the finer final step: relative RMSE of one step from pure noise
    with the true region; for the final step, the mean over the branches.
    """
    if part == "region":
        return lambda scenes: region_errors(parts["region"], config, scenes)
    painters = {branch: painter_of(branch, parts, config) for branch in BRANCHES}
    if part == "detail":
        return lambda scenes: sharpened_errors(parts["detail"], painters, config, scenes, boundary)
    return lambda scenes: scene_errors(part, painters[part], config, scenes, boundary)


def region_errors(model: nn.Module, config: Config, scenes: Scenes) -> np.ndarray:
    """Return 1 - IoU of each scene; 0 where there is neither a region nor a claim: a claim there would be an error."""
    found: list[float] = []
    for claimed, true in claims_in_order(model, config, scenes):
        found.append(1 - iou(claimed, true) if (claimed | true).any() else 0.0)
    return np.array(found)


def mixed(own: Sequence[Scenes], first: Sequence[Scenes], share: float) -> Pool:
    """Return a pool of one's own frames and, at ``share`` of the draws, scenes of the first training.

    Raises:
        ValueError: for a share outside 0 to 1.
    """
    if not 0 <= share < 1:
        raise ValueError(f"expected a share of scenes of the first training from 0 to below 1, got {share}")
    groups, shares = [], []
    for part, weight in ((own, 1 - share), (first, share)):
        count = sum(map(len, part))
        groups += part if weight else []
        shares += [weight * len(group) / count for group in part] if weight else []
    return Pool(groups, shares)
