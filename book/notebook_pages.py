"""Turn notebooks into pages of the book: what a page needs and a notebook does not say, without touching the notebook.

- a figure's alternative text stands in its cell's metadata, where JupyterLab keeps it and Sphinx does not look;
- what only a running kernel can draw (widgets, clouds to turn) is shown by the picture or words stored beside it;
- an exercise is shown as the student copy has it, its solution folded beneath;
- links to files that are no pages become plain text;
- downloads and the summary are linked at the beginning and the end.
"""

import copy
import importlib.util
import re
from pathlib import Path
from types import ModuleType

import nbformat
from nbformat.v4 import new_code_cell, new_markdown_cell

ROOT = Path(__file__).resolve().parents[1]
FOLDED = {"code_prompt_show": "Show a solution", "code_prompt_hide": "Hide the solution"}
LIVE = ("application/vnd.jupyter.widget-view+json", "application/vnd.plotly.v1+json", "application/javascript")
# from a notebook's folder: files of the repository that are pages of the book
PAGES = {
    "../README.md": "../index.md",
    "../PAPER_MAP.md": "../equation_map.md",
    "../data_samples/README.md": "../data_card.md",
    "../CHANGELOG.md": "../changelog.md",
}
TERM = re.compile(r"^(?! |```|#)(.+)\n  \S", re.MULTILINE)  # a line of the glossary with its meaning beneath it
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def _student_copy() -> ModuleType:
    spec = importlib.util.spec_from_file_location("student_copy", ROOT / "tools" / "student_copy.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


students = _student_copy()


def glossary_terms() -> dict[str, str]:
    """Return anchor -> term of the glossary, the anchors as Sphinx makes them."""
    found = TERM.findall((ROOT / "book" / "glossary.md").read_text(encoding="utf-8"))
    return {"#term-" + re.sub(r"[^A-Za-z0-9._]+", "-", term).strip("-"): term for term in found}


def book_links(text: str) -> str:
    """Return Markdown of the notebooks' folder with links that hold in the book; others become their words.

    Raises:
        ValueError: for a link to a term that the glossary does not have.
    """
    terms = glossary_terms()

    def link(match: re.Match) -> str:
        words, target, anchor = match[1], match[2], match[3] or ""
        if re.match(r"[a-z]+:", target) or re.fullmatch(r"\w+\.(ipynb|md)", target):
            return match[0]
        if target in PAGES:
            return f"[{words}]({PAGES[target]}{anchor})"
        if target == "../book/glossary.md" and anchor:
            if anchor not in terms:
                raise ValueError(f"{match[0]}: the glossary has no such term; its anchors are {', '.join(terms)}")
            return f"{{term}}`{words} <{terms[anchor]}>`"  # Markdown cannot point at a term, a role can
        if re.fullmatch(r"\.\./book/\w+\.md", target):
            return f"[{words}](../{target.split('/')[-1]}{anchor})"
        return words

    return LINK.sub(link, text)


def describe_figures(cell: nbformat.NotebookNode) -> None:
    """Hand the alternative text of a code cell's figures to Sphinx."""
    if cell.metadata.get("alt"):
        cell.metadata["mystnb"] = {**cell.metadata.get("mystnb", {}), "image": {"alt": cell.metadata["alt"]}}


def still_outputs(cell: nbformat.NotebookNode) -> None:
    """Leave of each output what a page without a kernel can show: a picture where there is one, else words."""
    for output in cell.outputs:
        data = output.get("data", {})
        if "image/png" in data:
            output["data"] = {"image/png": data["image/png"]}
        for kind in LIVE:
            data.pop(kind, None)


def exercise_and_solution(cell: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    """Return the open exercise and the folded solution of a solved cell; any other cell as it is."""
    if students.BEGIN not in cell.source:
        return [cell]
    cell.metadata["tags"] = [*cell.metadata.get("tags", []), "hide-input"]
    cell.metadata["mystnb"] = {**cell.metadata.get("mystnb", {}), **FOLDED}
    return [new_code_cell(students.strip_solution(cell.source)), cell]


def offers(name: str) -> str:
    """Return the line of downloads of a notebook."""
    return (
        f"{{download}}`The notebook <../downloads/{name}.ipynb>` · "
        f"{{download}}`without its solutions <../downloads/student/{name}.ipynb>` · "
        f"[its core on one page](../summaries/{name}.md)"
    )


def page(notebook: nbformat.NotebookNode, name: str) -> nbformat.NotebookNode:
    """Return the notebook called ``name`` as a page of the book; the original stays as it is.

    Raises:
        ValueError: for solution markers that do not pair up.
    """
    result = copy.deepcopy(notebook)
    result.metadata.pop("widgets", None)  # their state at the time of saving
    cells = []
    for cell in result.cells:
        if cell.cell_type == "markdown":
            cell.source = book_links(cell.source)
            cells.append(cell)
            continue
        describe_figures(cell)
        still_outputs(cell)
        cells += exercise_and_solution(cell)
    core = f"What this notebook builds stands, without the steps, in [its core on one page](../summaries/{name}.md)."
    result.cells = [cells[0], new_markdown_cell(offers(name)), *cells[1:], new_markdown_cell(core)]
    return result


def write(path: Path, source: Path) -> None:
    """Write the page and the two downloads of the notebook at ``path`` into the book's folder ``source``.

    Raises:
        ValueError: for solution markers that do not pair up, naming the notebook.
    """
    for folder in ("notebooks", "downloads"):
        (source / folder).mkdir(exist_ok=True)
    students.write_copies([path], source / "downloads" / "student")
    (source / "downloads" / path.name).write_bytes(path.read_bytes())
    nbformat.write(page(nbformat.read(path, as_version=4), path.stem), source / "notebooks" / path.name)
