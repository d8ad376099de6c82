"""What trains: ``train`` (with ``--preset tiny`` and settings: a quick experiment) and ``train-boundary``."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from .shared import MAKE_TRAIN, MAKE_VAL, check_folder, check_scenes, command_line, has_scenes, real, seed, whole

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
        p.add_argument("--preset", default="lite", help="sizes: tiny, lite (default) or paper")
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
        p.add_argument("--out", type=Path, help="weights folder (default: outputs/weights/PRESET)")
        p.add_argument("--work", type=Path, help="folder for checkpoints and logs (default: in outputs/training)")
        p.add_argument(
            "--start", type=Path, help="weights folder to go on from (default: afresh), e.g. the shipped one"
        )
        p.add_argument("--boundary", default="classical", help="backend of the boundary maps (%(default)s)")
        add_recipe(p, "steps instead of the recipe's")

    @staticmethod
    def run(options: Namespace) -> None:
        """Train and print where the weights are and how good."""
        from dataclasses import replace

        from ..config import override, preset
        from ..training import parts as fitting
        from ..training.recipes import RECIPES

        if options.part not in ("all", *fitting.PARTS):
            raise ValueError(f"unknown part {options.part!r}; choose all or one of {', '.join(fitting.PARTS)}")
        settings = dict(_setting(text) for text in options.set)
        config = override(preset(options.preset), **settings)
        if options.preset == "tiny" and settings and options.part == "all":
            return experiment(options, settings)
        data, val = folders(options)
        tag = "-".join([options.preset, *([fitting.folder_name(settings)] if settings else [])])
        out = options.out or Path("outputs/weights") / tag
        work = options.work or Path("outputs/training") / tag
        for folder in (out, work):
            check_folder(folder, _is_of_training, "weights and checkpoints")
        for part in fitting.PARTS if options.part == "all" else [options.part]:
            recipe = replace(RECIPES[part], **changes(options))
            how = (options.limit, options.seed, options.boundary, options.start, command_line(options))
            notes = fitting.train(part, config, data, val, out, work, recipe, *how)
            last = {k: v for k, v in (notes["curve"] or [{}])[-1].items() if "step" not in k and "second" not in k}
            figures = ", ".join(f"{k} {v:.4f}" for k, v in last.items())
            print(f"{Path(out) / part}.safetensors: {notes['steps']} steps, {notes['seconds']:.0f} s; {figures}")


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
        add_recipe(p, "steps of the colour network instead of the recipe's; the depth network takes a third")

    @staticmethod
    def run(options: Namespace) -> None:
        """Train and print where the weights are and how good."""
        from ..data import SAMPLES
        from ..training.boundary import train_boundary

        val = options.val or SAMPLES / "val"
        check_scenes([options.data], MAKE_TRAIN)
        check_scenes([val], MAKE_VAL)
        how = (options.out, options.work, options.limit, options.seed, command_line(options))
        notes = train_boundary(options.data, val, *how, **changes(options))
        each = (f"{m} F {notes[m]['val_f']:.3f} at threshold {notes[m]['threshold']}" for m in ("rgb", "depth"))
        print(f"{options.out / 'boundary'}.safetensors: {'; '.join(each)} (validation)")


def experiment(options: Namespace, settings: dict[str, str]) -> None:
    """Train the tiny preset as it is and with settings changed, score both on the same frames, and compare them."""
    from dataclasses import replace

    from ..studies.experiment import QUICK, compare_settings, format_comparison

    if options.start:
        raise ValueError("a comparison trains both systems afresh: leave --start out, or train one --part with it")
    for name in ("data", "val"):
        if len(getattr(options, name) or []) > 1:
            raise ValueError(f"a comparison takes one folder of scenes as --{name}, got {len(getattr(options, name))}")
    recipes = {part: replace(recipe, **changes(options)) for part, recipe in QUICK.items()}
    how = {name: getattr(options, name) for name in ("out", "work", "limit", "seed", "boundary")}
    how |= {name: (getattr(options, name) or [None])[0] for name in ("data", "val")}
    how = {name: value for name, value in how.items() if value is not None}
    print(format_comparison(compare_settings(settings, recipes=recipes, command=command_line(options), **how)))


def add_recipe(p: ArgumentParser, steps: str) -> None:
    """Add the arguments that change a recipe."""
    p.add_argument("--steps", type=whole(), help=steps)
    p.add_argument("--batch", type=whole(), help="frames a step instead of the recipe's")
    p.add_argument("--lr", type=RATE, help="peak learning rate instead of the recipe's")
    p.add_argument("--limit", type=whole(), help="use only the first scenes")
    p.add_argument("--seed", type=seed, default=0, help="of everything random (%(default)s)")


def changes(options: Namespace) -> dict[str, float]:
    """Return what the command line changes of a recipe."""
    return {key: getattr(options, key) for key in ("steps", "batch", "lr") if getattr(options, key) is not None}


def folders(options: Namespace) -> tuple[list[Path], list[Path]]:
    """Return the folders to train and to validate on; refuse those without scenes."""
    from ..data import SAMPLES

    data = options.data or [folder for folder in TRAIN if has_scenes(folder)] or [TRAIN[0]]
    val = options.val or [SAMPLES / split for split in VAL if has_scenes(SAMPLES / split)] or [SAMPLES / VAL[0]]
    check_scenes(data, MAKE_TRAIN)
    check_scenes(val, MAKE_VAL)
    return data, val


def _is_of_training(path: Path) -> bool:
    """Return whether something in a folder is of weights, results about them or checkpoints."""
    return path.is_dir() or path.suffix in (".safetensors", ".json", ".jsonl", ".md", ".txt", ".log")


def _setting(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"--set expects key=value like unet.width=48, got {text!r}")
    return key, value
