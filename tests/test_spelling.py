"""Spelling of all prose: notebooks' text, Markdown files, and what stands in the package's code."""

import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).resolve().parents[1]
WORDS = ROOT / "tests" / "words.txt"  # what codespell takes for mistakes and is none


def misspelt(texts):
    """Return what codespell says of texts, name -> text: file, line, the word and what it may have meant."""
    found = []
    for name, text in texts.items():
        command = [sys.executable, "-m", "codespell_lib", "-I", str(WORDS), "-"]
        run = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
        assert run.stderr == ""
        found += [f"{name}: {line}" for line in run.stdout.splitlines() if "==>" in line]
    return found


def prose_of(path):
    if path.suffix != ".ipynb":
        return path.read_text(encoding="utf-8")
    return "\n\n".join(cell.source for cell in nbformat.read(path, as_version=4).cells)


KINDS = {
    "notebooks": (ROOT / "notebooks").glob("*.ipynb"),
    "markdown": [p for folder in (".", "book", "notebooks", "data_samples") for p in (ROOT / folder).glob("*.md")],
    "package": (ROOT / "ditr_lite").rglob("*.py"),
    "book": (ROOT / "book").glob("*.py"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_prose_is_spelt_right(kind):
    paths = sorted(KINDS[kind])
    assert paths
    whole = "\n".join(prose_of(path) for path in paths)
    wrong = misspelt({kind: whole})
    if wrong:  # slower, but it names the files
        wrong = misspelt({path.name: prose_of(path) for path in paths})
    assert wrong == []


def test_a_misspelt_word_is_noticed():
    mistake = "reciev" + "e"  # not written out: this file is prose, too
    assert misspelt({"a": f"right\n{mistake}\n"}) and not misspelt({"a": "receive\n"})
