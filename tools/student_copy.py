"""Write student copies of the notebooks: the same notebooks without the solutions.

    python tools/student_copy.py [--out outputs/student] [notebook ...]

What stands between ``# BEGIN SOLUTION`` and ``# END SOLUTION`` becomes ``raise NotImplementedError``, the outputs of
those cells go, and no output is checked any more. Later cells use the reference implementation from ``ditr_lite``, so
that a copy runs to its end although nothing in it is solved yet.
"""

import argparse
import copy
import re
import sys
from pathlib import Path

import nbformat

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = "# BEGIN SOLUTION", "# END SOLUTION"
STUB = 'raise NotImplementedError("your turn: replace this line")'
CHECK_TAG = "nbval-check-output"
CHECK_COMMENT = re.compile(r"^\s*#+\s*NBVAL_CHECK_OUTPUT\s*$\n?", re.MULTILINE)


def strip_solution(source: str) -> str:
    """Return a cell's source with each marked solution replaced by a stub of the same indentation.

    Raises:
        ValueError: when the markers do not pair up, or stand outside a function, where the stub would end the run.
    """
    kept: list[str] = []
    inside = False
    for number, line in enumerate(source.splitlines(), start=1):
        marker = line.strip()
        if marker not in (BEGIN, END):
            if not inside:
                kept.append(line)
            continue
        if (marker == END) != inside:
            raise ValueError(f"line {number}: {marker!r} without its partner: each {BEGIN!r} needs an {END!r}")
        inside = marker == BEGIN
        indent = line[: len(line) - len(line.lstrip())]
        if inside and not indent:
            raise ValueError(f"line {number}: {BEGIN!r} stands outside a function; move it into the function's body")
        if inside:
            kept.append(indent + STUB)
    if inside:
        raise ValueError(f"{BEGIN!r} is never closed; add {END!r}")
    return "\n".join(kept)


def student_copy(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Return a copy of ``notebook`` without solutions, their outputs and output checks; the original stays as it is.

    Raises:
        ValueError: for solution markers that do not pair up, naming the code cell.
    """
    student = copy.deepcopy(notebook)
    code = [cell for cell in student.cells if cell.cell_type == "code"]
    for number, cell in enumerate(code):
        try:
            source = strip_solution(cell.source)
        except ValueError as error:
            raise ValueError(f"code cell {number}, {error}") from None
        if source != cell.source:
            cell.outputs, cell.execution_count = [], None
        cell.source = CHECK_COMMENT.sub("", source)
        if CHECK_TAG in cell.metadata.get("tags", []):
            cell.metadata.tags.remove(CHECK_TAG)
    return student


def write_copies(paths: list[Path], out: Path) -> list[Path]:
    """Write the student copy of each notebook into ``out`` and return the new files.

    Raises:
        ValueError: for a notebook whose solution markers do not pair up, naming it.
    """
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for path in paths:
        try:
            student = student_copy(nbformat.read(path, as_version=4))
        except ValueError as error:
            raise ValueError(f"{path.name}: {error}") from None
        nbformat.write(student, out / path.name)
        written.append(out / path.name)
    return written


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("notebooks", nargs="*", type=Path, help="default: all in notebooks/")
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "student", help="default: outputs/student")
    options = parser.parse_args(arguments)
    try:
        written = write_copies(options.notebooks or sorted((ROOT / "notebooks").glob("*.ipynb")), options.out)
    except (OSError, ValueError) as error:
        print(f"student_copy: {error}", file=sys.stderr)
        return 1
    print(f"{len(written)} student copies in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
