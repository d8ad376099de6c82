"""Read PAPER_MAP.md: the book's equation map and its summary pages are made from it."""

import re
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Part:
    """One part of the paper: a row of PAPER_MAP.md. Fields are empty where the paper's part has no home here."""

    group: str  # the heading above its table
    id: str
    paper: str  # what the paper has there
    function: str  # module.name within ditr_lite
    test: str  # the name of the test that holds it
    notebook: str  # file name without its suffix
    anchor: str  # a heading of that notebook, or the id of one of its cells


def slug(heading: str) -> str:
    """Return the anchor of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def parts(path: Path) -> list[Part]:
    """Return every row of the map at ``path``, in its order.

    Raises:
        ValueError: for a table row that has not five columns.
    """
    found, group = [], ""
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            group = line[3:]
        if not line.startswith("| ") or line.startswith("| |"):
            continue
        columns = [column.strip() for column in line.strip("|").split(" | ")]
        if len(columns) != 5:
            raise ValueError(f"{path.name}: expected five columns, got {len(columns)}: {line}")
        name, paper, function, test, place = columns
        home = re.fullmatch(r"\[(\w+)\]\([^)]*\), (.*)", place)
        notebook, anchor = home.groups() if home else ("", "")
        test = re.sub(r"\[(\w+)\].*", r"\1", test)
        found.append(Part(group, name, paper, function.strip("`–"), test.strip("–"), notebook, anchor))
    return found
