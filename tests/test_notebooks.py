"""What every notebook must be: complete, in order, executed in order, small, described, and checked."""

import base64
import io
import re
from pathlib import Path

import nbformat
import pytest
from PIL import Image

from ditr_lite.viz.panels import SMALLEST_TYPE

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))
READING_ORDER = (
    "00_start_here",
    "01_depth_loss_anatomy",
    "02_region_refinement",
    "03_vq_autoencoder",
    "04_ddpm_math",
    "05_boundary_maps",
    "06_full_pipeline",
    "07_metrics",
    "08_ablations",
    "09_your_own_camera",
    "10_training_at_scale",
)
MAX_NOTEBOOK_BYTES = 500_000
MIN_ALT = 20  # characters: "figure" or "plot" describes nothing
FIGURE = ("image/png", "image/jpeg", "image/svg+xml")
MOST_LINES, MOST_IN_EXERCISE = 15, 20  # blank lines not counted; an exercise holds its marks and checkers, too
LEAST_PX, COLUMN_PX = 12, 736  # height of type; width of the book's narrowest column at the size of a screen
# Headings that every notebook has, in this order.
SECTIONS = {
    "title": r"^# +\S",
    "what you will build, learn, need": r"^#+ .*what you('ll| will)\b",
    "exercises": r"^#+ .*\bexercises?\b",
    "recap": r"^#+ .*\brecap\b",
    "where the paper differs": r"^#+ .*\bpaper\b",
    "measured run time": r"^#+ .*\brun[ -]?time\b",
    "what next": r"^#+ .*\bnext\b",
}


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def missing_sections(notebook):
    """Return the parts of the template that a notebook lacks or has in the wrong order."""
    text = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    missing, position = [], 0
    for name, pattern in SECTIONS.items():
        found = re.search(pattern, text[position:], flags=re.MULTILINE | re.IGNORECASE)
        if found:
            position += found.end()
        else:
            missing.append(name)
    return missing


def undescribed_figures(notebook):
    """Return the numbers of the code cells that show a figure without describing it in ``metadata["alt"]``."""
    cells = enumerate(code_cells(notebook))
    shows = [(i, c) for i, c in cells if any(kind in out.get("data", {}) for out in c.outputs for kind in FIGURE)]
    return [i for i, cell in shows if len(str(cell.metadata.get("alt", "")).strip()) < MIN_ALT]


def small_type(notebook):
    """Return (cell, height in pixels at the size shown) of stored figures whose smallest type is too small to be read.

    Each figure of ``viz`` says how high its smallest type is, 0 without words; one that does not say counts as 0.1.
    """
    small = []
    for number, cell in enumerate(code_cells(notebook)):
        for png in (out["data"]["image/png"] for out in cell.outputs if "image/png" in out.get("data", {})):
            image = Image.open(io.BytesIO(base64.b64decode(png)))
            shown = float(image.text.get(SMALLEST_TYPE, 0.1)) * min(1, COLUMN_PX / image.width)
            if 0 < shown < LEAST_PX:
                small.append((number, round(shown, 1)))
    return small


def long_cells(notebook):
    """Return (number, lines) of the code cells that hold more than a reader takes in at once."""
    long = []
    for number, cell in enumerate(code_cells(notebook)):
        lines = sum(bool(line.strip()) for line in cell.source.splitlines())
        if lines > (MOST_IN_EXERCISE if "BEGIN SOLUTION" in cell.source else MOST_LINES):
            long.append((number, lines))
    return long


def out_of_order(notebook):
    """Return the execution counts where they are not 1, 2, 3, … over the code cells that hold code."""
    counts = [cell.execution_count for cell in code_cells(notebook) if cell.source.strip()]
    return [] if counts == list(range(1, len(counts) + 1)) else counts


def unexpected_errors(notebook):
    cells = [c for c in code_cells(notebook) if any(out.output_type == "error" for out in c.outputs)]
    return [cell.source for cell in cells if "raises-exception" not in cell.metadata.get("tags", [])]


def good_notebook():
    png = [nbformat.v4.new_output("display_data", data={"image/png": "", "text/plain": "<Figure>"})]
    headings = "# Score a map\n## What you will build, learn and need\n## Exercises\n## Recap\n"
    headings += "## Where the paper differs\n## Measured run time\n## What next"
    cells = [
        nbformat.v4.new_markdown_cell(headings),
        nbformat.v4.new_code_cell("x = 1", execution_count=1),
        nbformat.v4.new_code_cell("plot()", execution_count=2, outputs=png, metadata={"alt": "two curves, the upper"}),
    ]
    return nbformat.v4.new_notebook(cells=cells)


def test_notebook_rules_can_fail():
    assert not any(rule(good_notebook()) for rule in (missing_sections, undescribed_figures, out_of_order))
    bad = good_notebook()
    bad.cells[0].source = bad.cells[0].source.replace("## Recap\n", "") + "\n## Recap"
    bad.cells[1].execution_count = None
    bad.cells[1].outputs = [nbformat.v4.new_output("error", ename="E", evalue="", traceback=[])]
    bad.cells[2].metadata.alt = "a plot"
    bad.cells[2].source = "plot()\n\n" * 16
    assert missing_sections(bad) == ["where the paper differs", "measured run time", "what next"]
    assert long_cells(good_notebook()) == [] and long_cells(bad) == [(1, 16)]
    assert undescribed_figures(bad) == [1] and out_of_order(bad) == [None, 2] and unexpected_errors(bad) == ["x = 1"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook(path):
    assert path.stem in READING_ORDER
    assert path.stat().st_size <= MAX_NOTEBOOK_BYTES
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert missing_sections(notebook) == []
    assert undescribed_figures(notebook) == []
    assert out_of_order(notebook) == []
    assert unexpected_errors(notebook) == []


def test_small_type_is_noticed():
    from ditr_lite.viz import Picture

    def stored(figure):
        data = figure._repr_mimebundle_()
        cells = [nbformat.v4.new_code_cell("figure", outputs=[nbformat.v4.new_output("display_data", data=data)])]
        return nbformat.v4.new_notebook(cells=cells)

    figure = Picture(4, 2)
    figure.subplots().set_title("large enough")
    assert small_type(stored(figure)) == [] == small_type(stored(Picture(2, 2)))
    figure.savefig(other := io.BytesIO(), format="png")
    foreign = stored(figure)
    foreign.cells[0].outputs[0].data["image/png"] = base64.b64encode(other.getvalue()).decode()
    assert small_type(foreign) == [(0, 0.1)]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_stored_figures_can_be_read_in_a_room(path):
    assert small_type(nbformat.read(path, as_version=4)) == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_code_cells_can_be_taken_in_at_once(path):
    notebook = nbformat.read(path, as_version=4)
    assert long_cells(notebook) == [] and 20 <= len(code_cells(notebook)) <= 40


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_every_exercise_of_level_three_has_a_folded_hint(path):
    text = "\n".join(cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "markdown")
    exercises = re.findall(r"^(?:#+ |\*\*)Level 3 ", text, flags=re.MULTILINE)
    assert len(re.findall(r"<summary>\s*(?:A )?hint", text, flags=re.IGNORECASE)) >= len(exercises) > 0


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_the_core_on_one_page_and_the_symbols_are_named(path):
    text = "\n".join(cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "markdown")
    assert f"summaries/{path.stem}" in text and "book/symbols.md" in text


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_has_checked_cells(path):
    notebook = nbformat.read(path, as_version=4)
    assert any("nbval-check-output" in cell.metadata.get("tags", []) for cell in code_cells(notebook))


# Changes that a notebook invites the reader to make: its own assertions must not stop them.
INVITED = {
    "beta is 0": (
        "03_vq_autoencoder",
        ("cell-002", "cell-012", "cell-022", "cell-023"),
        {"(1, 0.25)": "(1, 0)", "(0.25, 1)": "(0, 1)"},
    ),
    "another share of goblets": (
        "04_ddpm_math",
        ("cell-002", "cell-006", "cell-008", "cell-009"),
        {"[0.3, 0.7]": "[0.4, 0.6]"},
    ),
}


@pytest.mark.parametrize(("stem", "cells", "changes"), INVITED.values(), ids=INVITED)
def test_an_invited_change_runs(stem, cells, changes):
    path = next(p for p in NOTEBOOKS if p.stem == stem)
    source = "\n".join(c.source for c in nbformat.read(path, as_version=4).cells if c.id in cells)
    for old, new in changes.items():
        assert old in source
        source = source.replace(old, new)
    exec(source, {})
