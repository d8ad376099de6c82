"""``compare``: two systems on the same frames, or two results files, and the paired differences."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from .evaluate import add_frames, check_results, chosen_frames, say_if_few
from .shared import command_line, setting, whole


def add_arguments(p: ArgumentParser) -> None:
    """Add what ``compare`` takes."""
    p.add_argument(
        "first", type=Path, metavar="A", help="weights folder, e.g. ditr_lite/weights; or results of `evaluate`"
    )
    p.add_argument(
        "second", type=Path, metavar="B", nargs="?", help="another; the differences are B - A (with --set: A)"
    )
    p.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="let B work otherwise: sampler.steps=4, sampler.samples=1, refine.threshold=0.5, window=0, ...",
    )
    p.add_argument(
        "--method",
        action="append",
        default=[],
        metavar="NAME",
        help="of two results files: the method to compare (default: ditr); given twice, that of A and that of B",
    )
    add_frames(p)
    p.add_argument("--limit", type=whole(), help="only the first frames")
    p.add_argument("--given-region", action="store_true", help="hand over the true region instead of finding it")
    p.add_argument("--json", type=Path, help="also write every frame's errors to this file")
    p.set_defaults(skip_bad=False)


def run(options: Namespace) -> None:
    """Print the table."""
    check_results(options.json)
    if options.second is None:
        if not options.set:
            raise ValueError("B is missing: give another weights folder, or --set KEY=VALUE for A working otherwise")
        options.second = options.first
    files = [path.suffix == ".json" for path in (options.first, options.second)]
    if any(files) != all(files):
        raise ValueError("A and B are of two kinds: give two weights folders or two results files")
    (compare_files if all(files) else compare_systems)(options)


def compare_files(options: Namespace) -> None:
    """Print how two results files compare, and whose they are."""
    from ..evaluation.compare import compare_results, format_weights
    from ..files import read_json, write_json

    asked = {name: None for name in ("dataset", "root", "split", "depth_scale", "limit")}
    asked |= {"set": [], "given_region": False}
    if given := [name for name, default in asked.items() if getattr(options, name) != default]:
        raise ValueError(f"two results files take no --{given[0].replace('_', '-')}: their frames are scored already")
    if len(options.method) > 2:
        raise ValueError(f"expected --method once, or once for A and once for B, got {len(options.method)}")
    methods = (options.method or ["ditr"]) * 2
    first, second = read_json(options.first), read_json(options.second)
    found = compare_results(first, second, methods[:2])
    print(f"{first.get('source', 'frames')}; A was made by {first.get('command')}, B by {second.get('command')}")
    print(format_weights(found, f"{methods[0]} in {options.first}", f"{methods[1]} in {options.second}"))
    if left := len({*first["rmse_m"], *second["rmse_m"]}) - len(found["frames"]):
        print(f"{left} frames that only one of both has are left out")
    say_if_few(len(found["frames"]))
    if options.json:
        write_json(options.json, {"command": command_line(options), **found})


def compare_systems(options: Namespace) -> None:
    """Score two weights folders, or one that works in two ways, and print how they compare."""
    from ..evaluation.compare import compare_weights, format_weights, weights_to_json
    from ..store import read_card

    if options.method:
        raise ValueError("--method is of two results files; a method of your own is scored by `bench --method`")
    for folder in (options.first, options.second):
        read_card(folder)  # refused before anything is computed
    settings = dict(map(setting, options.set))
    if len(settings) < len(options.set):
        raise ValueError(f"--set names one setting twice: {' '.join(options.set)}")
    source, frames = chosen_frames(options)
    found = compare_weights(options.first, options.second, frames, options.given_region, settings)
    print(f"{source}, region {'given' if options.given_region else 'found by stage one'}")
    print(format_weights(found, str(options.first), " ".join([str(options.second), *options.set])))
    say_if_few(len(frames))
    if options.json:
        from ..files import write_json

        write_json(options.json, weights_to_json(found, command_line(options), options.first, options.second))
