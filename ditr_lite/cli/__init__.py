"""The command line: ``python -m ditr_lite complete | evaluate | simulate | train | bench | ...``; see ``--help``.

Here the commands are only put together. Each brings a pair: ``add_arguments(parser)`` and ``run(options)``. Bad input
ends with exit code 2 and one line on stderr, an interruption with 130 and one line.
"""

import os
import re
import signal
import sys
import threading
import warnings
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from typing import NoReturn

from . import compare, complete, evaluate, simulate, train

COMMANDS = {
    "complete": (complete, "complete RGB-D frames of any camera, one or a folder of them"),
    "evaluate": (evaluate.Evaluate, "score DITR and every baseline on frames with ground truth"),
    "simulate": (simulate, "render scenes; without --split, the shipped ones (existing scenes are kept)"),
    "train": (train.Train, "train one part or all; a stopped run goes on where it was"),
    "bench": (
        evaluate.Bench,
        "the tables of evaluate, your own method too, and what each stage costs in time and memory",
    ),
    "train-boundary": (train.TrainBoundary, "train the learned boundary backend; a stopped run goes on where it was"),
    "bench-boundary": (evaluate.BenchBoundary, "score every boundary backend against the exact outlines of the scenes"),
    "compare": (
        compare,
        "score two systems on the same frames, or hold two results files against each other: paired differences",
    ),
    "floor": (evaluate.Floor, "measure what the autoencoder loses of the ground truth, and how many codes it uses"),
}
# OSError: files that are absent, unreadable, or cannot be written; RuntimeError: a reader's own part, torch, a library
BAD_INPUT = (ValueError, OSError, ImportError, RuntimeError)

LATER_S = 0.05  # between a SIGTERM that was dropped and the next


class Ended(BaseException):
    """The process was asked to end."""


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
        The exit code: 0; 2 for bad input; 3 where some of many frames failed; 130 after an interruption, 143 after
        SIGTERM.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        _end_in_order()
        options = parser().parse_args(argv)
        options.argv = argv
        with warnings.catch_warnings():
            warnings.filterwarnings("always", category=UserWarning, module="ditr_lite")
            warnings.showwarning = _warner()
            return options.run(options) or 0
    except BAD_INPUT as error:
        return _report(f"error: {_as_typed(str(error))}", 2)
    except MemoryError:
        return _report("error: not enough memory for this; take fewer samples, a smaller batch or smaller frames", 2)
    except Ended:
        return _report("ended by SIGTERM", 128 + signal.SIGTERM)
    except KeyboardInterrupt:
        return _report("interrupted", 130)


def _end_in_order() -> None:
    """Let SIGTERM end a command as Ctrl-C does: temporary files go, workers end, one line is printed.

    Python drops an exception that is raised while a destructor runs, such as that of a data loader: then the signal is
    sent once more, as often as it takes.
    """
    before = sys.unraisablehook

    def end(*_) -> NoReturn:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # whoever is impatient sends it again
        raise Ended

    def dropped(what: "sys.UnraisableHookArgs") -> None:
        if what.exc_type is not Ended:
            return before(what)
        signal.signal(signal.SIGTERM, end)
        threading.Timer(LATER_S, os.kill, (os.getpid(), signal.SIGTERM)).start()

    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, end)
        sys.unraisablehook = dropped


def parser() -> Parser:
    """Return the parser of the whole command line."""
    top = Parser(prog="python -m ditr_lite", description="Depth completion of transparent and reflective objects.")
    which = top.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)
    for name, (command, text) in COMMANDS.items():
        sub = which.add_parser(name, help=text, description=text)
        command.add_arguments(sub)
        sub.set_defaults(run=command.run)
    return top


def _warner() -> Callable[..., None]:
    """Return what prints a warning as one line, each but once."""
    said = set()

    def warn(message: Warning | str, *_, **__) -> None:
        text = _as_typed(str(message))
        if text not in said:
            print("ditr_lite: warning:", text, file=sys.stderr)
        said.add(text)

    return warn


def _as_typed(text: str) -> str:
    """Return a message of the library as one line in the words of a command line."""
    line = " ".join(text.split())
    return re.sub(r"(pass |\()depth_scale\b", r"\1--depth-scale", line).replace("--depth-scale=", "--depth-scale ")


def _report(text: str, code: int) -> int:
    print("ditr_lite:", text, file=sys.stderr)
    return code
