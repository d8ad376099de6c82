"""A quick experiment: train the tiny system twice, with one setting changed the second time, and compare the two.

Both arms see the same scenes in the same order, with the same seed and as many steps; both are scored on the same
frames, so differences are paired. Only what a setting touches is trained again. A tiny
system trained for minutes says which way a change points, not how good the shipped system would become by it.
"""

import hashlib
import inspect
import json
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..config import Config, override, preset, to_dict
from ..data import SAMPLES, read_sample, sample_folders
from ..evaluation.scoring import DITR, run_methods
from ..evaluation.statistics import compare_seeds, format_interval, interval, mean_known, paired_bootstrap, seed_verdict
from ..pipeline import Ditr, build
from ..store import CARD, load_part, read_card, save_part
from ..training.loop import Recipe
from ..training.parts import PARTS, check_same_system, folder_name, train_on
from ..training.scenes import Scenes, checksum, load_scenes
from ..unet import BLOCKS

SCORED = ("optical", "geometric")  # Table V's two kinds of loss
QUICK = {
    "autoencoder": Recipe(steps=800, batch=8, lr=2e-3, warmup=50, decay=0.98),
    "region": Recipe(steps=200, batch=8, lr=2e-3, warmup=50, decay=0.98),
    "optical": Recipe(steps=500, batch=8, lr=2e-3, warmup=50, decay=0.98),
    "geometric": Recipe(steps=300, batch=8, lr=2e-3, warmup=50, decay=0.98),
    "detail": Recipe(steps=300, batch=8, lr=2e-3, warmup=50, decay=0.98),
}
TOUCHES = {  # what has to be trained again when a setting, or one below it, changes
    "size": PARTS,
    "window": ("autoencoder", "optical", "geometric", "detail"),
    "region": ("region",),
    "refine": (),
    "refine.looks": ("region",),  # it is trained at the size of the first
    "autoencoder": ("autoencoder", "optical", "geometric", "detail"),
    "schedule": ("optical", "geometric", "detail"),
    "unet": ("optical", "geometric", "detail"),
    "sampler.prediction": ("optical", "geometric", "detail"),
    "sampler.objective": ("optical", "geometric", "detail"),
    "sampler.steps": (),
    "sampler.samples": (),
    "sampler.eta": (),
    "evidence": ("optical", "detail"),
    "std": (),
    "detail": ("detail",),
}
STAGE_ONE = ("region", "refine")  # settings that say nothing while the true region is given
DECISIVE = (  # files and folders of the package that decide how an arm is trained; another text there, another arm
    *("units.py", "config.py", "conditioning.py", "windows.py", "schedule.py", "diffusion.py"),
    *("region", "boundary", "autoencoder.py", "unet.py", "detail.py", "stage_two.py", "pipeline.py", "data.py"),
    *("training/scenes.py", "training/views.py", "training/augment.py", "training/batches.py"),
    *("training/recipes.py", "training/losses.py", "training/loop.py", "training/parts.py"),
)


def compare_settings(
    settings: Mapping[str, Any],
    data: Path | str | None = None,
    val: Path | str = SAMPLES / "val",
    folder: Path | str = "outputs/weights",
    out: Path | str | None = None,
    work: Path | str | None = None,
    recipes: Mapping[str, Recipe] = QUICK,
    steps: int | None = None,
    limit: int | None = None,
    frames: int | None = None,
    seed: int = 0,
    boundary: str = "classical",
    command: str | None = None,
) -> dict[str, Any]:
    """Train the tiny preset as it is and with ``settings``, and score both.

    Args:
        settings: dotted setting -> value, as text or not: ``{"unet.heads": 1}``.
        data: folder of rendered scenes to train on besides the shipped ones.
        val: folder of rendered scenes to score on. They keep their size: depth is resized as for any frame.
        folder: the arms go to ``tiny/default``, kept for the next experiment, and ``tiny/SETTINGS`` in it.
        out: weights folder of the changed system instead.
        work: folder for checkpoints; a temporary one by default.
        recipes: part -> how it is trained.
        steps: of every part instead of the recipe's.
        limit: train on the first scenes only.
        frames: score the first frames only.
        seed: of everything random, in both arms.
        boundary: backend of the guides in training.
        command: that asked for it, for the cards.

    Returns:
        ``settings``; ``trained``, the parts that were trained again; ``region``, "given" or "found"; ``scenes``,
        ``frames``, ``seed``; ``seconds``, per arm, 0 for one that was kept; ``rmse_m``: arm -> "optical" and
        "geometric" -> one value a frame or None; ``difference``: the same sets -> [mean, low, high] of changed minus
        default, 95 % over frames, None without a common frame.

    Raises:
        ValueError: for unknown settings, settings that change nothing or cannot be, folders without scenes, or an
            ``out`` that holds another system.
    """
    base = preset("tiny")
    config, trained = override(base, **settings), touched(base, settings)
    check_block(config.unet.block)
    Ditr(build(config), config)  # what cannot be is refused before the other arm is trained
    if out is not None:
        check_same_system(config, out)
    if steps is not None:
        recipes = {part: replace(recipe, steps=steps) for part, recipe in recipes.items()}
    home = Path(folder) / "tiny"
    names = {"default": "default", "changed": folder_name(settings)}
    paths = {"default": home / "default", "changed": Path(out) if out else home / names["changed"]}
    found = any(key.split(".")[0] in STAGE_ONE for key in settings)
    scored = sample_folders(val)[:frames]
    if not scored:
        raise ValueError(f"no scenes in {val} to score on: make them with `python -m ditr_lite simulate`")
    samples = [read_sample(path) for path in scored]
    scenes = some_scenes([SAMPLES / "train"] + ([Path(data)] if data else []), limit)
    seconds, rmse = {}, {}
    with tempfile.TemporaryDirectory() as temporary:
        spare = Path(work or temporary)
        for arm, given in (("default", base), ("changed", config)):
            start = None if arm == "default" else (paths["default"], trained)
            own = arm == "default" or out is None
            seconds[arm] = train_arm(
                given, scenes, paths[arm], spare / names[arm], recipes, seed, boundary, start, own, command
            )
    for arm, path in paths.items():
        rows = run_methods(samples, Ditr.from_pretrained(path=path), {}, given_region=not found)
        scores = [row["methods"][DITR] for row in rows]
        rmse[arm] = {k: [each[k] and each[k]["rmse"] for each in scores] for k in SCORED}
    return {
        "settings": {key: str(value) for key, value in settings.items()},
        "trained": list(trained),
        "region": "found" if found else "given",
        "scenes": sum(map(len, scenes)),
        "frames": len(samples),
        "seed": seed,
        "seconds": seconds,
        "rmse_m": rmse,
        "difference": {k: interval(paired_bootstrap, rmse["changed"][k], rmse["default"][k]) for k in SCORED},
    }


def compare_over_seeds(
    settings: Mapping[str, Any],
    seeds: Sequence[int] = (0, 1),
    folder: Path | str = "outputs/weights",
    work: Path | str | None = None,
    **how: Any,
) -> dict[str, Any]:
    """Run :func:`compare_settings` once per seed: what another training would change is no effect of a setting.

    Args:
        settings: as for :func:`compare_settings`.
        seeds: of everything random, each of both arms.
        folder: as there for the first seed; the others' arms go to ``seed_N`` in it.
        work: likewise.
        how: the other arguments of :func:`compare_settings`; ``out`` only with one seed.

    Returns:
        ``seeds``; ``runs``, a result of :func:`compare_settings` per seed; ``difference``: "optical" and "geometric" ->
        None without a common frame, or, in metres, changed minus default: ``mean``, ``low`` and ``high`` (95 % over
        frames) of the mean over seeds, ``by_seed``, ``spread`` (their standard deviation, None of one seed),
        ``seeds_apart`` and ``clear`` as :class:`evaluation.statistics.SeedComparison` has them.

    Raises:
        ValueError: without seeds, for ``out`` with several, and as :func:`compare_settings` does.
    """
    if not seeds or (len(seeds) > 1 and how.get("out") is not None):
        raise ValueError(f"expected at least one seed, and exactly one where out is given; got {list(seeds)}")
    runs = []
    for seed in seeds:
        homes = {"folder": home_of(folder, seed, seeds), "work": work and home_of(work, seed, seeds)}
        runs.append(compare_settings(settings, seed=seed, **homes, **how))
    return {"seeds": list(seeds), "runs": runs, "difference": {key: _over_seeds(runs, key) for key in SCORED}}


def home_of(folder: Path | str, seed: int, seeds: Sequence[int]) -> Path | str:
    """Return where a seed's arms go: those of the first seed into ``folder``, those of another to ``seed_N`` in it."""
    return folder if seed == seeds[0] else Path(folder) / f"seed_{seed}"


def _over_seeds(runs: Sequence[Mapping[str, Any]], key: str) -> dict[str, Any] | None:
    """Return an entry of ``difference`` of :func:`compare_over_seeds`."""
    default, changed = (frames_by_seed(runs, arm, key) for arm in ("default", "changed"))
    if not default.size:
        return None
    found = compare_seeds(changed, default)
    by_seed = (changed - default).mean(axis=1)
    return {
        "mean": found.mean,
        "low": found.low,
        "high": found.high,
        "by_seed": by_seed.tolist(),
        "spread": float(by_seed.std(ddof=1)) if len(runs) > 1 else None,
        "seeds_apart": found.seeds,
        "clear": found.clear,
    }


def frames_by_seed(runs: Sequence[Mapping[str, Any]], arm: str, key: str) -> np.ndarray:
    """Return an arm's RMSE (seeds, frames) in metres, without the frames that hold no such pixel."""
    seen = np.array([run["rmse_m"][arm][key] for run in runs], dtype=np.float64)  # None becomes NaN, for every seed
    return seen[:, ~np.isnan(seen).any(axis=0)]


def some_scenes(homes: Sequence[Path], limit: int | None = None) -> list[Scenes]:
    """Read the scenes of several folders, the first ``limit`` of all of them together."""
    groups = []
    for home in homes:
        left = None if limit is None else limit - sum(map(len, groups))
        if left != 0:
            groups.append(load_scenes(home, left))
    return groups


def check_block(name: str) -> None:
    """Refuse a building block of the U-Net that does not map (B, Cin, H, W) and time (B, Ct) to (B, C, H, W).

    Raises:
        ValueError: with what was expected and what happened.
    """
    x, time, expected = torch.zeros(2, 3, 6, 4), torch.zeros(2, 7), (2, 5, 6, 4)
    try:
        got = tuple(BLOCKS[name](3, 5, 7)(x, time).shape)
    except (TypeError, RuntimeError, AttributeError) as error:
        got = " ".join(str(error).split())
    if got != expected:
        raise ValueError(
            f"unet.BLOCKS[{name!r}]: expected block(in_channels, channels, time_channels) whose call (x, time) maps "
            f"{tuple(x.shape)} and {tuple(time.shape)} to {expected} for block(3, 5, 7); got {got}"
        )


def touched(base: Config, settings: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the parts that must be trained again when ``settings`` change ``base``, in the order of training.

    Raises:
        ValueError: for unknown settings, or when the result is no other system.
    """
    config = override(base, **settings)
    if not settings or replace(config, name=base.name) == base:
        raise ValueError("nothing is changed: give settings other than the tiny preset's, like unet.heads=1")
    keys = [key for key in TOUCHES for setting in settings if f"{setting}.".startswith(f"{key}.")]
    parts = {part for key in keys for part in TOUCHES[key]}
    return tuple(p for p in PARTS if p in parts and (p != "detail" or config.detail.width))


def train_arm(
    config: Config,
    scenes: Sequence[Scenes],
    folder: Path,
    work: Path,
    recipes: Mapping[str, Recipe],
    seed: int,
    boundary: str,
    start: tuple[Path, Sequence[str]] | None = None,
    own: bool = True,
    command: str | None = None,
) -> float:
    """Train one arm, unless ``folder`` holds the very same already, and return the seconds that it took.

    Args:
        config: of the arm.
        scenes: groups of scenes to train on.
        folder: for the weights.
        work: for checkpoints.
        recipes: per part.
        seed: of everything random.
        boundary: backend of the guides.
        start: (folder, parts): train only these and copy the others from there; None trains all.
        own: whether weights of another configuration in ``folder`` may go; otherwise they are refused.
        command: that asked for it, for the card.
    """
    key = _key(config, scenes, recipes, seed, boundary, start and start[1])
    parts = [p for p in PARTS if p != "detail" or config.detail.width]
    if _kept(folder, parts, key):
        return 0.0
    if own:
        (folder / CARD).unlink(missing_ok=True)
    check_same_system(config, folder)
    begun = time.monotonic()
    for part in parts:
        if start is None or part in start[1]:
            how = {"seed": seed, "command": command, "boundary": boundary, "key": key}
            train_on(part, config, scenes, None, folder, work, recipes[part], **how)
        else:
            notes = read_card(start[0])["parts"][part]
            save_part(part, load_part(part, start[0]), config, folder, {**notes, "copied": str(start[0]), "key": key})
    return time.monotonic() - begun


def format_comparison(result: Mapping[str, Any]) -> str:
    """Return :func:`compare_settings`'s result as text."""
    changed = ", ".join(f"{key}={value}" for key, value in result["settings"].items())
    width = max(len(changed), len("tiny as it is"))
    trained = ", ".join(result["trained"]) or "nothing"
    lines = [f"{result['scenes']} scenes to train on, seed {result['seed']}; trained again: {trained}"]
    lines += [
        f"{result['frames']} frames, region {result['region']}; RMSE mm, the mean over frames of the frame's value"
    ]
    lines += ["".ljust(width) + "".join(key.rjust(26) for key in SCORED)]
    for arm, title in (("default", "tiny as it is"), ("changed", changed)):
        means = [mean_known(result["rmse_m"][arm][key]) for key in SCORED]
        cells = ["-" if mean is None else f"{1000 * mean:.1f}" for mean in means]
        lines.append(title.ljust(width) + "".join(cell.rjust(26) for cell in cells))
    cells = [format_interval(result["difference"][key], 1000) for key in SCORED]
    lines.append("difference".ljust(width) + "".join(cell.rjust(26) for cell in cells))
    lines.append("[95 % interval], paired over frames. Training has its own chance: see whether another seed agrees.")
    return "\n".join(lines)


def format_seeds(result: Mapping[str, Any]) -> str:
    """Return :func:`compare_over_seeds`'s result as text: a line per seed, and a verdict per kind of loss."""
    first = result["runs"][0]
    changed = ", ".join(f"{key}={value}" for key, value in first["settings"].items())
    lines = [f"{first['scenes']} scenes to train on; trained again: {', '.join(first['trained']) or 'nothing'}"]
    lines += [f"{first['frames']} frames, region {first['region']}; RMSE mm, tiny as it is -> {changed}"]
    lines += ["".ljust(12) + "".join(key.rjust(20) for key in SCORED)]
    for run in result["runs"]:
        cells = [f"seed {run['seed']}".ljust(12)]
        for key in SCORED:
            means = [mean_known(run["rmse_m"][arm][key]) for arm in ("default", "changed")]
            cells.append(("-" if None in means else "{:.1f} -> {:.1f}".format(*(1000 * m for m in means))).rjust(20))
        lines.append("".join(cells))
    for key in SCORED:
        if result["difference"][key] is None:
            lines.append(f"{key}: no frame holds such pixels")
            continue
        arms = [frames_by_seed(result["runs"], arm, key) for arm in ("changed", "default")]
        lines.append(seed_verdict(f"{key}, {changed}", *arms, "tiny as it is"))
    lines.append("[95 % interval] over frames, paired; clear: it excludes 0, and the seeds of an arm differ by less.")
    return "\n".join(lines)


def decisive_files() -> list[Path]:
    """Return the files of :data:`DECISIVE`, whose texts an arm depends on."""
    package = Path(__file__).parents[1]
    files = []
    for name in DECISIVE:
        files += [package / name] if name.endswith(".py") else sorted((package / name).glob("*.py"))
    return files


def _key(config: Config, scenes: Sequence[Scenes], recipes: Mapping[str, Recipe], *others: Any) -> str:
    """Return a checksum of all that an arm depends on: sizes, recipes, pictures, and the code that trains it.

    A block of the reader's own (``unet.BLOCKS``) is code as well; where its source cannot be read, nothing is kept.
    """
    rates = {part: asdict(r) for part, r in recipes.items()}
    plain = [to_dict(config), rates, checksum(*scenes), others, torch.__version__]
    digest = hashlib.sha256(json.dumps(plain).encode())
    for source in decisive_files():
        digest.update(source.read_bytes())
    try:
        digest.update(inspect.getsource(BLOCKS[config.unet.block]).encode())
    except (OSError, TypeError):
        digest.update(os.urandom(16))
    return digest.hexdigest()


def _kept(folder: Path, parts: Sequence[str], key: str) -> bool:
    try:
        card = read_card(folder)["parts"]
        return all(card[p]["key"] == key and load_part(p, folder) for p in parts)
    except (ValueError, KeyError):  # none, damaged, or trained by something else
        return False
