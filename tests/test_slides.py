"""tools/slides.py: which cell is which slide; a deck asks no network for anything and describes its figures."""

import re
from pathlib import Path

import nbformat
import pytest
import slides
import vendor
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

ROOT = Path(__file__).resolve().parents[1]
PNG = "iVBORw0KGgo="
# What a page loads by itself; a link that a reader may follow is not among it.
LOADS = re.compile(r"""(?:src=|<link[^>]+href=|url\(|import\s|from\s)\s*["']?(?:https?:)?//[^"')\s]+""")


def shown(**data):
    return new_output("display_data", data={kind.replace("_", "/"): value for kind, value in data.items()})


def example():
    widget = new_output("display_data", data={"application/vnd.jupyter.widget-view+json": {}, "text/plain": "HBox()"})
    figure = shown(image_png=PNG, text_plain="<Figure>")
    return new_notebook(
        cells=[
            new_markdown_cell("# Title\n\nWhat it is about."),
            new_markdown_cell("More of it."),
            new_code_cell("import numpy"),
            new_markdown_cell(
                "## Part\n\n$x^2$, see [02](02_region_refinement.ipynb) and [a word](../book/glossary.md#term-region)"
            ),
            new_code_cell("print(1)", outputs=[new_output("stream", text="1\n")]),
            new_code_cell("plot()", outputs=[figure], metadata={"alt": "two <curves>"}),
            new_markdown_cell("What to see."),
            new_markdown_cell("### Below"),
            new_code_cell("bar()", outputs=[widget]),
            new_code_cell("x", outputs=[new_output("stream", text="x")], metadata={"tags": ["skip"]}),
            new_markdown_cell("## Where the paper differs"),
            new_markdown_cell("Here."),
            new_markdown_cell("## What next"),
        ]
    )


@pytest.fixture
def fetched(monkeypatch, tmp_path):
    """Let the packages be there already."""
    for name, parts in slides.STORED.items():
        for part in parts:
            target = tmp_path / name / part
            target.parent.mkdir(parents=True, exist_ok=True)
            target.mkdir() if part in ("dist", "plugin/notes") else target.write_text(name)
    monkeypatch.setattr(slides, "fetch", lambda name: tmp_path / name)


def test_each_cell_is_the_slide_that_it_should_be():
    original = example()
    kinds = [cell.metadata.slideshow.slide_type for cell in slides.deck(original).cells]
    assert kinds == [
        *("slide", "-", "skip"),  # the title, its text, the set-up
        *("slide", "subslide", "subslide", "notes"),  # a part, an output, a figure, what it shows
        *("subslide", "skip", "skip"),  # a deeper heading, a bar without a kernel, a tag
        *("skip", "skip", "slide"),
    ]
    assert "slideshow" not in original.cells[0].metadata and original.cells[8].outputs


def test_a_figure_hides_its_code_and_text_does_not():
    cells = slides.deck(example()).cells
    assert slides.HIDE in cells[5].metadata.tags and slides.HIDE not in cells[4].metadata.tags


def test_a_deck_loads_nothing_from_outside(fetched, tmp_path):
    nbformat.write(example(), tmp_path / "00_example.ipynb")
    [page] = slides.render([tmp_path / "00_example.ipynb"], tmp_path / "out")
    html = page.read_text(encoding="utf-8")
    assert LOADS.findall(html) == []
    assert LOADS.findall('<script src="https://a.b/c.js">') and LOADS.findall("import mermaid from '//a.b'")
    for address in re.findall(r'(?:src|<link[^>]+href)="([^"#]+)"', html):
        assert address.startswith("data:") or address.startswith("vendor/"), address
    assert (page.parent / "vendor" / "mathjax" / "es5" / "tex-svg.js").exists()
    assert 'alt="two &lt;curves&gt;"' in html and "plot()" not in html and "print" in html
    assert "a word" in html and "glossary" not in html
    assert 'href="02_region_refinement.html"' in html and '<aside class="notes">' in html


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda p: p.stem)
def test_every_notebook_makes_a_deck(path):
    deck = slides.deck(nbformat.read(path, as_version=4))
    kinds = [cell.metadata.slideshow.slide_type for cell in deck.cells]
    figures = [cell for cell in deck.cells if slides.HIDE in cell.metadata.get("tags", [])]
    assert kinds[0] == "slide" and kinds.count("slide") >= 10 and len(figures) >= 4


def test_what_is_not_pinned_or_cannot_be_fetched_is_said(monkeypatch, tmp_path):
    with pytest.raises(ValueError, match="not pinned"):
        vendor.fetch("left-pad")
    monkeypatch.setattr(vendor, "ROOT", tmp_path)
    monkeypatch.setattr(vendor.shutil, "which", lambda name: None)
    with pytest.raises(OSError, match=r"npm, which fetches reveal\.js@"):
        vendor.fetch("reveal.js")
    (tmp_path / "outputs" / "vendor" / f"mathjax@{vendor.PINNED['mathjax']}").mkdir(parents=True)
    assert vendor.fetch("mathjax").is_dir()
