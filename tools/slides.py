"""Write a deck of slides for each notebook, from its stored outputs; the pages ask no network for anything.

    python tools/slides.py [--out outputs/slides] [notebook ...]

A heading of level one or two begins a slide, a deeper one a slide below it, and so does each output: a figure stands
alone, text stands under its code. Text without a heading that follows an output goes into the speaker's notes (key S),
as does the text of exercises. Cells that print nothing, and what comes after the recap, are left out. A cell's tag
``slide``, ``subslide``, ``fragment``, ``notes`` or ``skip`` decides otherwise.
"""

import argparse
import copy
import os
import re
import shutil
import sys
from pathlib import Path

import nbformat
from nbconvert import SlidesExporter
from vendor import fetch

ROOT = Path(__file__).resolve().parents[1]
TYPES = ("slide", "subslide", "fragment", "notes", "skip")
HEADING = re.compile(r"^(#+) +(.+)$", re.MULTILINE)
AFTER = re.compile(r"paper differs|depart from the paper|differ from the paper|run[ -]?time", re.IGNORECASE)
HIDE = "hide-code-on-slides"
SHOWN = {"image/png", "image/jpeg", "text/plain", "text/markdown"}
FIGURES = {"image/png", "image/jpeg"}
VENDORED = ("reveal.js", "mathjax")
STORED = {"reveal.js": ("dist", "plugin/notes", "LICENSE"), "mathjax": ("es5/tex-svg.js", "LICENSE")}


def kind_of(cell: nbformat.NotebookNode, after_output: bool) -> str:
    """Return what a cell is on the slides: one of TYPES, or ``-`` for more of the same slide."""
    for tag in cell.metadata.get("tags", []):
        if tag in TYPES:
            return tag
    if cell.cell_type == "code":
        return "subslide" if cell.outputs else "skip"
    heading = HEADING.search(cell.source)
    if heading:
        return "slide" if len(heading.group(1)) <= 2 else "subslide"
    return "notes" if after_output else "-"


def deck(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Return a copy of a notebook whose cells say which slide they are; the original stays as it is."""
    slides = copy.deepcopy(notebook)
    slides.metadata.pop("widgets", None)
    left_out = after_output = False
    for number, cell in enumerate(slides.cells):
        if cell.cell_type == "code":
            cell.outputs = [shown for shown in map(_without_widgets, cell.outputs) if shown]
        if cell.cell_type == "markdown" and HEADING.search(cell.source):
            left_out = bool(AFTER.search(HEADING.search(cell.source).group(2)))
        kind = "skip" if left_out else kind_of(cell, after_output)
        cell.metadata["slideshow"] = {"slide_type": "slide" if number == 0 else kind}
        tags = list(cell.metadata.get("tags", []))
        figure = cell.cell_type == "code" and any(FIGURES & set(out.get("data", {})) for out in cell.outputs)
        cell.metadata["tags"] = [*tags, HIDE] if figure else tags
        after_output = cell.cell_type == "code" and (bool(cell.outputs) or after_output)
    return slides


def _without_widgets(output: nbformat.NotebookNode) -> nbformat.NotebookNode | None:
    """Return an output that a page can show without a kernel, or None."""
    if output.output_type not in ("display_data", "execute_result"):
        return output if output.get("name") != "stderr" else None
    kept = {kind: value for kind, value in output.data.items() if kind in SHOWN}
    lost = set(output.data) - SHOWN
    if not FIGURES & set(kept) and (lost or not kept):
        return None
    output.data = kept
    return output


def render(paths: list[Path], out: Path) -> list[Path]:
    """Write a deck for each notebook, and what they need, into ``out``; return the decks."""
    out.mkdir(parents=True, exist_ok=True)
    for name in VENDORED:
        source = fetch(name)
        for part in STORED[name]:
            target = out / "vendor" / name / part
            target.parent.mkdir(parents=True, exist_ok=True)
            copying = shutil.copytree if (source / part).is_dir() else shutil.copy
            copying(source / part, target, **({"dirs_exist_ok": True} if (source / part).is_dir() else {}))
    exporter = SlidesExporter(
        template_name="slides_template",
        extra_template_basedirs=[str(ROOT / "tools")],
        reveal_url_prefix="vendor/reveal.js",
        reveal_theme="white",  # its letters lie beside it; the usual theme would ask Google for its own
        exclude_input_prompt=True,
        exclude_output_prompt=True,
        config={"TagRemovePreprocessor": {"enabled": True, "remove_input_tags": {HIDE}}},
    )
    decks = []
    for path in paths:
        page, _ = exporter.from_notebook_node(
            deck(nbformat.read(path, as_version=4)), resources={"metadata": {"name": path.stem}}
        )
        page = re.sub(r'href="(\d\d_\w+)\.ipynb', r'href="\1.html', page)
        page = re.sub(r'<a href="\.\./[^"]*">(.*?)</a>', r"\1", page)  # what lies outside the decks stays behind
        target = out / f"{path.stem}.html"
        part = target.with_suffix(".part")
        part.write_text(page, encoding="utf-8")
        os.replace(part, target)
        decks.append(target)
    return decks


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("notebooks", nargs="*", type=Path, help="default: all in notebooks/")
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "slides", help="default: outputs/slides")
    options = parser.parse_args(arguments)
    try:
        decks = render(options.notebooks or sorted((ROOT / "notebooks").glob("*.ipynb")), options.out)
    except (OSError, ValueError) as error:
        print(f"slides: {error}", file=sys.stderr)
        return 1
    print(f"{len(decks)} decks in {options.out}; open one in a browser, S shows the notes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
