"""What trains: ``train`` and ``train-boundary``.

``train --preset tiny`` with settings is a quick experiment, ``train --start`` fine-tunes. Several processes are started
by ``torchrun --nproc-per-node N -m ditr_lite train ...`` or ``accelerate launch -m ditr_lite train ...``.
"""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from .evaluate import add_dataset_name, check_results, say_if_few
from .shared import (
    MAKE_TRAIN,
    MAKE_VAL,
    MAX_SEED,
    add_depth_scale,
    check_folder,
    check_scenes,
    command_line,
    has_scenes,
    real,
    seed,
    setting,
    whole,
)

TRAIN = (Path("outputs/scenes/train"), Path("outputs/scenes/rooms_train"))  # those that are there
VAL = ("val", "rooms_val")  # shipped splits, likewise
BOUNDARY = Path("outputs/weights/boundary")
RATE = real(0, 1, "a learning rate")


class Train:
    """Train one part, or all in the order in which they need each other, and write weights and card."""

    @staticmethod
    def add_arguments(p: ArgumentParser) -> None:
        """Add what ``train`` takes."""
        p.add_argument("--part", default="all", help="all (default), autoencoder, region, optical, geometric or detail")
        p.add_argument("--preset", help="sizes: tiny, lite (default) or paper")
        p.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="KEY=VALUE",
            help="change a setting: unet.width=48; with --preset tiny and all parts, compare with tiny as it is: a "
            "quick experiment of minutes on the shipped scenes",
        )
        p.add_argument(
            "--data",
            type=Path,
            nargs="+",
            metavar="DIR",
            help="folders of scenes to train on (default: outputs/scenes/train and rooms_train, where they are); in a "
            "comparison, one besides the shipped ones",
        )
        p.add_argument(
            "--val",
            type=Path,
            nargs="+",
            metavar="DIR",
            help="folders of scenes to validate on (default: the shipped val and rooms_val)",
        )
        p.add_argument(
            "--out", type=Path, help="weights folder (default: outputs/weights/PRESET); required where it holds others"
        )
        p.add_argument("--work", type=Path, help="folder for checkpoints and logs (default: in outputs/training)")
        p.add_argument(
            "--start",
            type=Path,
            help="fine-tune the weights of this folder, e.g. ditr_lite/weights, by a gentle recipe of its own; needs "
            "--data or --dataset, and --out; what does not help is not kept",
        )
        p.add_argument("--boundary", default="classical", help="backend of the boundary maps (%(default)s)")
        add_dataset(p)
        add_engine(p)
        p.add_argument("--seeds", type=whole(1, 100), default=1, help="of a comparison: train each arm so often (1)")
        p.add_argument("--json", type=Path, help="of a comparison: also write every frame's errors to this file")
        p.add_argument(
            "--every",
            type=whole(),
            help="steps between validations, each with a checkpoint (default: 500, in fine-tuning 20)",
        )
        p.add_argument("--cost", action="store_true", help="only print what the training would cost")
        add_recipe(p, "steps instead of the recipe's")

    @staticmethod
    def run(options: Namespace) -> None:
        """Train and print where the weights are and how good."""
        from ..config import override, preset
        from ..training import parts as fitting
        from ..training.loop import is_first, leave

        if options.part not in ("all", *fitting.PARTS):
            raise ValueError(f"unknown part {options.part!r}; choose all or one of {', '.join(fitting.PARTS)}")
        if options.start is not None and options.preset is not None:
            raise ValueError("--start goes on with the sizes of its weights: leave out --preset")
        options.preset = options.preset or "lite"
        settings = dict(map(setting, options.set))
        tiny = options.preset == "tiny" and settings and options.part == "all" and not options.dataset
        if tiny and options.start is None:
            return experiment(options, settings)
        if options.json or options.seeds > 1:
            raise ValueError(
                "--seeds and --json are of a comparison: give --preset tiny and --set KEY=VALUE, all parts"
            )
        if options.start is not None:
            return fine_tune(options, settings)
        config = override(preset(options.preset), **settings)
        data, val = folders(options)
        real = real_frames(options)
        tag = "-".join([options.preset, *([fitting.folder_name(settings)] if settings else [])])
        out = options.out or Path("outputs/weights") / tag
        work = options.work or Path("outputs/training") / tag
        for folder in (out, work):
            check_folder(folder, _is_of_training, "weights and checkpoints")
        has = [p for p in fitting.PARTS if p != "detail" or config.detail.width]
        chosen = has if options.part == "all" else [options.part]
        if options.out is None:
            check_replaced(out, chosen, command_line(options))
        for part in chosen:
            recipe = recipe_of(options, part, count_frames(options, data, real))
            show_cost(options, part, config, recipe)
            if options.cost:
                continue
            how = {"limit": options.limit, "seed": options.seed, "boundary": options.boundary}
            how |= {"command": command_line(options), "engine": engine_of(options), "real": real} | every_of(options)
            notes = fitting.train(part, config, data, val, out=out, work=work, recipe=recipe, **how)
            last = {k: v for k, v in (notes["curve"] or [{}])[-1].items() if "step" not in k and "second" not in k}
            figures = ", ".join(f"{k} {v:.4f}" for k, v in last.items())
            if is_first():
                print(f"{Path(out) / part}.safetensors: {notes['steps']} steps, {notes['seconds']:.0f} s; {figures}")
        leave()


class TrainBoundary:
    """Train the learned boundary backend and write its weights and its entry in the card."""

    @staticmethod
    def add_arguments(p: ArgumentParser) -> None:
        """Add what ``train-boundary`` takes."""
        p.add_argument("--data", type=Path, default=TRAIN[0], help="scenes to train on (%(default)s)")
        p.add_argument("--val", type=Path, help="scenes to validate on (default: the shipped val split)")
        p.add_argument("--out", type=Path, default=BOUNDARY, help="weights folder (%(default)s)")
        p.add_argument(
            "--work", type=Path, default=Path("outputs/training"), help="for checkpoints and logs (%(default)s)"
        )
        add_engine(p)
        add_recipe(p, "steps of the colour network instead of the recipe's; the depth network takes a third")

    @staticmethod
    def run(options: Namespace) -> None:
        """Train and print where the weights are and how good."""
        from ..data import SAMPLES
        from ..training.boundary import train_boundary
        from ..training.loop import is_first, leave

        val = options.val or SAMPLES / "val"
        check_scenes([options.data], MAKE_TRAIN)
        check_scenes([val], MAKE_VAL)
        for folder in (options.out, options.work):
            check_folder(folder, _is_of_training, "weights and checkpoints")
        how = (options.out, options.work, options.limit, options.seed, command_line(options), engine_of(options))
        notes = train_boundary(options.data, val, *how, **changes(options))
        if is_first():
            each = (f"{m} F {notes[m]['val_f']:.3f} at threshold {notes[m]['threshold']}" for m in ("rgb", "depth"))
            print(f"{options.out / 'boundary'}.safetensors: {'; '.join(each)} (validation)")
        leave()


def fine_tune(options: Namespace, settings: dict[str, str]) -> None:
    """Fine-tune one part or all, print what that did to held-out frames, and keep the better weights."""
    from dataclasses import replace

    from ..config import override
    from ..store import read_config
    from ..training import adapt, parts
    from ..training.loop import is_first, leave

    if options.out is None:
        raise ValueError("--start needs --out, a folder for the new weights: those to start from are never replaced")
    adapt.check_out(options.out, options.start)
    config = override(read_config(options.start), **settings)
    work = options.work or Path("outputs/training") / f"from-{Path(options.start).name}-{Path(options.out).name}"
    for folder in (options.out, work):
        check_folder(folder, _is_of_training, "weights and checkpoints")
    has = [p for p in parts.PARTS if p in adapt.RECIPES and (p != "detail" or config.detail.width)]
    if options.part not in ("all", *has):  # before frames are decoded for it
        raise ValueError(f"cannot fine-tune {options.part!r}: choose all or one of {', '.join(has)}")
    engine = engine_of(options)
    for part in has if options.part == "all" else [options.part]:
        recipe = replace(adapt.RECIPES[part], **changes(options))
        show_cost(options, part, config, recipe)
        if options.cost:
            continue
        pool, held_out = own_frames(options, part, config)
        how = {"seed": options.seed, "boundary": options.boundary, "command": command_line(options)}
        how |= {"engine": engine} | every_of(options)
        notes = adapt.adapt(part, config, pool, held_out, options.start, options.out, work, recipe, **how)
        if is_first():
            print(judgement(part, notes))
            if notes["best_step"]:  # otherwise nothing was judged
                say_if_few(len(notes["judged"]["before"]))
    leave()


def judgement(part: str, notes: dict) -> str:
    """Return in words what fine-tuning did to the frames that judge it."""
    from ..evaluation.statistics import format_interval, paired_bootstrap
    from ..training.adapt import WATCHED

    judged = notes["judged"]
    if not notes["best_step"]:
        first, *later = [row[WATCHED] for row in notes["curve"]]
        return (
            f"{part}: no step lowered the error of the held-out frames that choose ({first:.4f} at the start, "
            f"{min(later):.4f} at best later): the weights of the start are kept, and nothing was left to judge"
        )
    before, after = judged["before"], judged["after"]
    means = [sum(errors) / len(errors) for errors in (before, after)]
    difference = paired_bootstrap(after, before)
    said = "helped" if difference[2] < 0 else "harmed" if difference[1] > 0 else "made no measurable difference"
    kept = f"the fine-tuned weights of step {notes['best_step']} are kept"
    if judged["kept"] == "start":
        kept = "the weights of the start are kept"
    kind = "1 - IoU" if part == "region" else "relative RMSE"
    return (
        f"{part}: {kind} of {len(before)} held-out frames {means[0]:.4f} before, {means[1]:.4f} after, difference "
        f"{format_interval(difference, 1, '+.4f')}: fine-tuning {said}; {kept}"
    )


def own_frames(options: Namespace, part: str, config):
    """Return what fine-tuning draws from, and the frames that it is judged by."""
    from ..data import SAMPLES
    from ..training.adapt import hold_out, mixed
    from ..training.scenes import join, load_scenes

    real = real_frames(options)
    if real is None and not options.data:
        raise ValueError(
            "--start needs frames to learn from: --dataset NAME --root DIR (of your own: --dataset folder), or "
            "--data DIR with rendered scenes"
        )
    own = [load_scenes(folder, options.limit) for folder in options.data or []]
    own += real.scenes(part, config, real.split) if real else []
    if both := {Path(f).resolve() for f in options.val or []} & {Path(f).resolve() for f in options.data or []}:
        raise ValueError(f"{both.pop()} is given as --data and as --val: frames that are trained on cannot judge")
    held_out = [load_scenes(folder) for folder in options.val or []]
    if real and (real.val_split or real.val_root):
        held_out += real.held_out(part, config).values()
    if not held_out:
        own, held_out = hold_out(own)
    share = 0.5 if options.scene_share is None else options.scene_share
    if share and not (SAMPLES / "train").is_dir():
        raise ValueError(f"no shipped training scenes in {SAMPLES}: only a clone has them; --scene-share 0 needs none")
    first = [load_scenes(SAMPLES / "train")] if share else []
    return mixed(own, first, share), join(held_out, config.size)


def real_frames(options: Namespace):
    """Return the frames of a dataset that the command line names, or None."""
    if options.dataset is None:
        of_datasets = ["root", "split", "val_split", "val_root", "depth_scale", "zero_region"]
        if options.start is None:  # in fine-tuning the share is that of the shipped scenes
            of_datasets.append("scene_share")
        if given := [k for k in of_datasets if getattr(options, k)]:
            raise ValueError(f"--{given[0].replace('_', '-')} is of --dataset NAME")
        return None
    from ..training.readers import RealFrames

    if options.root is None:
        raise ValueError(f"--dataset {options.dataset} needs --root DIR, the folder that holds it")
    share = options.scene_share
    if share is None:
        share = 0.5 if options.data and options.start is None else 0.0
    how = {key: getattr(options, key) for key in ("val_split", "val_root", "depth_scale", "zero_region", "limit")}
    return RealFrames(options.dataset, options.root, options.split, scene_share=share, **how)


def check_replaced(out: Path, parts: list[str], command: str) -> None:
    """Refuse to replace weights that another command made, where nobody said where to put the new ones."""
    from ..store import CARD, read_card

    if not (out / CARD).is_file():
        return
    there = read_card(out)["parts"]
    if other := [p for p in parts if p in there and there[p].get("command") != command]:
        made = there[other[0]].get("command")
        raise ValueError(
            f"{out} holds {other[0]!r} by another command ({made}): give --out FOLDER, this one or another"
        )


def recipe_of(options: Namespace, part: str, frames: int):
    """Return how a part is trained: the preset's recipe with what the command line changes of it."""
    from dataclasses import replace

    from ..training.as_the_paper import paper_recipe
    from ..training.recipes import RECIPES

    recipe = paper_recipe(part, frames) if options.preset == "paper" and part != "detail" else RECIPES[part]
    return replace(recipe, **changes(options))


def count_frames(options: Namespace, data: list[Path], real) -> int:
    """Return how many frames an epoch has."""
    from ..data import sample_folders

    count = 0
    if real is None or real.scene_share:
        count += sum(len(sample_folders(folder)[: options.limit]) for folder in data)
    if real is not None:
        from ..datasets import REGISTRY

        count += len(REGISTRY[real.name](real.root, real.split).names[: real.limit])
    return count


def show_cost(options: Namespace, part: str, config, recipe) -> None:
    """Print the arithmetic of a training before it starts: for the paper's preset, or where it is asked for."""
    if options.preset != "paper" and not options.cost:
        return
    from ..evaluation.training_costs import conv_rate, format_cost
    from ..training.loop import is_first

    processes = engine_of(options).start().num_processes  # joins the others, which whoever asks first decides
    if is_first():
        print(format_cost(part, config, recipe, processes * options.accumulate, processes * conv_rate()), flush=True)


def experiment(options: Namespace, settings: dict[str, str]) -> None:
    """Train the tiny preset as it is and with settings changed, score both on the same frames, and compare them."""
    from dataclasses import replace

    from ..evaluation import results
    from ..studies.experiment import QUICK, compare_over_seeds, format_comparison, format_seeds
    from ..training.loop import is_first, leave

    check_results(options.json)
    if options.seeds > 1 and options.out:
        raise ValueError("--out is one weights folder, of one seed: leave out --seeds, or --out")
    if options.seed + options.seeds - 1 > MAX_SEED:
        raise ValueError(f"--seed {options.seed} leaves no {options.seeds} seeds: the largest is {MAX_SEED}")
    if options.every is not None:
        raise ValueError("--every is of a training that is resumed: a comparison of settings always runs to its end")
    asked = {"accumulate": 1, "workers": 0, "precision": "auto", "cpu": False, "cost": False, "zero_region": False}
    asked |= dict.fromkeys(("root", "split", "val_split", "val_root", "depth_scale", "scene_share"))
    if given := [name for name, default in asked.items() if getattr(options, name) != default]:
        raise ValueError(f"a comparison of settings takes no --{given[0].replace('_', '-')}; training one --part does")
    for name in ("data", "val"):
        if len(getattr(options, name) or []) > 1:
            raise ValueError(f"a comparison takes one folder of scenes as --{name}, got {len(getattr(options, name))}")
    recipes = {part: replace(recipe, **changes(options)) for part, recipe in QUICK.items()}
    how = {name: getattr(options, name) for name in ("out", "work", "limit", "boundary")}
    how |= {name: (getattr(options, name) or [None])[0] for name in ("data", "val")}
    how = {name: value for name, value in how.items() if value is not None}
    seeds = range(options.seed, options.seed + options.seeds)
    result = compare_over_seeds(settings, seeds, recipes=recipes, command=command_line(options), **how)
    if is_first():
        print(format_seeds(result) if len(seeds) > 1 else format_comparison(result["runs"][0]))
        if options.json:
            results.write(options.json, {"command": command_line(options), "versions": results.versions()}, result)
    leave()


def add_dataset(p: ArgumentParser) -> None:
    """Add the arguments that choose frames of a real dataset."""
    add_dataset_name(p, "train on a real dataset; with --data, mixed with scenes")
    p.add_argument("--root", type=Path, help="the folder that holds the dataset")
    p.add_argument("--split", help="of the dataset, to train on (default: all of it)")
    p.add_argument("--val-split", help="of the dataset, to validate on besides the scenes")
    p.add_argument("--val-root", type=Path, help="another folder of the same layout, to validate on besides the scenes")
    add_depth_scale(p)
    p.add_argument(
        "--scene-share",
        type=real(0, 1, "a share", closed=True),
        metavar="SHARE",
        help="share of the draws that are rendered scenes (default: 0.5 where --data is given beside --dataset, "
        "otherwise 0; in fine-tuning 0.5, of the shipped training scenes)",
    )
    p.add_argument(
        "--zero-region",
        action="store_true",
        help="set the dataset's readings inside the region to zero (the paper, on ClearGrasp)",
    )


def add_engine(p: ArgumentParser) -> None:
    """Add the arguments that say on what and how a training runs; several processes are started by torchrun."""
    p.add_argument("--accumulate", type=whole(), default=1, help="parts of a batch taken in turn, for less memory (1)")
    p.add_argument("--workers", type=whole(0), default=0, help="processes that prepare batches (%(default)s)")
    p.add_argument("--precision", default="auto", help="auto (default; bfloat16 where the GPU has it), no or bf16")
    p.add_argument("--cpu", action="store_true", help="use no GPU")


def engine_of(options: Namespace):
    """Return on what and how a training runs, having joined the other processes where there are any."""
    from ..training.loop import Engine

    engine = Engine(options.accumulate, options.workers, options.precision, options.cpu)
    engine.start()
    return engine


def add_recipe(p: ArgumentParser, steps: str) -> None:
    """Add the arguments that change a recipe."""
    p.add_argument("--steps", type=whole(), help=steps)
    p.add_argument("--batch", type=whole(), help="frames a step instead of the recipe's")
    p.add_argument("--lr", type=RATE, help="peak learning rate instead of the recipe's")
    p.add_argument("--limit", type=whole(), help="use only the first scenes")
    p.add_argument("--seed", type=seed, default=0, help="of everything random (%(default)s)")


def every_of(options: Namespace) -> dict[str, int]:
    """Return how often to validate and to write a checkpoint where the command line says so."""
    return {} if options.every is None else {"every": options.every}


def changes(options: Namespace) -> dict[str, float]:
    """Return what the command line changes of a recipe."""
    return {key: getattr(options, key) for key in ("steps", "batch", "lr") if getattr(options, key) is not None}


def folders(options: Namespace) -> tuple[list[Path], list[Path]]:
    """Return the folders to train and to validate on; refuse those without scenes."""
    from ..data import SAMPLES

    data = options.data or [folder for folder in TRAIN if has_scenes(folder)] or [TRAIN[0]]
    if getattr(options, "dataset", None) and not options.data:
        data = []
    val = options.val or [SAMPLES / split for split in VAL if has_scenes(SAMPLES / split)] or [SAMPLES / VAL[0]]
    check_scenes(data, MAKE_TRAIN)
    check_scenes(val, MAKE_VAL)
    return data, val


def _is_of_training(path: Path) -> bool:
    """Return whether something in a folder is of weights, results about them or checkpoints."""
    return (
        path.is_dir()
        or path.name == "NOTICE"
        or path.suffix in (".safetensors", ".json", ".jsonl", ".md", ".txt", ".log")
    )
