"""What several commands share: kinds of arguments, the frames to work on, checks before any work is done.

Everything heavy is imported inside the functions, so that ``--help`` answers at once.
"""

import math
import shlex
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Iterator, Sequence
from glob import glob
from pathlib import Path
from tempfile import TemporaryFile

SPLITS = (
    "train",
    "val",
    "test",
    "rooms_train",
    "rooms_val",
    "rooms",
)  # as data has them
MAX_SEED = 2**63 - 1
MAKE_TRAIN = "python -m ditr_lite simulate --split train --count 1500 --out outputs/scenes --workers 2"
MAKE_VAL = "python -m ditr_lite simulate"


def whole(low: int = 1, high: int | None = None) -> Callable[[str], int]:
    """Return what reads a whole number of an argument, between two limits."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise ArgumentTypeError(f"invalid int value: {text!r}") from None
        if value < low or (high is not None and value > high):
            limits = f"at least {low}" if high is None else f"{low} to {high}"
            raise ArgumentTypeError(f"expected {limits}, got {value}")
        return value

    return read


def real(low: float, high: float, what: str, closed: bool = False) -> Callable[[str], float]:
    """Return what reads a number of an argument, above ``low`` and below ``high``; ``what`` says what it is.

    With ``closed``, ``low`` itself is taken, too.
    """

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise ArgumentTypeError(f"invalid float value: {text!r}") from None
        if not (low < value < high or (closed and value == low)):  # NaN is neither
            limits = f"above {low:g}" if math.isinf(high) else f"between {low:g} and {high:g}"
            if closed:
                limits = f"from {low:g} to below {high:g}"
            raise ArgumentTypeError(f"expected {what} {limits}, got {text}")
        return value

    return read


seed = whole(0, MAX_SEED)


def kernels(text: str) -> tuple[int, int, int]:
    """Read ``MEDIAN,DILATE,ITERATIONS``."""
    words = text.split(",")
    if len(words) != 3 or not all(word.strip().isdecimal() for word in words):
        raise ArgumentTypeError(f"expected MEDIAN,DILATE,ITERATIONS like 7,5,3, got {text!r}")
    median, dilate, iterations = map(int, words)
    even = [size for size in (median, dilate) if size and size % 2 == 0]
    if even or max(median, dilate) > 99 or iterations > 99:
        raise ArgumentTypeError(f"expected odd kernels (or 0 for none) and numbers below 100, got {text!r}")
    return median, dilate, iterations


def setting(text: str) -> tuple[str, str]:
    """Read ``KEY=VALUE``."""
    key, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"--set expects key=value like unet.width=48, got {text!r}")
    return key, value


def add_depth_scale(parser: ArgumentParser) -> None:
    """Add the argument that says the unit of depth in a folder of one's own."""
    parser.add_argument(
        "--depth-scale",
        type=real(0, float("inf"), "metres per unit"),
        help="of --dataset folder: metres per unit of depth (default: 0.001 of whole numbers, 1 of floats)",
    )


def add_system(parser: ArgumentParser) -> None:
    """Add the arguments that choose the system and how it works."""
    parser.add_argument("--steps", type=whole(), help="denoising steps (default: the configuration's)")
    parser.add_argument("--samples", type=whole(), help="draws to average (default: the configuration's)")
    parser.add_argument(
        "--threshold",
        type=real(0, 1, "a probability"),
        metavar="P",
        help="probability of glass above which stage one claims a pixel (default: the configuration's)",
    )
    parser.add_argument(
        "--refine",
        type=kernels,
        metavar="MEDIAN,DILATE,ITERATIONS",
        help="kernels, in pixels, that refine what stage one claims (default: the configuration's; the paper's: 7,5,3)",
    )
    add_weights(parser)


def add_weights(parser: ArgumentParser) -> None:
    """Add the argument that chooses the weights."""
    parser.add_argument("--weights", type=Path, help="weights folder (default: the shipped one)")


def load_system(options: Namespace):
    """Return the system with the weights, threshold and kernels that the command line names."""
    from dataclasses import replace

    from ..pipeline import Ditr
    from ..units import MAX_SAMPLES, check_count

    ditr = Ditr.from_pretrained(path=options.weights)
    check_count("--steps", options.steps or 1, 1, ditr.config.schedule.timesteps)  # once, not frame by frame
    check_count("--samples", options.samples or 1, 1, MAX_SAMPLES)
    given = {}
    if options.threshold is not None:
        given["threshold"] = options.threshold
    if options.refine is not None:
        given |= dict(zip(("median", "dilate", "iterations"), options.refine, strict=True))
    ditr.config = replace(ditr.config, refine=replace(ditr.config.refine, **given))
    return ditr


class First:
    """The first ``limit`` frames of a list of names, read when asked for."""

    def __init__(self, names: list, read: Callable, limit: int | None):
        self.names, self.read = names[:limit], read

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int):
        return self.read(self.names[index])

    def __iter__(self) -> Iterator:
        return (self.read(name) for name in self.names)


def scenes_of(split: str, root: Path | None, limit: int | None) -> First:
    """Return the rendered scenes of a split."""
    from functools import partial

    from ..data import list_samples, load_sample

    return First(list_samples(split, root), partial(load_sample, root=root), limit)


def command_line(options: Namespace) -> str:
    """Return the command as it can be typed again; results files name it."""
    return shlex.join(["python", "-m", "ditr_lite", *options.argv])


def check_target(path: Path | None, *suffixes: str) -> None:
    """Refuse a file that could not be written before any work is done."""
    if path is None:
        return
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"cannot write {path}: expected a name ending in {', '.join(suffixes)}")
    if path.is_dir():
        raise ValueError(f"cannot write {path}: it is a folder")
    if blocked := [p for p in path.parents if p.exists() and not p.is_dir()]:
        raise ValueError(f"cannot write {path}: {blocked[0]} is a file, not a folder")
    there = next(p for p in path.absolute().parents if p.exists())
    try:
        with TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise ValueError(f"cannot write {path}: {there} takes no new file ({error.strerror})") from None


def check_distinct(outputs: dict[str, Path | None], inputs: dict[str, Path | None]) -> None:
    """Refuse a target that is an input, by whatever name, or another target: what is read is never destroyed."""
    taken = [(name, path) for name, path in inputs.items() if path is not None]
    for name, path in outputs.items():
        if path is None:
            continue
        for other, there in taken:
            if _same(path, there):
                raise ValueError(f"{name} and {other} are the same file, {path}: choose another name for {name}")
        taken.append((name, path))


def _same(a: Path, b: Path) -> bool:
    if a.exists() and b.exists():
        return a.samefile(b)  # hard links, and names that differ in case only, too
    return a.resolve() == b.resolve()


def check_folder(folder: Path, whose: Callable[[Path], bool], what: str) -> None:
    """Refuse a folder that holds something else than ``what``; ``whose`` tells of each entry whether it belongs."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise ValueError(f"{folder} is a file, not a folder")
    strange = [path.name for path in sorted(folder.iterdir()) if not path.name.startswith(".") and not whose(path)]
    if strange:
        raise ValueError(f"{folder} holds something else than {what}, {strange[0]}: choose another folder")


def frame_files(place: Path, endings: Sequence[str]) -> list[Path]:
    """Return the files of a folder, or of a pattern with * or ?, with one of the endings in any case; none hidden.

    Raises:
        ValueError: when there is none.
    """
    if not place.is_dir() and not any(sign in str(place) for sign in "*?["):
        raise ValueError(f"no folder {place}; give one, or a pattern with * or ?")
    entries = place.iterdir() if place.is_dir() else map(Path, glob(str(place)))
    known = [p for p in entries if p.is_file() and p.suffix.lower() in endings and not p.name.startswith(".")]
    if not known:
        raise ValueError(f"no file in {place} ends in {', '.join(endings)}")
    return sorted(known)


def has_scenes(folder: Path) -> bool:
    """Return whether a folder holds rendered scenes."""
    from ..data import sample_folders

    return bool(sample_folders(folder))


def check_scenes(folders: list[Path], command: str) -> None:
    """Refuse folders without scenes; ``command`` makes them."""
    for folder in folders:
        if not has_scenes(folder):
            raise ValueError(f"no scenes in {folder}: make them with `{command}`")
