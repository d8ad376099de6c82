"""What each command of ``python -m ditr_lite`` does, given its parsed arguments.

Everything heavy is imported inside the functions, so that ``--help`` answers at once. Bad input is a ValueError,
FileNotFoundError or ImportError, and nothing is written before everything is computed.
"""

import os
import shlex
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path

# What is in data_samples: split, scenes, how many with an infrared pair
SHIPPED = (("test", 128, 4), ("val", 48, 2), ("train", 24, 2), ("rooms", 96, 0), ("rooms_val", 48, 0))
MAKE_TRAIN = "python -m ditr_lite simulate --split train --count 1500 --out outputs/scenes --workers 2"
MAKE_VAL = "python -m ditr_lite simulate"


def complete(args: Namespace) -> None:
    """Complete one RGB-D frame of any camera and write the depth; on request a point cloud and a picture too."""
    check_target(args.out, ".png", ".npy", ".exr")
    check_target(args.ply, ".ply")
    check_target(args.panel, ".png")
    if args.ply and not args.intrinsics:
        raise ValueError("--ply needs the camera: give --intrinsics FILE (3x3 matrix, or lines fx: cx: ...)")
    from ..files import read_depth, read_intrinsics, read_mask, read_rgb, write_depth, write_ply

    rgb, depth = read_rgb(args.rgb), read_depth(args.depth, args.depth_scale)
    region = read_mask(args.region) if args.region else None
    for path, array in ((args.depth, depth), (args.region, region)):
        if array is not None and array.shape != rgb.shape[:2]:
            raise ValueError(f"{path} is {array.shape}, {args.rgb} {rgb.shape[:2]} (height, width): align them first")
    camera = read_intrinsics(args.intrinsics, rgb.shape[:2]) if args.intrinsics else None
    out = load_system(args)(rgb, depth, region, args.steps, args.samples, args.adjust, args.seed)
    write_depth(args.out, out.depth)
    if args.ply:
        write_ply(args.ply, out.depth, rgb, camera)
    if args.panel:
        from ..viz import save_panel

        save_panel(args.panel, rgb, depth, out.depth, out.region, out.std)
    height, width = out.depth.shape
    holes = ((depth == 0) & ~out.region).mean()
    print(
        f"{args.out}: {width} x {height}, {out.depth.min():.3f} to {out.depth.max():.3f} m; "
        f"region {out.region.mean():.1%}, holes filled outside it {holes:.1%}"
    )


def evaluate(args: Namespace) -> None:
    """Score DITR and every baseline on a split of rendered scenes or on a real dataset, and print the tables."""
    check_target(args.json, ".json")
    source, frames = chosen_frames(args)
    from ..evaluation import protocols, scoring
    from ..files import write_json

    name = args.protocol or ("cleargrasp" if args.dataset == "cleargrasp" else None)
    protocol = protocols.PROTOCOLS.get(name)
    results = scoring.run_methods(
        frames, load_system(args), None, args.given_region, args.steps, args.samples, protocol=protocol
    )
    print(f"{source}, region {'given' if args.given_region else 'found by stage one'}")
    print(scoring.format_report(scoring.summary(results, protocol), protocol))
    if args.json:
        notes = {"source": source, "given_region": args.given_region, "steps": args.steps, "samples": args.samples}
        write_json(args.json, scoring.to_json(results, command_line(args), args.weights, protocol, **notes))


def floor(args: Namespace) -> None:
    """Print what is lost when the ground truth of a split is encoded and decoded, and how many codes are in use."""
    check_target(args.json, ".json")
    source, frames = chosen_frames(args)
    from ..evaluation import results
    from ..studies.floor import format_floor, load_autoencoder, measure_floor

    report = measure_floor(frames, load_autoencoder(args.weights))
    print(f"{source}, ground truth encoded and decoded")
    print(format_floor(report))
    if args.json:
        begin = results.head(command_line(args), args.weights, ["autoencoder"], source=source)
        results.write(args.json, begin, report)


def simulate(args: Namespace) -> None:
    """Render scenes of one split, by default those that the repository ships; or export existing ones."""
    if args.export_as:
        return export(args)
    if args.root:
        raise ValueError("--root is where --export-as takes its scenes from; rendering goes to --out")
    workers = args.workers or os.cpu_count() or 1
    if args.split is None:
        wanted = {"--count": args.count, "--first-seed": args.first_seed, "--infrared": args.infrared}
        wanted |= {"--sensor": args.sensor}
        if given := [name for name, value in wanted.items() if value is not None]:
            raise ValueError(f"{given[0]} needs --split; without a split the shipped scenes are made")
        jobs = [(split, count, 0, infrared) for split, count, infrared in SHIPPED]
    else:
        if args.count is None:
            raise ValueError("--split needs --count, the number of scenes")
        jobs = [(args.split, args.count, args.first_seed or 0, args.infrared or 0)]
    from ..data import SAMPLES
    from ..simulator.simulate import simulate_many

    home = Path("outputs/sensors") / args.sensor if args.sensor else Path("outputs/scenes")
    root = args.out or (SAMPLES if args.split is None else home)
    for split, count, first_seed, infrared in jobs:
        paths = simulate_many(root, split, count, first_seed, workers, infrared, args.sensor)
        print(f"{Path(root) / split}: {len(paths)} scenes, {paths[0].name} to {paths[-1].name}")


def export(args: Namespace) -> None:
    """Write existing scenes in the layout of a real dataset."""
    from ..data import list_samples, load_sample
    from ..datasets import export as exports

    name, folder = args.export_as
    split = args.split or "val"
    names = list_samples(split, args.root)[: args.count]
    exports.export(name, folder, (load_sample(n, args.root) for n in names), split)
    print(f"{folder}: {len(names)} frames; read them with `evaluate --dataset {name} --root {folder}`")


def train(args: Namespace) -> None:
    """Train one part, or all in the order in which they need each other, and write weights and card."""
    from dataclasses import replace

    from ..config import override, preset
    from ..store import WEIGHTS
    from ..training import parts as fitting
    from ..training.recipes import RECIPES

    if args.part not in ("all", *fitting.PARTS):
        raise ValueError(f"unknown part {args.part!r}; choose all or one of {', '.join(fitting.PARTS)}")
    settings = dict(_setting(text) for text in args.set)
    config = override(preset(args.preset), **settings)
    changes = {k: getattr(args, k) for k in ("steps", "batch", "lr") if getattr(args, k) is not None}
    if args.preset == "tiny" and settings and args.part == "all":
        return experiment(args, settings, changes)
    args.data = args.data or Path("outputs/scenes/train")
    check_scenes(args)
    # Only the plain lite preset goes where the shipped weights and their checkpoints are.
    tag = "-".join([args.preset, *([fitting.folder_name(settings)] if settings else [])])
    out = args.out or (WEIGHTS if tag == "lite" else Path("outputs/weights") / tag)
    work = args.work or (Path("outputs/training") if tag == "lite" else Path("outputs/training") / tag)
    for part in fitting.PARTS if args.part == "all" else [args.part]:
        recipe = replace(RECIPES[part], **changes)
        how = (args.limit, args.seed, args.boundary, args.start, command_line(args))
        notes = fitting.train(part, config, args.data, args.val, out, work, recipe, *how)
        last = {k: v for k, v in (notes["curve"] or [{}])[-1].items() if k.startswith("val_")}
        figures = ", ".join(f"{k.removeprefix('val_')} {v:.4f}" for k, v in last.items())
        print(f"{Path(out) / part}.safetensors: {notes['steps']} steps, {notes['seconds']:.0f} s; {figures}")


def experiment(args: Namespace, settings: dict[str, str], changes: dict[str, float]) -> None:
    """Train the tiny preset as it is and with settings changed, score both on the same frames, and compare them."""
    from dataclasses import replace

    from ..studies.experiment import QUICK, compare, format_comparison

    if args.start:
        raise ValueError("a comparison trains both systems afresh: leave --start out, or train one --part with it")
    recipes = {part: replace(recipe, **changes) for part, recipe in QUICK.items()}
    given = ("data", "val", "out", "work", "limit", "seed", "boundary")
    how = {name: value for name in given if (value := getattr(args, name)) is not None}
    result = compare(settings, recipes=recipes, command=command_line(args), **how)
    print(format_comparison(result))


class _First:
    """The first ``limit`` frames of a list of names, read when asked for."""

    def __init__(self, names: list, read, limit: int | None):
        self.names, self.read = names[:limit], read

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int):
        return self.read(self.names[index])

    def __iter__(self) -> Iterator:
        return (self.read(name) for name in self.names)


def chosen_frames(args: Namespace) -> tuple[str, _First]:
    """Return what to call the frames and the frames themselves; refuse those that cannot be scored."""
    if args.limit is not None and args.limit < 1:
        raise ValueError(f"--limit should be at least 1, got {args.limit}")
    if getattr(args, "dataset", None) is None:
        from functools import partial

        from ..data import list_samples, load_sample

        split = args.split or "test"
        return f"{split} split", _First(
            list_samples(split, args.root), partial(load_sample, root=args.root), args.limit
        )
    from ..datasets import REGISTRY

    if args.dataset not in REGISTRY:
        raise ValueError(f"unknown dataset {args.dataset!r}; choose one of {', '.join(REGISTRY)}")
    if args.root is None:
        raise ValueError(f"--dataset {args.dataset} needs --root DIR, the folder that holds it")
    dataset = REGISTRY[args.dataset](args.root, args.split)
    frames = _First(dataset.names, dataset.__getitem__, args.limit)
    if frames[0].depth_gt is None:
        raise ValueError(f"{args.dataset} in {args.root} has no ground-truth depth: nothing to score; see `complete`")
    return f"{args.dataset} in {args.root}{f', split {args.split}' if args.split else ''}", frames


def check_scenes(args: Namespace) -> None:
    """Refuse folders without scenes; ``val`` is the shipped split by default."""
    from ..data import SAMPLES

    args.val = args.val or SAMPLES / "val"
    for folder, command in ((args.data, MAKE_TRAIN), (args.val, MAKE_VAL)):
        if not any(Path(folder).glob("*/meta.json")):
            raise ValueError(f"no scenes in {folder}: make them with `{command}`")


def load_system(args: Namespace):
    """Return the system with the weights that the command line names."""
    from ..pipeline import Ditr

    return Ditr.from_pretrained(path=args.weights)


def command_line(args: Namespace) -> str:
    """Return the command as it can be typed again; results files name it."""
    return shlex.join(["python", "-m", "ditr_lite", *args.argv])


def _setting(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"--set expects key=value like unet.width=48, got {text!r}")
    return key, value


def check_target(path: Path | None, *suffixes: str) -> None:
    """Refuse a file that could not be written before any work is done."""
    if path is None:
        return
    if path.suffix not in suffixes:
        raise ValueError(f"cannot write {path}: expected a name ending in {', '.join(suffixes)}")
    if path.is_dir():
        raise ValueError(f"cannot write {path}: it is a folder")
    if blocked := [p for p in path.parents if p.exists() and not p.is_dir()]:
        raise ValueError(f"cannot write {path}: {blocked[0]} is a file, not a folder")
