"""Write PAPER_MAP.md: which function does each part of the paper, which test holds it, which notebook teaches it.

    python tools/paper_map.py [--check]

Eq. n is the paper's own numbering, I n an unnumbered formula in the text, S n a specification, T n a table, A n an
analysis, F n a figure, C n a compared system, N n an addition of ours. The list itself stands in ``paper_map_entries``;
``tests/test_paper_map.py`` fails on a dead link.
"""

import argparse
import ast
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name

from paper_map_entries import ENTRIES

ROOT = Path(__file__).resolve().parents[1]
STATES = ("done", "left out")
GROUPS = {
    "Eq. ": "Equations",
    "I": "Formulas in the text",
    "S": "Specifications",
    "T": "Tables",
    "A": "Analyses",
    "F": "Figures, remade from our own data",
    "C": "Compared systems: a small stand-in for one idea of each, never the system itself",
    "N": "Not in the paper: what we add to it",
}


@dataclass(frozen=True)
class Entry:
    """One part of the paper and its home; ``-`` where there is none."""

    id: str
    status: str  # "done": all three links must hold; "left out": no counterpart
    notebook: str  # file name without its suffix
    anchor: str  # heading, without its #, or id of a cell
    function: str  # module.name within ditr_lite
    test: str  # file::name within tests
    paper: str  # what the paper has there


def read(text: str) -> list[Entry]:
    """Read entries of three lines each, as ``paper_map_entries`` describes them.

    Raises:
        ValueError: for an entry that is not of that form.
    """
    entries = []
    for block in text.strip().split("\n\n"):
        lines = [[field.strip() for field in line.split(" | ")] for line in block.splitlines()]
        if [len(line) for line in lines] != [4, 2, 1]:
            raise ValueError(f"expected three lines of four, two and one fields between ' | ', got\n{block}")
        (name, status, notebook, anchor), (function, test), (paper,) = lines
        if status not in STATES:
            raise ValueError(f"{name}: expected status {' or '.join(STATES)}, got {status!r}")
        entries.append(Entry(name, status, notebook, anchor, function, test, paper))
    return entries


def entries() -> list[Entry]:
    """Return all entries, in the order of the page."""
    return read(ENTRIES)


def problems(entry: Entry, root: Path) -> list[str]:
    """Return what keeps a done entry from being so: a missing home or a dead link. An entry left out has no problems.

    Args:
        entry: to look at.
        root: of the repository, in which ``tests`` and ``notebooks`` are.
    """
    if entry.status == "left out":
        return []
    found = {
        "function": (entry.function, has_function(entry.function)),
        "test": (entry.test, has_test(root / "tests", entry.test)),
        "cell": (f"{entry.notebook}: {entry.anchor}", has_cell(root / "notebooks", entry.notebook, entry.anchor)),
    }
    return [f"{entry.id} is done, but there is no {kind} {name}" for kind, (name, there) in found.items() if not there]


def has_function(dotted: str) -> bool:
    """Return whether ``module.name`` of the package (``room.module.name``) can be imported and is callable."""
    try:
        return callable(resolve_name(f"ditr_lite.{dotted}"))
    except (ImportError, AttributeError, ValueError):
        return False


def has_test(folder: Path, test: str) -> bool:
    """Return whether ``folder`` has the test ``file::name``, a function or a name that one is given."""
    file, _, name = test.partition("::")
    if not name.startswith("test_") or not (folder / file).is_file():
        return False
    nodes = ast.walk(ast.parse((folder / file).read_text(encoding="utf-8")))
    return any(
        (isinstance(node, ast.FunctionDef) and node.name == name)
        or (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id == name)
        for node in nodes
    )


def has_cell(folder: Path, notebook: str, anchor: str) -> bool:
    """Return whether the notebook has a cell of that id, or that heading."""
    path = folder / f"{notebook}.ipynb"
    if not path.is_file():
        return False
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    text = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    headings = [line.lstrip("#").strip() for line in text.splitlines() if line.startswith("#")]
    return anchor in headings or anchor in [cell.get("id") for cell in cells]


def page(chosen: list[Entry]) -> str:
    """Return the entries as a page of Markdown, one table a group."""
    done = sum(entry.status == "done" for entry in chosen)
    lines = [
        "# Where the paper is in this repository",
        "",
        "Written by `python tools/paper_map.py` from `tools/paper_map_entries.py`; do not edit by hand. "
        f"{done} of {len(chosen)} parts have a function, a test and a place in a notebook, which tests check.",
    ]
    for prefix, title in GROUPS.items():
        lines += ["", f"## {title}", "", "| | in the paper | function | test | notebook |", "|---|---|---|---|---|"]
        lines += [_line(entry) for entry in chosen if _group(entry) == prefix]
    return "\n".join(lines) + "\n"


def _group(entry: Entry) -> str:
    return entry.id.rstrip("0123456789")


def _line(entry: Entry) -> str:
    function = "–" if entry.function == "-" else f"`{entry.function}`"
    file, _, name = entry.test.partition("::")
    test = f"[{name}](tests/{file})" if name else "–"
    place = "no counterpart here"
    if entry.status == "done":
        place = f"[{entry.notebook}](notebooks/{entry.notebook}.ipynb), {entry.anchor}"
    cells = [entry.id, entry.paper, function, test, place]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return 1 when an entry is not what it says, or, with --check, the page is out of date."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing, only say whether all is well")
    options = parser.parse_args(arguments)
    chosen, path = entries(), ROOT / "PAPER_MAP.md"
    wrong = [problem for entry in chosen for problem in problems(entry, ROOT)]
    text = page(chosen)
    if not options.check:
        path.write_text(text, encoding="utf-8")
    elif not path.is_file() or path.read_text(encoding="utf-8") != text:
        wrong.append("PAPER_MAP.md is out of date; run python tools/paper_map.py")
    print(*wrong, sep="\n", end="\n" if wrong else "", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
