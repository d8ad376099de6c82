"""Train one part from start to shipped file: load scenes, run its recipe, validate, save weights and card."""

import json
from collections.abc import Mapping
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from ..conditioning import fill
from ..config import Config, from_dict, to_dict
from ..data import SAMPLES
from ..metrics import iou
from ..pipeline import build
from ..region import region_probability
from ..schedule import make_schedule
from ..store import CARD, WEIGHTS, copy_weights, load_part, read_card, save_part
from . import recipes
from .batches import Scenes, checksum, load_scenes
from .loop import Recipe, fit

PARTS = ("autoencoder", "region", "optical", "geometric", "detail")  # in the order in which they need each other
NETWORKS = ("region", "autoencoder", "schedule", "unet", "detail")  # settings that make the networks
SYSTEM = (*NETWORKS, "size", "sampler.prediction", "evidence")  # and all others that weights are trained for
NEEDS = {"optical": ["autoencoder"], "geometric": ["autoencoder"], "detail": list(PARTS[:4])}


def folder_name(settings: Mapping[str, Any]) -> str:
    """Return settings as the name of a folder, e.g. ``unet.width=48,size=96,128``."""
    return ",".join(f"{key}={value}" for key, value in settings.items()).replace(" ", "").replace("/", "-")


def train(
    part: str,
    config: Config,
    data: Path | str = "outputs/scenes/train",
    val: Path | str = SAMPLES / "val",
    out: Path | str = WEIGHTS,
    work: Path | str = "outputs/training",
    recipe: Recipe | None = None,
    limit: int | None = None,
    seed: int = 0,
    boundary: str = "classical",
    start: Path | str | None = None,
    command: str | None = None,
) -> dict[str, Any]:
    """Train ``part`` and write its weights and its entry in the card.

    Args:
        part: one of :data:`PARTS`.
        config: sizes.
        data: folder of rendered scenes to train on.
        val: folder of rendered scenes to validate on.
        out: weights folder, which must hold the parts that this one builds on.
        work: folder for checkpoints; a stopped run goes on from there.
        recipe: steps, batch, rate; the part's own by default.
        limit: use only the first scenes.
        seed: of everything random.
        boundary: backend of the guides.
        start: weights folder to go on from, such as the shipped one for frames of your own; its other parts are
            copied to ``out`` if that is empty. None begins afresh.
        command: that asked for it, for the card.

    Returns:
        the entry of the card: command, recipe, scenes, seconds, curve.

    Raises:
        ValueError: for an unknown part, no scenes, a missing part that this one needs, weights of another
            configuration in ``out``: one folder holds one system; or a checkpoint of another run in ``work``.
    """
    if part not in PARTS:
        raise ValueError(f"unknown part {part!r}; choose one of {', '.join(PARTS)}")
    check_same_system(config, out)
    recipe = recipe or recipes.RECIPES[part]
    guided = part not in ("autoencoder", "region")
    cache = Path(work)
    cache.mkdir(parents=True, exist_ok=True)
    scenes, held_out = (
        load_scenes(folder, n, boundary if guided else None, cache / f"{Path(folder).name}-{boundary}.npz")
        for folder, n in ((data, limit), (val, None))
    )
    return train_on(part, config, scenes, held_out, out, work, recipe, seed, start, command)


def train_on(
    part: str,
    config: Config,
    scenes: Scenes,
    held_out: Scenes | None,
    out: Path | str,
    work: Path | str,
    recipe: Recipe,
    seed: int = 0,
    start: Path | str | None = None,
    command: str | None = None,
    **remarks: Any,
) -> dict[str, Any]:
    """Do what :func:`train` does with scenes that are in memory already.

    Args:
        part: one of :data:`PARTS`.
        config: sizes.
        scenes: to train on, with guides unless the part is the autoencoder or the region network.
        held_out: likewise, to validate on; None leaves the validation out.
        out: weights folder.
        work: folder for checkpoints.
        recipe: steps, batch, rate.
        seed: of everything random.
        start: weights folder to go on from, or None.
        command: that asked for it, for the card.
        remarks: what else to enter into the card; a checkpoint made with other remarks is not taken.

    Raises:
        ValueError: as :func:`train`, and for a checkpoint of another run in ``work``.
    """
    check_same_system(config, out)
    if start is not None:
        check_same_system(config, start, NETWORKS)
        if not (Path(out) / CARD).is_file():
            copy_weights(start, out)  # the other parts come along: what is trained on stays a whole system
    torch.manual_seed(seed)
    parts = build(config)
    for name in NEEDS.get(part, []):
        parts[name].load_state_dict(load_part(name, out))
        parts[name].eval().requires_grad_(False)
    if start is not None:
        parts[part].load_state_dict(load_part(part, start))
        remarks["start_sha256"] = read_card(start)["parts"][part]["sha256"]
    model = parts[part].to(memory_format=torch.channels_last)
    step, validate = _assemble(part, parts, scenes, held_out, config, recipe, seed)
    below = [read_card(out)["parts"][name]["sha256"] for name in NEEDS.get(part, [])]
    key = json.dumps([to_dict(config), checksum(scenes), below, remarks], sort_keys=True)
    notes = fit(part, model, step, recipe, work, validate, seed=seed, key=key)
    if part == "autoencoder":
        model.eval()
        model.calibrate(recipes.encode_targets(model, scenes)[:, 0].float())
    notes |= {"command": command, "recipe": vars(recipe), "seed": seed}
    notes |= {"scenes": len(scenes), "first_scene": scenes.names[0], "last_scene": scenes.names[-1], **remarks}
    save_part(part, model.state_dict(), config, out, notes)
    return notes


def check_same_system(config: Config, out: Path | str, settings: tuple[str, ...] = SYSTEM) -> None:
    """Refuse a weights folder that holds another system than ``config``, with a ValueError that names the settings."""
    if not (Path(out) / CARD).is_file():
        return
    there = from_dict(read_card(out)["config"])
    if other := [name for name in settings if attrgetter(name)(there) != attrgetter(name)(config)]:
        raise ValueError(f"{out} holds weights of another {', '.join(other)} setting: choose another folder for these")


def _assemble(
    part: str, parts: nn.ModuleDict, scenes: Scenes, val: Scenes | None, config: Config, recipe: Recipe, seed: int
):
    """Return the step loss and the validation of one part, None without scenes to validate on."""
    model, validate = parts[part], None
    if part == "region":
        step = recipes.region_step(model, scenes, recipe, seed)
        validate = partial(validate_region, model, val)
    elif part == "autoencoder":
        step = recipes.autoencoder_step(model, scenes, recipe, seed)
        validate = partial(validate_autoencoder, model, val)
    elif part == "detail":
        step = recipes.detail_step(model, recipes.paint_all(parts, scenes, config, seed), recipe, len(scenes), seed)
        if val is not None:
            validate = partial(
                validate_detail, model, recipes.paint_all(parts, val, config, seed, variants=1), len(val)
            )
    else:
        step = recipes.branch_step(part, model, parts["autoencoder"], scenes, config, recipe, seed)
        validate = partial(validate_branch, part, parts, val, config)
    return step, None if val is None else validate


def validate_region(model: nn.Module, val: Scenes) -> dict[str, float]:
    """Return the mean intersection over union of the merged region at threshold 0.5."""
    scores = []
    for batch in recipes.batches(val, 8):
        found = region_probability(model(batch.rgb, batch.depth_n, batch.valid))[:, 0] > 0.5
        scores += [iou(f.numpy(), m.numpy() > 0) for f, m in zip(found, batch.material, strict=True)]
    return {"val_iou": float(np.mean([s for s in scores if s is not None]))}


def validate_autoencoder(model: nn.Module, val: Scenes) -> dict[str, float]:
    """Return the root mean square error in metres of decoding the encoded truth, inside the region and in the holes."""
    total = {"val_optical_rmse_m": [], "val_geometric_rmse_m": []}
    for batch in recipes.batches(val, 8):
        error = (model(fill(batch.gt_n, batch.gt_known))["reconstruction"] - batch.gt_n) * batch.scale_m
        region = (batch.material > 0)[:, None].float()
        holes = (1 - region) * (1 - batch.valid)
        for name, where in zip(total, (region, holes), strict=True):
            total[name] += _rmse(error, where * batch.gt_known)
    return {k: float(np.nanmean(v)) for k, v in total.items()} | {"codebook_perplexity_share": model.quantizer.usage}


def validate_branch(branch: str, parts: nn.ModuleDict, val: Scenes, config: Config) -> dict[str, float]:
    """Return the mean over scenes of :func:`scene_errors`."""
    errors = scene_errors(branch, parts[branch], parts["autoencoder"], val, config)
    return {"val_rmse_m": float(np.nanmean(errors))}


@torch.no_grad()
def scene_errors(
    branch: str, net: nn.Module, autoencoder: nn.Module, scenes: Scenes, config: Config, seed: int = 0
) -> np.ndarray:
    """Return the RMSE (N,) in metres, per scene, of one step from pure noise, with the true region.

    Args:
        branch: "optical" or "geometric"; it says where must be painted, which is what counts.
        net: its denoiser, trained or not.
        autoencoder: of the latents.
        scenes: to paint; one without such pixels scores NaN.
        config: of net and schedule.
        seed: of the noise.
    """
    schedule, errors = make_schedule(config.schedule), []
    for batch in recipes.batches(scenes, 8):
        given, paint = recipes.branch_inputs(branch, batch, config)
        decoded = recipes.one_step(net, autoencoder, given, schedule, config, seed)
        errors += _rmse((decoded - batch.gt_n) * batch.scale_m, paint * batch.gt_known)
    return np.array(errors)


def validate_detail(model: nn.Module, painted, count: int) -> dict[str, float]:
    """Return optical and geometric error in metres, before and after the finer final step."""
    out = {"val_optical_before_m": [], "val_optical_m": [], "val_geometric_before_m": [], "val_geometric_m": []}
    for start in range(0, count, 8):
        index = np.arange(start, min(start + 8, count))
        batch, decoded, region = painted(index, None)
        x = recipes.detail_input(decoded, batch.depth_n, batch.valid, region, batch.rgb, batch.guide_rgb)
        for suffix, depth in (("_before_m", decoded), ("_m", model(x))):
            error = (depth - batch.gt_n) * batch.scale_m
            holes = (1 - region) * (1 - batch.valid)
            out[f"val_optical{suffix}"] += _rmse(error, region * batch.gt_known)
            out[f"val_geometric{suffix}"] += _rmse(error, holes * batch.gt_known)
    return {k: float(np.nanmean(v)) for k, v in out.items()}


def _rmse(error: torch.Tensor, where: torch.Tensor) -> list[float]:
    count = where.sum(dim=(1, 2, 3))
    mean = (error.square() * where).sum(dim=(1, 2, 3)) / count.clamp(min=1)
    return torch.where(count > 0, mean.sqrt(), torch.nan).tolist()
