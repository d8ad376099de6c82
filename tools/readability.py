"""Report how easily the notebooks' prose reads: how long its sentences are, and the automated readability index.

    python tools/readability.py [--limit 18] [--longest 3] [notebook ...]

Counted is what a reader takes in as prose: Markdown without headings, tables, code and displayed equations; an inline
formula, a piece of code or a link counts as one word. The index (Senter and Smith, 1967) is about the school year of
the United States in which a text is read with ease: 4.71 letters a word + 0.5 words a sentence - 21.43. It needs no
list of syllables, so it is computed without a network and the same everywhere.

The exit status is 1 when the median sentence of a notebook is longer than the limit.
"""

import argparse
import re
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import nbformat

ROOT = Path(__file__).resolve().parents[1]
MEDIAN_LIMIT = 18  # words
BLOCKS = (r"```.*?```", r"\$\$.*?\$\$", r"<!--.*?-->")  # code, displayed equations, comments
NO_PROSE = re.compile(r"^\s*(#|\||</?(details|summary|br|div)\b[^>]*>\s*$)")  # headings, tables, bare tags
WORD = "x" * 5  # what stands for a formula or a piece of code, as long as a usual word
END = re.compile(r"(?<=[.!?:;])[)\"'*_]*\s+(?=[\"'(*_]*[A-Z0-9])|\n\s*\n")
ABBREVIATIONS = re.compile(r"\b(e\.g|i\.e|Sec|Eq|Eqs|Fig|Figs|vs|cf|approx)\.")


class Readability(NamedTuple):
    """What is reported of a text: number of sentences, median and 90th percentile of their words, the index."""

    sentences: int
    median: float
    ninetieth: float
    index: float


def prose(markdown: str) -> str:
    """Return the prose of a Markdown text, each list item a paragraph of its own."""
    for block in BLOCKS:
        markdown = re.sub(block, "\n\n", markdown, flags=re.DOTALL)
    lines = []
    for line in markdown.splitlines():
        item = re.match(r"\s*([-*]|\d+\.)\s+", line)
        if item:
            lines += ["", line[item.end() :]]
        else:
            lines.append("" if NO_PROSE.match(line) else line)
    text = "\n".join(lines)
    text = re.sub(r"</?\w+[^>]*>", "", text)
    text = re.sub(r"`[^`]*`|\$[^$]*\$", WORD, text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return ABBREVIATIONS.sub(r"\1", text.replace("**", ""))


def sentences(text: str) -> list[list[str]]:
    """Return the sentences of a text as lists of words; a colon before a capital ends one, too."""
    split = [re.findall(r"[^\W_][\w'.,×%-]*", part) for part in END.split(text)]
    return [words for words in split if words]


def measure(text: str) -> Readability:
    """Return the readability of Markdown.

    Raises:
        ValueError: when there is no prose in it.
    """
    found = sentences(prose(text))
    if not found:
        raise ValueError("expected prose, got a text without a sentence")
    lengths = sorted(len(words) for words in found)
    words = sum(lengths)
    letters = sum(len(re.sub(r"\W", "", word)) for sentence in found for word in sentence)
    index = 4.71 * letters / words + 0.5 * words / len(found) - 21.43
    return Readability(len(found), statistics.median(lengths), lengths[int(0.9 * (len(lengths) - 1))], index)


def markdown_of(path: Path) -> str:
    """Return the Markdown of a notebook, cells apart.

    Raises:
        ValueError: when it cannot be read as a notebook.
    """
    try:
        cells = nbformat.read(path, as_version=4).cells
    except (OSError, ValueError) as error:  # nbformat's own are ValueErrors
        raise ValueError(f"{path} cannot be read as a notebook: {error}") from None
    return "\n\n".join(cell.source for cell in cells if cell.cell_type == "markdown")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("notebooks", nargs="*", type=Path, help="default: all in notebooks/")
    parser.add_argument("--limit", type=float, default=MEDIAN_LIMIT, help="words of a median sentence (%(default)s)")
    parser.add_argument("--longest", type=int, default=0, help="also print so many of the longest sentences")
    options = parser.parse_args(arguments)
    paths = options.notebooks or sorted((ROOT / "notebooks").glob("*.ipynb"))
    too_long = []
    print(f"{'notebook':24} sentences  median words  90 % below  index")
    for path in paths:
        try:
            text = markdown_of(path)
            row = measure(text)
        except ValueError as error:
            print(f"readability: {error}", file=sys.stderr)
            return 2
        print(f"{path.stem:24} {row.sentences:9} {row.median:13.0f} {row.ninetieth:11} {row.index:6.1f}")
        for words in sorted(sentences(prose(text)), key=len)[: -options.longest - 1 : -1]:
            print(f"    {len(words)}: {' '.join(words)}")
        if row.median > options.limit:
            too_long.append(path.stem)
    if too_long:
        print(f"readability: median above {options.limit:g} words in {', '.join(too_long)}", file=sys.stderr)
    return 1 if too_long else 0


if __name__ == "__main__":
    sys.exit(main())
