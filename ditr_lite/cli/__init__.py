"""The command line: ``python -m ditr_lite complete | evaluate | simulate | train | bench | ...``; see ``--help``.

Bad input ends with exit code 2 and one line on stderr.
"""

import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from ..data import ROOM_SPLITS, SPLITS
from . import bench, boundary, commands

DATASETS = ("cleargrasp", "cleargrasp_synthetic", "todd", "std", "dreds", "trosd", "transcg", "folder")
PROTOCOLS = ("cleargrasp", "lidf", "transparenet", "dfnet", "swindrnet", "d3roma", "marigold")
HOMES = (
    "folder for the split's folder (default outputs/scenes; with --sensor NAME outputs/sensors/NAME; "
    "without --split the folder of the shipped scenes)"
)
BAD_INPUT = (ValueError, OSError, ImportError)  # OSError: files that are absent, unreadable, or cannot be written


class Parser(ArgumentParser):
    """A parser that reports a bad command line as it is reported everywhere else: one line, no usage page."""

    def error(self, message: str) -> NoReturn:
        """Raise what :func:`main` turns into that line."""
        raise ValueError(f"{message} (see `{self.prog} --help`)")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: what follows ``python -m ditr_lite``; the process's own by default.

    Returns:
        The exit code: 0, or 2 for bad input.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        args = parser().parse_args(argv)
        args.argv = argv
        args.run(args)
    except BAD_INPUT as error:
        print("ditr_lite: error:", " ".join(str(error).split()), file=sys.stderr)
        return 2
    return 0


def parser() -> Parser:
    """Return the parser of the whole command line."""
    top = Parser(prog="python -m ditr_lite", description="Depth completion of transparent and reflective objects.")
    adders = {
        "complete": (_complete, "complete one RGB-D frame of any camera"),
        "evaluate": (_evaluate, "score DITR and every baseline on frames with ground truth"),
        "simulate": (_simulate, "render scenes; without --split, the shipped ones (existing scenes are kept)"),
        "train": (_train, "train one part or all; a stopped run goes on where it was"),
        "bench": (_bench, "the tables of evaluate, your own method too, and what each stage costs in time and memory"),
        "train-boundary": (_train_boundary, "train the learned boundary backend; a stopped run goes on where it was"),
        "bench-boundary": (_bench_boundary, "score every boundary backend against the exact outlines of the scenes"),
        "floor": (_floor, "measure what the autoencoder loses of the ground truth, and how many codes it uses"),
    }
    which = top.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)
    for name, (add, text) in adders.items():
        sub = which.add_parser(name, help=text, description=text)
        add(sub)
        homes = {"train-boundary": boundary, "bench-boundary": boundary, "bench": bench}
        sub.set_defaults(run=getattr(homes.get(name, commands), name.replace("-", "_")))
    return top


def _complete(p: Parser) -> None:
    p.add_argument("--rgb", type=Path, required=True, help="8-bit colour picture (PNG, JPEG) or .npy")
    p.add_argument("--depth", type=Path, required=True, help="16-bit PNG, .npy or .exr, aligned to --rgb, 0 = missing")
    p.add_argument(
        "--depth-scale", type=float, default=0.001, help="metres per unit of a whole-number depth map (%(default)s)"
    )
    p.add_argument("--region", type=Path, help="mask of the transparent and reflective region; else it is found")
    p.add_argument("--out", type=Path, required=True, help="completed depth: .png (mm), .npy or .exr (m)")
    p.add_argument("--ply", type=Path, help="also write a point cloud; needs --intrinsics")
    p.add_argument("--panel", type=Path, help="also write a picture of before and after (.png)")
    p.add_argument("--intrinsics", type=Path, help="3x3 matrix as text or .npy, or .yaml with fx, fy, cx, cy")
    p.add_argument("--seed", type=int, default=0, help="of the noise (%(default)s)")
    p.add_argument("--adjust", action="store_true", help="let readings outside the region change too")
    _model(p)


def _evaluate(p: Parser) -> None:
    p.add_argument("--dataset", choices=DATASETS, help="a real dataset instead of the rendered scenes")
    p.add_argument("--root", type=Path, help="the folder that holds the dataset (or other rendered scenes)")
    p.add_argument("--split", help="of the scenes: test (default), val, train; of a dataset: its own")
    p.add_argument(
        "--protocol", choices=PROTOCOLS, help="also score as that code does (cleargrasp's dataset: cleargrasp)"
    )
    _scoring(p)


def _bench(p: Parser) -> None:
    p.add_argument("--root", type=Path, help="a folder of other rendered scenes")
    p.add_argument("--split", default="test", help="test (default), val or train")
    p.add_argument(
        "--method",
        action="append",
        default=[],
        metavar="MODULE:FUNCTION",
        help="also score your own f(rgb, depth, region) -> depth in metres; the module is looked for here first",
    )
    p.add_argument("--runs", type=int, default=7, help="runs of a stage whose median is taken, 5 or more (%(default)s)")
    _scoring(p)


def _floor(p: Parser) -> None:
    p.add_argument("--root", type=Path, help="a folder of other rendered scenes")
    p.add_argument("--split", default="test", help="test (default), val or train")
    p.add_argument("--limit", type=int, help="only the first frames")
    p.add_argument("--json", type=Path, help="also write the figures, with the weights' checksum, to this file")
    p.add_argument("--weights", type=Path, help="weights folder (default: the shipped one)")


def _simulate(p: Parser) -> None:
    p.add_argument("--split", choices=SPLITS + ROOM_SPLITS, help="only test and rooms hold out shapes and materials")
    p.add_argument("--sensor", metavar="NAME", help="d435, d415, l515 or structure instead of a random sensor")
    p.add_argument(
        "--export-as",
        nargs=2,
        metavar=("DATASET", "DIR"),
        help="render nothing: write existing scenes (--split, default val; --root) into DIR in a dataset's layout",
    )
    p.add_argument("--root", type=Path, help="folder of the scenes to export (default: the shipped ones)")
    p.add_argument("--count", type=int, help="scenes wanted")
    p.add_argument("--out", type=Path, help=HOMES)
    p.add_argument("--workers", type=int, help="processes (default: one per core)")
    p.add_argument("--first-seed", type=int, help="first scene seed to try (default 0)")
    p.add_argument("--infrared", type=int, help="how many of the first scenes keep their infrared pair (default 0)")


def _train(p: Parser) -> None:
    p.add_argument("--part", default="all", help="all (default), autoencoder, region, optical, geometric or detail")
    p.add_argument("--preset", default="lite", help="sizes: tiny, lite (default) or paper")
    p.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a setting: unet.width=48; with --preset tiny and all parts, compare with tiny as it is: a quick "
        "experiment of minutes on the shipped scenes",
    )
    p.add_argument(
        "--data", type=Path, help="scenes to train on (outputs/scenes/train); in a comparison, besides the shipped ones"
    )
    p.add_argument("--val", type=Path, help="scenes to validate on (default: the shipped val split)")
    p.add_argument("--out", type=Path, help="weights folder (default: the shipped one for plain lite, else in outputs)")
    p.add_argument("--work", type=Path, help="folder for checkpoints and logs (default outputs/training)")
    p.add_argument("--start", type=Path, help="weights folder to go on from (default: afresh), e.g. the shipped one")
    p.add_argument("--steps", type=int, help="steps instead of the recipe's")
    p.add_argument("--batch", type=int, help="frames a step instead of the recipe's")
    p.add_argument("--lr", type=float, help="peak learning rate instead of the recipe's")
    p.add_argument("--limit", type=int, help="use only the first scenes")
    p.add_argument("--seed", type=int, default=0, help="of everything random (%(default)s)")
    p.add_argument("--boundary", default="classical", help="backend of the boundary maps (%(default)s)")


def _train_boundary(p: Parser) -> None:
    p.add_argument("--data", type=Path, default=Path("outputs/scenes/train"), help="scenes to train on (%(default)s)")
    p.add_argument("--val", type=Path, help="scenes to validate on (default: the shipped val split)")
    p.add_argument("--out", type=Path, help="weights folder (default: the shipped one)")
    p.add_argument("--work", type=Path, default=Path("outputs/training"), help="for checkpoints and logs (%(default)s)")
    p.add_argument(
        "--steps", type=int, help="steps of the colour network instead of the recipe's; the depth network takes a third"
    )
    p.add_argument("--batch", type=int, help="frames a step instead of the recipe's")
    p.add_argument("--lr", type=float, help="peak learning rate instead of the recipe's")
    p.add_argument("--limit", type=int, help="use only the first scenes")
    p.add_argument("--seed", type=int, default=0, help="of everything random (%(default)s)")


def _bench_boundary(p: Parser) -> None:
    p.add_argument("--root", type=Path, help="a folder of other rendered scenes, with their train split")
    p.add_argument("--split", default="test", help="test (default), val or train")
    p.add_argument("--limit", type=int, help="only the first frames")
    p.add_argument("--tolerance", type=float, default=1.0, help="pixels (%(default)s)")
    p.add_argument("--weights", type=Path, help="weights folder of the learned backend (default: the shipped one)")
    p.add_argument("--sam", type=Path, help="folder of a SAM checkpoint; without it, sam is not scored")
    p.add_argument("--json", type=Path, help="also write every frame's scores to this file")


def _scoring(p: Parser) -> None:
    p.add_argument("--limit", type=int, help="only the first frames")
    p.add_argument("--given-region", action="store_true", help="hand over the true region instead of finding it")
    p.add_argument("--json", type=Path, help="also write the figures, with the weights' checksums, to this file")
    _model(p)


def _model(p: Parser) -> None:
    p.add_argument("--steps", type=int, help="denoising steps (default: the configuration's)")
    p.add_argument("--samples", type=int, help="draws to average (default: the configuration's)")
    p.add_argument("--weights", type=Path, help="weights folder (default: the shipped one)")
