"""What scores: ``evaluate``, ``bench`` (also what each stage costs), ``bench-boundary`` and ``floor``."""

import sys
import traceback
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from .shared import (
    SPLITS,
    First,
    add_depth_scale,
    add_system,
    add_weights,
    check_target,
    command_line,
    load_system,
    real,
    scenes_of,
    whole,
)

DATASETS = ("cleargrasp", "cleargrasp_synthetic", "todd", "std", "dreds", "trosd", "transcg", "folder")
WITHOUT_PEERS = (  # what `bench --peers`, which scores nothing, would not look at
    *("method", "no_cost", "dataset", "split", "root", "depth_scale", "limit", "given_region", "json"),
    *("steps", "samples", "threshold", "refine", "weights"),
)
FEW = 6  # frames, below which an interval is not called one
PROTOCOLS = ("cleargrasp", "lidf", "transparenet", "dfnet", "swindrnet", "d3roma", "marigold")


class Evaluate:
    """Score DITR and every baseline on a split of rendered scenes or on a real dataset."""

    @staticmethod
    def add_arguments(p: ArgumentParser) -> None:
        """Add what ``evaluate`` takes."""
        add_frames(p)
        p.add_argument(
            "--protocol", choices=PROTOCOLS, help="also score as that code does (cleargrasp's dataset: cleargrasp)"
        )
        p.add_argument("--skip-bad", action="store_true", help="leave out frames that cannot be used, and report them")
        add_scoring(p)

    @staticmethod
    def run(options: Namespace) -> int:
        """Print the tables and return the exit code: 3 where frames were left out."""
        check_results(options.json)
        source, frames = chosen_frames(options)
        if options.skip_bad:
            frames = Usable(frames, options.given_region)
        from ..evaluation import protocols, scoring
        from ..files import write_json

        name = options.protocol or ("cleargrasp" if options.dataset == "cleargrasp" else None)
        protocol = protocols.PROTOCOLS.get(name)
        ditr = load_system(options)
        results = scoring.run_methods(
            frames, ditr, None, options.given_region, options.steps, options.samples, protocol=protocol
        )
        skipped = frames.skipped if options.skip_bad else []
        for reason in skipped:  # first: where all were left out there is nothing to summarise
            print(f"ditr_lite: left out: {reason}", file=sys.stderr)
        if not results:
            raise ValueError(f"none of the {len(skipped)} frames can be scored: see what was left out, and why")
        print(f"{source}, region {'given' if options.given_region else 'found by stage one'}")
        print(scoring.format_report(scoring.summary(results, protocol), protocol))
        say_if_few(len(results))
        if options.json:
            written = scoring.to_json(
                results, command_line(options), options.weights, protocol, **notes(source, options)
            )
            write_json(options.json, written)
        return 3 if skipped else 0


class Bench:
    """Score every method on a split, a reader's own included, and measure what each stage costs."""

    @staticmethod
    def add_arguments(p: ArgumentParser) -> None:
        """Add what ``bench`` takes."""
        add_frames(p)
        p.set_defaults(skip_bad=False)
        p.add_argument(
            "--method",
            action="append",
            default=[],
            metavar="MODULE:FUNCTION",
            help="also score your own f(rgb, depth, region) -> depth in metres; the module is looked for here first",
        )
        p.add_argument(
            "--runs", type=whole(), default=7, help="runs of a stage whose median is taken, 5 or more (%(default)s)"
        )
        p.add_argument("--no-cost", action="store_true", help="only score, measure no time and memory")
        p.add_argument(
            "--peers",
            action="store_true",
            help="only print the committed table of peers at equal training time",
        )
        add_scoring(p)

    @staticmethod
    def run(options: Namespace) -> None:
        """Print the tables."""
        if options.peers:
            if given := [k for k in WITHOUT_PEERS if getattr(options, k)]:
                raise ValueError(f"--peers only prints a committed table: leave out --{given[0].replace('_', '-')}")
            print(peer_table())
            return
        check_results(options.json)
        from ..baselines import REGISTRY
        from ..evaluation import scoring, timing
        from ..evaluation.own_method import find_methods
        from ..files import write_json

        if options.runs < timing.MIN_RUNS:  # now, not after everything has been scored
            raise ValueError(f"--runs should be at least {timing.MIN_RUNS}, got {options.runs}")
        own = {name: within_its_lines(name, method) for name, method in find_methods(options.method).items()}
        source, frames = chosen_frames(options)
        ditr = load_system(options)
        methods = {**REGISTRY, **own}
        results = scoring.run_methods(frames, ditr, methods, options.given_region, options.steps, options.samples)
        print(f"{source}, region {'given' if options.given_region else 'found by stage one'}")
        print(scoring.format_report(scoring.summary(results)))
        for name in own:
            if not any(result["methods"][name] for result in results):
                raise ValueError(f"your method {name!r} was refused on every frame, for the reason above")
            print(against_best(results, name, tuple(REGISTRY)))
        say_if_few(len(results))
        more = notes(source, options) | ({} if options.no_cost else {"cost": measure_costs(options, ditr, frames[0])})
        if options.json:
            written = scoring.to_json(results, command_line(options), options.weights, **more)
            write_json(options.json, written)


class BenchBoundary:
    """Score every boundary backend against the exact outlines of rendered scenes."""

    @staticmethod
    def add_arguments(p: ArgumentParser) -> None:
        """Add what ``bench-boundary`` takes."""
        p.add_argument("--root", type=Path, help="a folder of other rendered scenes, with their train split")
        p.add_argument("--split", default="test", help=f"{', '.join(SPLITS)} (default test)")
        p.add_argument("--limit", type=whole(), help="only the first frames")
        p.add_argument(
            "--tolerance", type=real(0, 100, "pixels", closed=True), default=1.0, help="pixels (%(default)s)"
        )
        p.add_argument("--weights", type=Path, help="weights folder of the learned backend (default: the shipped one)")
        p.add_argument("--sam", type=Path, help="folder of a SAM checkpoint; without it, sam is not scored")
        p.add_argument("--json", type=Path, help="also write every frame's scores to this file")

    @staticmethod
    def run(options: Namespace) -> None:
        """Print the table."""
        check_results(options.json)
        from ..evaluation import boundary as boundary_scoring

        frames = scenes_of(options.split, options.root, options.limit)
        tuning = scenes_of("train", options.root, None)
        found = boundary_scoring.bench(frames, tuning, options.tolerance, options.weights, options.sam)
        print(boundary_scoring.format_scores(found["summary"]))
        if options.json:
            from ..evaluation import results

            begin = results.head(command_line(options), options.weights, ["boundary"], split=options.split)
            results.write(options.json, begin, found)


class Floor:
    """Measure what is lost when the ground truth of a split is encoded and decoded, and how many codes are in use."""

    @staticmethod
    def add_arguments(p: ArgumentParser) -> None:
        """Add what ``floor`` takes."""
        add_scenes(p)
        p.add_argument("--limit", type=whole(), help="only the first frames")
        p.add_argument("--json", type=Path, help="also write the figures, with the weights' checksum, to this file")
        add_weights(p)

    @staticmethod
    def run(options: Namespace) -> None:
        """Print the figures."""
        check_results(options.json)
        source, frames = chosen_frames(options)
        from ..evaluation import results
        from ..studies.floor import format_floor, load_autoencoder, measure_floor

        report = measure_floor(frames, load_autoencoder(options.weights))
        print(f"{source}, ground truth encoded and decoded")
        print(format_floor(report))
        if options.json:
            begin = results.head(command_line(options), options.weights, ["autoencoder"], source=source)
            results.write(options.json, begin, report)


def say_if_few(frames: int) -> None:
    """Warn of intervals over so few frames that resampling gives back little more than their range."""
    if frames < FEW:
        print(f"{frames} frames are too few for an interval: what stands in brackets is hardly more than their range")


class Usable:
    """Frames without those that cannot be used; why these cannot, ``skipped`` says after all were gone through."""

    def __init__(self, frames: First, given_region: bool):
        self.frames, self.given_region, self.skipped = frames, given_region, []

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator:
        for index, name in enumerate(self.frames.names):
            try:
                sample = self.frames[index]
            except (ValueError, OSError) as error:
                self.skipped.append(f"{name}: {' '.join(str(error).split())}")
                continue
            there = {
                "ground-truth depth": sample.depth_gt is not None,
                "region": sample.region is not None or not self.given_region,
                "reading": bool(sample.depth.any()),
            }
            if lacking := [what for what, is_there in there.items() if not is_there]:
                self.skipped.append(f"{name}: it has no {lacking[0]}")
            else:
                yield sample


def check_results(path: Path | None) -> None:
    """Refuse a results file that could not be written, or would replace something else than results."""
    check_target(path, ".json")
    if path is None or not path.exists():
        return
    from ..files import read_json

    try:
        there = read_json(path)
    except ValueError:
        there = {}
    if "command" not in there:
        raise ValueError(f"{path} is there and holds something else than results: choose another name for --json")


def within_its_lines(name: str, method: Callable) -> Callable:
    """Return a reader's method whose errors say in one line where in their own file they arose."""

    def call(*given):
        try:
            depth = method(*given)
        except (ValueError, KeyboardInterrupt):
            raise
        except (Exception, SystemExit) as error:
            package = str(Path(__file__).parents[1])
            own = [step for step in traceback.extract_tb(error.__traceback__) if not step.filename.startswith(package)]
            where = f"{Path(own[-1].filename).name}, line {own[-1].lineno}: " if own else ""
            raise RuntimeError(f"your method {name!r} failed: {where}{type(error).__name__}: {error}") from error
        from ..units import MAX_DEPTH_M

        if (typical := typical_depth(depth)) >= MAX_DEPTH_M:
            raise RuntimeError(f"your method {name!r} returns depth about {typical:.0f}: metres are expected")
        return depth

    return call


def typical_depth(depth: Any) -> float:
    """Return the median of a map of numbers, where above 0; 0 of anything else, which others refuse."""
    import numpy as np

    if not isinstance(depth, np.ndarray) or depth.dtype.kind not in "uif":
        return 0.0
    known = depth[np.isfinite(depth) & (depth > 0)]
    return float(np.median(known)) if known.size else 0.0


def against_best(results: Sequence[dict], name: str, baselines: Sequence[str]) -> str:
    """Return lines that compare a reader's method with the baseline that is best on each set, paired over frames."""
    from ..evaluation.scoring import COMPARED
    from ..evaluation.statistics import format_interval, mean_known, paired_bootstrap

    lines = [f"RMSE of {name} minus that of the best baseline, mm: mean [95 % interval], paired over frames"]
    for key in COMPARED:
        rmse = {m: [(s := (r["methods"][m] or {}).get(key)) and s["rmse"] for r in results] for m in (name, *baselines)}
        rmse = {m: values for m, values in rmse.items() if mean_known(values) is not None}
        common = [row for row in zip(*rmse.values(), strict=True) if None not in row]  # a method may refuse hard frames
        if not common or name not in rmse or len(rmse) == 1:
            continue
        rmse = dict(zip(rmse, zip(*common, strict=True), strict=True))
        best = min((m for m in rmse if m != name), key=lambda m: mean_known(rmse[m]))
        interval = paired_bootstrap(rmse[name], rmse[best])
        lines.append(f"  {key}: {format_interval(interval, 1000, '+.1f')} against {best}")
    if len(lines) == 1:
        return f"{name} and a baseline have no frame in common to be compared on"
    return "\n".join(lines)


def peer_table() -> str:
    """Return the committed results of the peers as text, with the command that makes them anew."""
    from ..studies import peer_tables

    report = peer_tables.load_results()
    made = f"{report['command']}, after {peer_tables.training_command(report)}"
    return f"{peer_tables.format_study(report)}\n\nCommand: {made}"


def add_dataset_name(p: ArgumentParser, does: str) -> None:
    """Add the argument that names a dataset: one of ours, or of a reader that was added to the registry."""

    def known(name: str) -> str:
        from ..datasets import REGISTRY

        if name not in REGISTRY:
            raise ArgumentTypeError(f"unknown dataset {name!r}; choose one of {', '.join(REGISTRY)}")
        return name

    p.add_argument("--dataset", type=known, metavar="NAME", help=f"{does}: {', '.join(DATASETS)}")


def add_frames(p: ArgumentParser) -> None:
    """Add the arguments that choose rendered scenes or a dataset."""
    add_dataset_name(p, "a real dataset instead of the rendered scenes")
    p.add_argument("--root", type=Path, help="the folder that holds the dataset (or other rendered scenes)")
    p.add_argument("--split", help=f"of the scenes: {', '.join(SPLITS)} (default test); of a dataset: its own")
    add_depth_scale(p)


def add_scenes(p: ArgumentParser) -> None:
    """Add the arguments that choose rendered scenes."""
    p.add_argument("--root", type=Path, help="a folder of other rendered scenes")
    p.add_argument("--split", default="test", help=f"{', '.join(SPLITS)} (default test)")


def add_scoring(p: ArgumentParser) -> None:
    """Add the arguments of what scores the whole system."""
    p.add_argument("--limit", type=whole(), help="only the first frames")
    p.add_argument("--given-region", action="store_true", help="hand over the true region instead of finding it")
    p.add_argument("--json", type=Path, help="also write the figures, with the weights' checksums, to this file")
    add_system(p)


def notes(source: str, options: Namespace) -> dict[str, Any]:
    """Return what a results file says of how it was made."""
    how = {"source": source, "given_region": options.given_region, "steps": options.steps, "samples": options.samples}
    given = {key: getattr(options, key) for key in ("threshold", "refine") if getattr(options, key) is not None}
    return how | given


def chosen_frames(options: Namespace) -> tuple[str, First]:
    """Return what to call the frames and the frames themselves; refuse those that cannot be scored."""
    if getattr(options, "dataset", None) is None:
        if getattr(options, "depth_scale", None) is not None:
            raise ValueError("--depth-scale is of --dataset folder")
        split = options.split or "test"
        return f"{split} split", scenes_of(split, options.root, options.limit)
    from ..datasets import REGISTRY
    from ..training.readers import scale_of

    if options.dataset not in REGISTRY:
        raise ValueError(f"unknown dataset {options.dataset!r}; choose one of {', '.join(REGISTRY)}")
    if options.root is None:
        raise ValueError(f"--dataset {options.dataset} needs --root DIR, the folder that holds it")
    dataset = REGISTRY[options.dataset](options.root, options.split, **scale_of(options.dataset, options.depth_scale))
    frames = First(dataset.names, dataset.__getitem__, options.limit)
    if not options.skip_bad and frames[0].depth_gt is None:
        raise ValueError(
            f"{options.dataset} in {options.root} has no ground-truth depth: nothing to score; see `complete`"
        )
    return f"{options.dataset} in {options.root}{f', split {options.split}' if options.split else ''}", frames


def measure_costs(options: Namespace, ditr, sample) -> dict[str, Any]:
    """Measure and print time, memory and operations at both frame sizes, the yardstick and training speed."""
    from ..evaluation import timing

    runs, steps, samples = options.runs, options.steps, options.samples
    found: dict[str, Any] = {"machine": timing.machine(), "runs": runs, "frames": []}
    print(f"\na product of two float32 matrices 2048 x 2048 takes {found['machine']['product_ms']:.0f} ms here")
    for frame in (sample, timing.enlarged(sample)):
        height, width = frame.depth.shape
        rows = timing.time_stages(ditr, frame, runs, steps, samples)
        peaks = timing.stage_peaks(options.weights, frame, steps, samples)
        rows = [{**row, "peak_mb": peaks[row["stage"]]} for row in rows]
        found["frames"].append({"size": [height, width], "stages": rows})
        print(f"\nmedian of {runs} runs, a frame of {width} x {height}, working size {ditr.config.size[::-1]}")
        print(timing.format_latency(rows))
    try:
        found["unets"] = timing.compare_unets(ditr, runs)
        print("\none denoising step of one branch, one sample, beside a library's U-Net on latents of the same shape")
        print(timing.format_unets(found["unets"]))
    except ImportError as error:
        print(f"\n{error}")
    found["training"] = speed = timing.throughput(ditr)
    print(
        f"\ntraining the {speed['part']} branch, batch {speed['batch']}: {speed['steps_per_s']:.2f} steps and "
        f"{speed['frames_per_s']:.1f} frames a second"
    )
    return found
