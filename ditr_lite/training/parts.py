"""Train one part from start to shipped file: load scenes, run its recipe, validate, save weights and card."""

import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..boundary import get_backend
from ..conditioning import fill
from ..config import Config, from_dict, to_dict
from ..metrics import iou
from ..pipeline import build
from ..region import IGNORE, region_probability
from ..stage_two import BRANCHES, Painter, cl
from ..store import CARD, WEIGHTS, calibrated, copy_part, copy_weights, load_part, read_card, read_config, save_part
from . import recipes
from .batches import Batch, frames_in_order, scenes_with_glass, windows_in_order
from .kept_maps import SLOW, KeptMaps
from .loop import ENGINE, EVERY, Engine, Recipe, Step, fit, is_first, wait_for_all
from .readers import RealFrames
from .scenes import Pool, Scenes, checksum, load_scenes

PARTS = ("autoencoder", "region", "optical", "geometric", "detail")  # in the order in which they need each other
NETWORKS = ("region", "autoencoder", "schedule", "unet", "detail")  # settings that make the networks
SYSTEM = (*NETWORKS, "size", "window", "refine.looks", "sampler.prediction", "evidence")  # weights are for all these
NEEDS = {"optical": ["autoencoder"], "geometric": ["autoencoder"], "detail": ["autoencoder", *BRANCHES]}
PRETRAINED = "encoder"  # not trained here: see tools/import_encoder.py


def needs(part: str, config: Config) -> list[str]:
    """Return the parts that must be there before ``part`` can be trained."""
    needed = list(NEEDS.get(part, []))
    if (part in NEEDS and config.unet.colour_channels) or (part == "region" and config.region.colour == "pretrained"):
        needed.append(PRETRAINED)
    return needed


def folder_name(settings: Mapping[str, Any]) -> str:
    """Return settings as the name of a folder, e.g. ``unet.width=48,size=96,128``."""
    return ",".join(f"{key}={value}" for key, value in settings.items()).replace(" ", "").replace("/", "-")


def told_apart(folders: Sequence[Path | str]) -> dict[str, Path | str]:
    """Return name -> folder: the last part of its path, with those before it that tell it from the other folders."""
    paths = {Path(folder).absolute(): folder for folder in folders}
    names = {}
    for path, folder in paths.items():
        others, count = [other for other in paths if other != path], 1
        while any(other.parts[-count:] == path.parts[-count:] for other in others):
            count += 1
        names["/".join(path.parts[-count:])] = folder
    return names


def count_scenes(groups: Sequence[Scenes]) -> dict[str, int]:
    """Return how many scenes groups have, by the names of the first and the last; groups of like names are added up."""
    counts: dict[str, int] = {}
    for group in groups:
        name = f"{group.names[0]} to {group.names[-1]}"
        counts[name] = counts.get(name, 0) + len(group)
    return counts


def train(
    part: str,
    config: Config,
    data: Sequence[Path | str],
    val: Sequence[Path | str],
    out: Path | str,
    work: Path | str = "outputs/training",
    recipe: Recipe | None = None,
    limit: int | None = None,
    seed: int = 0,
    boundary: str = "classical",
    start: Path | str | None = None,
    command: str | None = None,
    engine: Engine = ENGINE,
    real: RealFrames | None = None,
    every: int = EVERY,
) -> dict[str, Any]:
    """Train ``part`` and write its weights and its entry in the card.

    Args:
        part: one of :data:`PARTS`.
        config: sizes.
        data: folders of rendered scenes to train on, drawn from by their number of scenes.
        val: folders of rendered scenes to validate on, each scored by itself.
        out: weights folder, which must hold the parts that this one builds on.
        work: folder for checkpoints; a stopped run goes on from there.
        recipe: steps, batch, rate; the part's own by default.
        limit: use only the first scenes of each folder.
        seed: of everything random.
        boundary: backend of the guides.
        start: weights folder to go on from, such as the shipped one for frames of your own; its other parts are
            copied to ``out`` if that is empty. None begins afresh.
        command: that asked for it, for the card.
        engine: on what and how it runs.
        real: frames of a dataset to train on, besides the rendered scenes or in their place.
        every: steps between validations, each with a checkpoint.

    Returns:
        the entry of the card: command, recipe, scenes, seconds, curve.

    Raises:
        ValueError: for an unknown part, no scenes, a missing part that this one needs, weights of another
            configuration in ``out``: one folder holds one system; or a checkpoint of another run in ``work``.
    """
    if part not in PARTS:
        raise ValueError(f"unknown part {part!r}; choose one of {', '.join(PARTS)}")
    engine.join()
    check_same_system(config, out)
    recipe = recipe or recipes.RECIPES[part]
    wanted = real is None or real.scene_share > 0
    scenes = [load_scenes(folder, limit) for folder in data] if wanted else []
    held_out = {name: load_scenes(folder) for name, folder in told_apart(val).items()}
    pool, remarks = Pool(scenes) if real is None else real.pool(part, config, scenes), {}
    if real is not None:
        held_out |= real.held_out(part, config)
        remarks = {"dataset": real.name, "scene_share": real.scene_share, "zero_region": real.zero_region}
    how = (recipe, seed, start, command, boundary, engine, every)
    return train_on(part, config, pool, held_out, out, work, *how, **remarks)


def train_on(
    part: str,
    config: Config,
    scenes: Sequence[Scenes] | Pool,
    held_out: Mapping[str, Scenes] | None,
    out: Path | str,
    work: Path | str,
    recipe: Recipe,
    seed: int = 0,
    start: Path | str | None = None,
    command: str | None = None,
    boundary: str = "classical",
    engine: Engine = ENGINE,
    every: int = EVERY,
    **remarks: Any,
) -> dict[str, Any]:
    """Do what :func:`train` does with scenes that are in memory already.

    Args:
        part: one of :data:`PARTS`.
        config: sizes.
        scenes: groups of scenes to train on, or a pool with shares of its own.
        held_out: name -> scenes to validate on; None leaves the validation out.
        out: weights folder.
        work: folder for checkpoints.
        recipe: steps, batch, rate.
        seed: of everything random.
        start: weights folder to go on from, or None.
        command: that asked for it, for the card.
        boundary: backend of the guides.
        engine: on what and how it runs; of several processes the first alone writes files.
        every: steps between validations, each with a checkpoint.
        remarks: what else to enter into the card; a checkpoint made with other remarks is not taken.

    Raises:
        ValueError: as :func:`train`, and for a checkpoint of another run in ``work``.
    """
    engine.join()
    check_same_system(config, out)
    if start is not None:
        check_same_system(config, start, NETWORKS)
    if is_first():
        if start is not None and not (Path(out) / CARD).is_file():
            # the other parts come along: what is trained on stays a whole system
            copy_weights(start, out, calibrated(config, read_config(start)))
        borrow(part, config, out)
    wait_for_all()
    parts = parts_with(part, config, out, seed)
    if start is not None:
        parts[part].load_state_dict(load_part(part, start))
        remarks["start_sha256"] = read_card(start)["parts"][part]["sha256"]
    model = parts[part].to(memory_format=torch.channels_last)
    pool = scenes if isinstance(scenes, Pool) else Pool(scenes)
    step, validate = assemble(part, parts, pool, held_out, config, recipe, boundary, seed)
    below = [read_card(out)["parts"][name]["sha256"] for name in needs(part, config)]
    key = json.dumps([to_dict(config), drawn_from(pool, boundary), below, boundary, remarks], sort_keys=True)
    notes = fit(part, model, step, recipe, work, validate, every, seed, key=key, engine=engine)
    if part == "autoencoder":
        model.eval()
        model.calibrate(some_latents(model, pool, config))
    notes |= {"command": command, "recipe": vars(recipe), "seed": seed}
    notes |= {"scenes": count_scenes(pool.groups), **remarks}
    if is_first():
        save_part(part, model.state_dict(), config, out, notes)
    wait_for_all()
    return notes


def drawn_from(pool: Pool, boundary: str, *held_out: Scenes) -> list[Any]:
    """Return what decides the frames that a training draws: a checkpoint of others is not taken."""
    return [checksum(*pool.groups, *held_out), pool.shares.tolist(), str(get_backend(boundary).fingerprint)]


def borrow(part: str, config: Config, out: Path | str) -> None:
    """Copy what a part builds on from the shipped weights, where the folder lacks it and their sizes are the same.

    The pretrained encoder of colour comes with the package whatever the sizes are.
    """
    try:
        check_same_system(config, WEIGHTS, NETWORKS)
        fits = True
    except ValueError:
        fits = False
    for name in needs(part, config):
        if name == PRETRAINED:
            copy_part(name, WEIGHTS, out, config)
        elif fits and not (Path(out) / f"{name}.safetensors").is_file():
            warnings.warn(
                f"{out} has no {name}: the shipped one is copied there, for {part} builds on it", stacklevel=2
            )
            copy_part(name, WEIGHTS, out, config)


def parts_with(part: str, config: Config, out: Path | str, seed: int) -> nn.ModuleDict:
    """Return all networks, new but for those that ``part`` builds on: these are read from ``out`` and frozen."""
    torch.manual_seed(seed)
    parts = build(config)
    for name in needs(part, config):
        if name in parts:
            parts[name].load_state_dict(load_part(name, out))
            parts[name].eval().requires_grad_(False)
    if part == "region" and config.region.colour == "pretrained":
        encoder, trained = parts["region"].encoder_rgb.encoder, load_part(PRETRAINED, out)
        encoder.load_state_dict({name: trained[name] for name in encoder.state_dict()})  # fewer levels, fewer stages
    return parts


def check_same_system(config: Config, out: Path | str, settings: tuple[str, ...] = SYSTEM) -> None:
    """Refuse a weights folder that holds another system than ``config``, with a ValueError that names the settings."""
    if not (Path(out) / CARD).is_file():
        return
    there = from_dict(read_card(out)["config"])
    if other := [name for name in settings if attrgetter(name)(there) != attrgetter(name)(config)]:
        raise ValueError(f"{out} holds weights of another {', '.join(other)} setting: choose another folder for these")


def assemble(
    part: str,
    parts: nn.ModuleDict,
    pool: Pool,
    held_out: Mapping[str, Scenes] | None,
    config: Config,
    recipe: Recipe,
    boundary: str,
    seed: int,
) -> tuple[Step, Callable[[], dict[str, float]] | None]:
    """Return the step loss and the validation of one part, None without scenes to validate on."""
    model, backend = parts[part], get_backend(boundary)
    painters = {branch: painter_of(branch, parts, config) for branch in BRANCHES}
    if part == "region":
        step = recipes.region_step(model, pool, config, recipe, seed)
        score = partial(validate_region, model, config)
    elif part == "autoencoder":
        step = recipes.autoencoder_step(model, pool, config, recipe, seed)
        score = partial(validate_autoencoder, model, config)
    elif part == "detail":
        step = recipes.detail_step(model, painters, pool, config, recipe, backend, seed)
        score = partial(validate_detail, model, painters, config, boundary=boundary)
    else:
        step = recipes.branch_step(part, painters[part], pool, config, recipe, backend, seed)
        score = partial(validate_branch, part, painters[part], config, boundary=boundary)
    if held_out is None:
        return step, None

    def validate() -> dict[str, float]:
        found = {}
        for name, scenes in held_out.items():
            found |= {f"{name}_{key}": value for key, value in score(scenes).items()}
        return found

    return step, validate


def painter_of(branch: str, parts: nn.ModuleDict, config: Config) -> Painter:
    """Return the networks of a branch without the finer final step."""
    encoder = parts["encoder"] if "encoder" in parts else None
    return Painter(parts[branch], parts["autoencoder"], encoder, None, config.evidence and branch == "optical")


@torch.no_grad()
def some_latents(model: nn.Module, pool: Pool, config: Config) -> Tensor:
    """Return latents (N, C, h, w) of true depth in windows, to learn their mean and spread from."""
    latents = []
    for k in range(20):
        batch = recipes.branch_batch("optical", pool, config, 8, recipes.rng_of(1, k))
        latents.append(model.encode(cl(fill(batch.gt_n, batch.gt_known))))
    return torch.cat(latents)


def validate_region(model: nn.Module, config: Config, scenes: Scenes) -> dict[str, float]:
    """Return the mean IoU at threshold 0.5 over scenes with glass, and the share of all pixels claimed by mistake."""
    overlaps, mistaken = [], []
    for claimed, true in claims_in_order(model, config, scenes):
        if true.any():
            overlaps.append(iou(claimed, true))
        mistaken.append(float((claimed & ~true).mean()))
    return {"iou": float(np.mean(overlaps)) if overlaps else float("nan"), "false": float(np.mean(mistaken))}


@torch.no_grad()
def claims_in_order(model: nn.Module, config: Config, scenes: Scenes) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield what stage one claims of each scene, above 1/2 at its first look, and the true region, (H, W) bool each.

    Nothing is claimed where nothing is known, as in the padding around a picture: the system drops such claims, too.
    """
    for batch in frames_in_order(scenes, config.look()):
        given = batch.to(device_of(model))
        found = (region_probability(model(given.rgb, given.depth_n, given.valid))[:, 0] > 0.5).cpu()
        yield from zip((found & (batch.material != IGNORE)).numpy(), batch.region[:, 0].numpy() > 0, strict=True)


def validate_autoencoder(model: nn.Module, config: Config, scenes: Scenes) -> dict[str, float]:
    """Return the relative error of decoding the encoded truth, in regions and in holes."""
    region, holes = [], []
    for batch in held_out_batches("optical", scenes, config):
        batch = batch.to(device_of(model))
        decoded = model(cl(fill(batch.gt_n, batch.gt_known)))["reconstruction"]
        error = batch.relative_error(decoded)
        region += root_mean_square(error, batch.region * batch.gt_known)
        holes += root_mean_square(error, (1 - batch.region) * (1 - batch.valid) * batch.gt_known)
    figures = {"optical": float(np.nanmean(region)), "geometric": float(np.nanmean(holes))}
    return figures | {"codes_used": model.quantizer.usage}


def validate_branch(
    branch: str, painter: Painter, config: Config, scenes: Scenes, boundary: str = "classical"
) -> dict[str, float]:
    """Return the mean over scenes of :func:`scene_errors`."""
    return {"error": float(np.nanmean(scene_errors(branch, painter, config, scenes, boundary)))}


def held_out_batches(branch: str, scenes: Scenes, config: Config, boundary: str = "classical") -> Iterator[Batch]:
    """Yield what a branch is validated on: windows for the optical one, whole frames for the geometric one."""
    backend = get_backend(boundary)
    if boundary in SLOW:
        backend = KeptMaps(backend)
    if branch == "optical" and config.window:
        return windows_in_order(scenes, config.window, backend=backend)
    return frames_in_order(scenes, config.size, backend=backend)


@torch.no_grad()
def scene_errors(
    branch: str, painter: Painter, config: Config, scenes: Scenes, boundary: str = "classical", seed: int = 0
) -> np.ndarray:
    """Return, per scene, the relative RMSE of one step from pure noise with the true region.

    Args:
        branch: "optical" or "geometric"; it says where must be painted, which is what counts.
        painter: its networks, trained or not.
        config: of net and schedule.
        scenes: to paint; one without such pixels scores NaN.
        boundary: backend of the guides.
        seed: of the noise.
    """
    found = np.full(len(scenes), np.nan)
    asked = scenes_asking(branch, scenes, config)
    errors = []
    for batch in held_out_batches(branch, scenes, config, boundary):
        batch = batch if painter is None else batch.to(device_of(painter.net))
        decoded, paint = recipes.one_step(branch, painter, batch, config, seed)
        errors += root_mean_square(batch.relative_error(decoded), paint * batch.gt_known)
    found[asked] = errors
    return found


def scenes_asking(branch: str, scenes: Scenes, config: Config) -> list[int]:
    """Return of which scenes a branch is shown something: the optical one sees windows around regions, if there are."""
    if branch == "optical" and config.window:
        return scenes_with_glass(scenes)
    return list(range(len(scenes)))


def validate_detail(
    model: nn.Module,
    painters: Mapping[str, Painter],
    config: Config,
    scenes: Scenes,
    boundary: str = "classical",
) -> dict[str, float]:
    """Return the relative error of each branch, before and after the finer final step."""
    figures = {}
    for branch, painter in painters.items():
        before, after = [], []
        for batch in held_out_batches(branch, scenes, config, boundary):
            batch = batch.to(device_of(model))
            decoded, paint = recipes.one_step(branch, painter, batch, config)
            where = paint * batch.gt_known
            before += root_mean_square(batch.relative_error(decoded), where)
            after += root_mean_square(batch.relative_error(recipes.sharpened(model, decoded, batch, config)), where)
        figures[f"{branch}_before"] = float(np.nanmean(before))
        figures[branch] = float(np.nanmean(after))
    return figures


@torch.no_grad()
def sharpened_errors(
    model: nn.Module, painters: Mapping[str, Painter], config: Config, scenes: Scenes, boundary: str = "classical"
) -> np.ndarray:
    """Return, per scene, the relative RMSE after the finer final step, the mean over the branches; NaN without any."""
    found = np.full((len(painters), len(scenes)), np.nan)
    for row, (branch, painter) in zip(found, painters.items(), strict=True):
        asked = scenes_asking(branch, scenes, config)
        errors = []
        for batch in held_out_batches(branch, scenes, config, boundary):
            batch = batch.to(device_of(model))
            decoded, paint = recipes.one_step(branch, painter, batch, config)
            error = batch.relative_error(recipes.sharpened(model, decoded, batch, config))
            errors += root_mean_square(error, paint * batch.gt_known)
        row[asked] = errors
    known = ~np.isnan(found)
    return np.where(known.any(0), np.where(known, found, 0).sum(0) / np.maximum(known.sum(0), 1), np.nan)


def device_of(model: nn.Module) -> torch.device:
    """Return where a network's weights are."""
    return next(model.parameters()).device


def root_mean_square(error: Tensor, where: Tensor) -> list[float]:
    """Return, per view, the root mean square of ``error`` where ``where`` is 1, both (B, 1, H, W); NaN without any."""
    count = where.sum(dim=(1, 2, 3))
    mean = (error.square() * where).sum(dim=(1, 2, 3)) / count.clamp(min=1)
    return torch.where(count > 0, mean.sqrt(), torch.nan).tolist()
