"""Render every notebook, as it is stored, as a web page, and an index of them.

    python tools/book.py [--out outputs/book]

The alternative text in a figure cell's metadata (``alt``) becomes that of the picture, for which nbconvert's classic
template is needed: its default one drops it.
"""

import argparse
import html
import re
import sys
from pathlib import Path

import nbformat
from nbconvert import HTMLExporter

ROOT = Path(__file__).resolve().parents[1]
PAGE = """<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><title>ditr_lite</title>
<style>body {{ font: 1.1em/1.6 sans-serif; max-width: 40em; margin: 3em auto; padding: 0 1em; }}</style></head>
<body><h1>ditr_lite</h1>
<p>Depth completion of transparent and reflective objects by latent diffusion, notebook by notebook.</p>
<ul>
{items}
</ul></body>
</html>
"""


def title(notebook: nbformat.NotebookNode, fallback: str) -> str:
    """Return the first level-one heading of a notebook, or ``fallback`` where it has none."""
    for cell in notebook.cells:
        found = cell.cell_type == "markdown" and re.search(r"^# +(.+)$", cell.source, flags=re.MULTILINE)
        if found:
            return found.group(1).strip()
    return fallback


def render(paths: list[Path], out: Path) -> Path:
    """Write one page per notebook and ``index.html`` into ``out``; return the index."""
    out.mkdir(parents=True, exist_ok=True)
    exporter = HTMLExporter(template_name="classic")
    items = []
    for path in paths:
        notebook = nbformat.read(path, as_version=4)
        page, _ = exporter.from_notebook_node(notebook, resources={"metadata": {"name": title(notebook, path.stem)}})
        # Links between notebooks become links between pages.
        page = re.sub(r'href="(\d\d_\w+)\.ipynb', r'href="\1.html', page)
        (out / f"{path.stem}.html").write_text(page, encoding="utf-8")
        label = html.escape(f"{path.stem[:2]} {title(notebook, path.stem)}")
        items.append(f'<li><a href="{path.stem}.html">{label}</a></li>')
    index = out / "index.html"
    index.write_text(PAGE.format(items="\n".join(items)), encoding="utf-8")
    return index


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "book", help="default: outputs/book")
    options = parser.parse_args(arguments)
    paths = sorted((ROOT / "notebooks").glob("*.ipynb"))
    if not paths:
        print("book: no notebooks to render in notebooks/", file=sys.stderr)
        return 1
    print(render(paths, options.out))
    return 0


if __name__ == "__main__":
    sys.exit(main())
