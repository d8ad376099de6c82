"""``simulate``: render scenes, or export existing ones in the layout of a real dataset."""

import os
from argparse import ArgumentParser, Namespace
from functools import partial
from pathlib import Path

from .shared import MAX_SEED, SPLITS, check_folder, whole

SHIPPED = (("test", 128, 4), ("val", 48, 2), ("train", 24, 2), ("rooms", 96, 0), ("rooms_val", 48, 0))
HOMES = (
    "folder for the split's folder (default outputs/scenes; with --sensor NAME outputs/sensors/NAME; "
    "without --split the folder of the shipped scenes)"
)


def add_arguments(p: ArgumentParser) -> None:
    """Add what ``simulate`` takes."""
    p.add_argument("--split", choices=SPLITS, help="only test and rooms hold out shapes and materials")
    p.add_argument("--sensor", metavar="NAME", help="d435, d415, l515 or structure instead of a random sensor")
    p.add_argument(
        "--export-as",
        nargs=2,
        metavar=("DATASET", "DIR"),
        help="render nothing: write existing scenes (--split, default val; --root) into DIR in a dataset's layout",
    )
    p.add_argument("--root", type=Path, help="folder of the scenes to export (default: the shipped ones)")
    p.add_argument("--count", type=whole(), help="scenes wanted")
    p.add_argument("--out", type=Path, help=HOMES)
    p.add_argument("--workers", type=whole(1, 256), help="processes (default: one per core)")
    p.add_argument("--first-seed", type=whole(0, MAX_SEED), help="first scene seed to try (default 0)")
    p.add_argument("--infrared", type=whole(0), help="first seeds whose scenes keep their infrared pair (default 0)")


def run(options: Namespace) -> None:
    """Render scenes of one split, by default those that the repository ships; or export existing ones."""
    if options.export_as:
        rendering = {"--sensor": options.sensor, "--out": options.out, "--workers": options.workers}
        rendering |= {"--first-seed": options.first_seed, "--infrared": options.infrared}
        if given := _given(rendering):
            raise ValueError(f"{given[0]} is for rendering; --export-as writes scenes that are there, of --root")
        return run_export(options)
    if options.root:
        raise ValueError("--root is where --export-as takes its scenes from; rendering goes to --out")
    workers = options.workers or os.cpu_count() or 1
    if options.split is None:
        wanted = {"--count": options.count, "--first-seed": options.first_seed, "--infrared": options.infrared}
        wanted |= {"--sensor": options.sensor}
        if given := _given(wanted):
            raise ValueError(f"{given[0]} needs --split; without a split the shipped scenes are made")
        jobs = [(split, count, 0, infrared) for split, count, infrared in SHIPPED]
    else:
        if options.count is None:
            raise ValueError("--split needs --count, the number of scenes")
        jobs = [(options.split, options.count, options.first_seed or 0, options.infrared or 0)]
    from ..data import SAMPLES
    from ..simulator.simulate import simulate_many

    home = Path("outputs/sensors") / options.sensor if options.sensor else Path("outputs/scenes")
    root = options.out or (SAMPLES if options.split is None else home)
    check_folder(Path(root), _is_of_scenes, "scenes")
    for split, *_ in jobs:
        check_folder(Path(root) / split, partial(_is_scene, split), f"scenes of {split}")
    for split, count, first_seed, infrared in jobs:
        paths = simulate_many(root, split, count, first_seed, workers, infrared, options.sensor)
        print(f"{Path(root) / split}: {len(paths)} scenes, {paths[0].name} to {paths[-1].name}")


def _given(options: dict[str, object]) -> list[str]:
    return [name for name, value in options.items() if value is not None]


def _is_of_scenes(path: Path) -> bool:
    """Return whether something beside the splits' folders may be there: what lies in the folder of shipped scenes."""
    if path.is_dir():
        return path.name in (*SPLITS, "environments", "sensors", "peers")
    return path.suffix in (".md", ".png")


def _is_scene(split: str, path: Path) -> bool:
    return path.is_dir() and path.name.startswith(f"{split}_")


def run_export(options: Namespace) -> None:
    """Write existing scenes in the layout of a real dataset."""
    from ..data import list_samples, load_sample
    from ..datasets import REGISTRY
    from ..datasets import export as exports

    name, folder = options.export_as
    split = options.split or "val"
    names = list_samples(split, options.root)[: options.count]
    cameras = set()

    def scenes():
        for scene in names:
            sample = load_sample(scene, options.root)
            cameras.add(sample.camera)
            yield sample

    exports.export(name, folder, scenes(), split)
    if name == "folder" and len(cameras) > 1:
        print(
            f"{len(cameras)} cameras took these scenes, and a folder has one: clouds by its intrinsics.npy will be off"
        )
    if REGISTRY[name](folder)[0].depth_gt is None:
        advice = "they hold no true depth, so `evaluate` has nothing to score"
    else:
        advice = f"read them with `evaluate --dataset {name} --root {folder}`"
    print(f"{folder}: {len(names)} frames; {advice}")
