"""Pages of the book that are made from the repository's own files, so that nothing is written twice.

The start page's table and the results come from README.md, the data card from its own file, the equation map from
PAPER_MAP.md, the summary of a notebook from the source of what that map says it teaches, and the reference from the
package's list of its modules.
"""

import ast
import inspect
import re
import shutil
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import nbformat
from equation_map import Part, parts, slug

import ditr_lite

LINK = re.compile(r"\[([^\]]+)\]\(([^)#\s]+)\)")
FIRST_ROOM = "datasets"  # in the package's list; what stands before it is the core
PAGES = {"data_samples/README.md": "data_card.md", "PAPER_MAP.md": "equation_map.md"}


def write_all(root: Path, source: Path, notebooks: list[str]) -> None:
    """Write every generated page of the repository at ``root`` into ``source``, for the notebooks of these names.

    Raises:
        ValueError: when README.md lacks a section that the book shows.
    """
    readme = (root / "README.md").read_text(encoding="utf-8")
    for name in ("result.png", "contact_sheet.png", "contact_sheet_rooms.png"):
        shutil.copy(root / "data_samples" / name, source)
    table = _links(_section(readme, "The notebooks"), notebooks)
    order = _contents({name: f"{name[:2]} · {_title(root, name)}" for name in notebooks}, "Notebooks", "notebooks/")
    guides = {path.stem: "" for path in sorted((source / "notebooks").glob("*.md"))}
    teach = _contents(guides, "To teach", "notebooks/")
    _fill(source / "index.md", {"notebooks": table, "contents": order, "to teach": teach})
    results = _section(readme, "Results").replace("\n**", "\n\n**")
    limits = _section(readme, "What it does not do")
    _write(source / "results.md", f"# Results\n\n{_links(results)}\n\n## What it does not do\n\n{_links(limits)}")
    card = (root / "data_samples" / "README.md").read_text(encoding="utf-8")
    # the panoramas' own page is no page of the book
    _write(source / "data_card.md", card.replace("[environments](environments/README.md)", "`environments`"))
    _write(source / "changelog.md", (root / "CHANGELOG.md").read_text(encoding="utf-8"))
    names = ("LICENSE", "LICENSE-CC-BY-4.0")
    texts = {name: (root / name).read_text(encoding="utf-8") for name in names}
    _fill(source / "licence.md", {name.lower(): _fenced(text, "text") for name, text in texts.items()})
    found = parts(root / "PAPER_MAP.md")
    _write(source / "equation_map.md", equation_map(found, notebooks, root))
    for name in notebooks:
        _write(source / "summaries" / f"{name}.md", summary(name, found, root))
    for module in core():
        _write(source / "api" / f"{module}.md", reference(module))
    _write(source / "api" / "index.md", reference_index())


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _fill(path: Path, values: dict[str, str]) -> None:
    """Put values where a page says ``<!-- name -->``."""
    text = path.read_text(encoding="utf-8")
    for name, value in values.items():
        place = f"<!-- {name} -->"
        if place not in text:
            raise ValueError(f"{path.name} should say {place} where that goes")
        text = text.replace(place, value)
    path.write_text(text, encoding="utf-8")


def _contents(pages: dict[str, str], caption: str, folder: str) -> str:
    """Return the directive that puts pages (name -> title, "" for their own) below a caption of the side bar."""
    lines = [f"{title} <{folder}{name}>" if title else f"{folder}{name}" for name, title in pages.items()]
    return "\n".join(["```{toctree}", ":hidden:", f":caption: {caption}", "", *lines, "```"]) if lines else ""


def _title(root: Path, notebook: str) -> str:
    cells = nbformat.read(root / "notebooks" / f"{notebook}.ipynb", as_version=4).cells
    return cells[0].source.splitlines()[0].lstrip("# ")


def _fenced(text: str, language: str) -> str:
    return f"```{language}\n{text.strip()}\n```"


def _section(text: str, heading: str) -> str:
    """Return what stands below a second-level heading, without its comments.

    Raises:
        ValueError: where there is no such heading.
    """
    match = re.search(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    if not match:
        raise ValueError(f"README.md has no section {heading!r}, which the book shows")
    return re.sub(r"<!--.*?-->", "", match[1], flags=re.DOTALL).strip()


def _links(text: str, notebooks: list[str] | None = None) -> str:
    """Return Markdown of the repository's root with links that hold in the book; others become their words."""

    def link(match: re.Match) -> str:
        words, target = match.groups()
        if target.startswith("notebooks/"):
            return match[0] if notebooks is None or Path(target).stem in notebooks else words
        if re.match(r"[a-z]+:", target):
            return match[0]
        return f"[{words}]({PAGES[target]})" if target in PAGES else words

    return LINK.sub(link, text)


# --- the module -------------------------------------------------------------------------------------------------------


def folder(module: str) -> Path:
    """Return where the package keeps a module that has a folder."""
    return Path(ditr_lite.__file__).parent / module


def core() -> list[str]:
    """Return the modules of the core, in the package's own order: all that stand before the first room."""
    return list(ditr_lite.MODULES[: ditr_lite.MODULES.index(FIRST_ROOM)])


def rooms() -> list[str]:
    """Return the rooms below the core, in the package's own order."""
    return [name for name in ditr_lite.MODULES if name not in core()]


def resolve(function: str) -> object:
    """Return what a dotted name within ditr_lite is: modules first, then what is in them.

    Raises:
        AttributeError: where there is no such thing.
    """
    thing = ditr_lite
    for name in function.split("."):
        inside = f"{thing.__name__}.{name}" if hasattr(thing, "__path__") else ""  # only packages have modules in them
        thing = import_module(inside) if inside and find_spec(inside) else getattr(thing, name)
    return thing


def _home(thing: object) -> str:
    """Return the dotted name under which the reference has a function or class."""
    return f"{thing.__module__}.{thing.__qualname__}"


def _in_reference(thing: object) -> bool:
    module = getattr(thing, "__module__", "")
    return module.startswith("ditr_lite.") and module.split(".")[1] in core()


def code_link(function: str) -> str:
    """Return a link to a function's reference where the book has it, else its name."""
    thing = resolve(function)
    return f"{{py:obj}}`{function} <{_home(thing)}>`" if _in_reference(thing) else f"`{function}`"


def _first_sentence(thing: object) -> str:
    text = " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())
    text = re.sub(r":\w+:`~?\.?([^`]+)`", r"`\1`", text).replace("``", "`")
    return text.replace("|", r"\|").replace("$", r"\$")


# --- pages ------------------------------------------------------------------------------------------------------------


def _headings(path: Path) -> set[str]:
    cells = nbformat.read(path, as_version=4).cells
    lines = [line for cell in cells if cell.cell_type == "markdown" for line in cell.source.splitlines()]
    return {line.lstrip("#").strip() for line in lines if line.startswith("#")}


def equation_map(found: list[Part], notebooks: list[str], root: Path) -> str:
    """Return the page that says where each part of the paper is: function, test and place in a notebook."""
    headings = {name: _headings(root / "notebooks" / f"{name}.ipynb") for name in notebooks}
    lines = [
        "# Equation map",
        "",
        "Where each equation, table and figure of the paper is in the code and in the notebooks.",
    ]
    group = ""
    for part in found:
        if part.group != group:
            group = part.group
            lines += ["", f"## {group}", "", "| | in the paper | function | notebook | test |", "|---|---|---|---|---|"]
        place = part.notebook or "no counterpart here"
        if part.notebook in headings:
            known = part.anchor in headings[part.notebook]
            anchor = f"#{slug(part.anchor)}" if known else ""
            place = f"[{part.notebook[:2]}, {part.anchor}](notebooks/{part.notebook}.ipynb{anchor})"
        function = code_link(part.function) if part.function else "–"
        test = f"`{part.test}`" if part.test else "–"
        lines.append(f"| {part.id} | {part.paper} | {function} | {place} | {test} |")
    return "\n".join(lines) + "\n"


def _called(path: Path) -> Iterator[str]:
    """Yield module.name for each name of ditr_lite that a notebook's code calls, once."""
    cells = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    trees = []
    for cell in cells:
        try:
            trees.append(ast.parse(cell))
        except SyntaxError:  # a magic or a shell command
            continue
    nodes = [node for tree in trees for node in ast.walk(tree)]
    known = {"dl": ""}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module == "ditr_lite":
            known |= {name.asname or name.name: name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ditr_lite."):
            inner = node.module.removeprefix("ditr_lite.")
            known |= {name.asname or name.name: f"{inner}.{name.name}" for name in node.names}
    calls = [ast.unparse(node.func) for node in nodes if isinstance(node, ast.Call)]
    for call in dict.fromkeys(calls):
        first, *rest = call.split(".")
        if first in known:
            yield ".".join(filter(None, [known[first], *rest]))


def _things(names: Iterator[str]) -> dict[str, object]:
    """Return home -> function or class of the core for those names that are one."""
    found = {}
    for name in names:
        try:
            thing = resolve(name)
        except (AttributeError, ImportError):  # a name that a notebook gave to something of its own
            continue
        if (inspect.isfunction(thing) or inspect.isclass(thing)) and _in_reference(thing):
            found[_home(thing)] = thing
    return found


def summary(name: str, found: list[Part], root: Path) -> str:
    """Return the core of the notebook called ``name``: source of what it teaches, and what else it calls."""
    path = root / "notebooks" / f"{name}.ipynb"
    title = _title(root, name)
    taught: dict[str, list[Part]] = {}
    for part in found:
        if part.notebook == name:
            taught.setdefault(part.function, []).append(part)
    lines = [f"# {name[:2]} in short: {title[0].lower() + title[1:]}", ""]
    lines += [f"What [notebook {name[:2]}](../notebooks/{name}.ipynb) builds, as the module has it.", ""]
    sources = {}
    for function, here in taught.items():
        thing = resolve(function)
        sources[_home(thing)] = thing
        lines += [f"## {' · '.join(part.id for part in here)}: `{function}`", ""]
        lines += ["; ".join(part.paper for part in here) + ".", ""]
        lines += [f"Reference: {code_link(function)}.", ""] if _in_reference(thing) else []
        lines += [_fenced(inspect.getsource(thing), "python"), ""]
    others = {home: thing for home, thing in _things(_called(path)).items() if home not in sources}
    if others:
        lines += ["## What else it calls", "", "| name | what it does |", "|---|---|"]
        for home, thing in sorted(others.items()):
            lines.append(f"| {{py:obj}}`{home.removeprefix('ditr_lite.')} <{home}>` | {_first_sentence(thing)} |")
    return "\n".join(lines) + "\n"


def _files(module: str) -> list[str]:
    """Return the dotted names of a module and, where it is a folder, of the files in it."""
    inner = sorted(path.stem for path in folder(module).glob("[!_]*.py"))
    return [f"ditr_lite.{module}", *(f"ditr_lite.{module}.{name}" for name in inner)]


def reference(module: str) -> str:
    """Return the reference page of one module of the core."""
    lines = [f"# `{module}`", ""]
    for dotted in _files(module):
        lines += [f"## `{dotted}`", ""] if len(_files(module)) > 1 else []
        lines += ["```{eval-rst}", f".. automodule:: {dotted}", "   :members:", "   :show-inheritance:", "```", ""]
    return "\n".join(lines)


def reference_index() -> str:
    """Return the first page of the reference: the core in its order, then the rooms."""
    lines = ["# Reference", "", "The core: what the paper or `import ditr_lite as dl` names.", ""]
    lines += ["| module | what is in it |", "|---|---|"]
    lines += [f"| [`{m}`]({m}.md) | {_first_sentence(import_module(f'ditr_lite.{m}'))} |" for m in core()]
    if rooms():
        lines += ["", "Rooms beside it, documented in their files:", "", "| room | what is in it |", "|---|---|"]
        lines += [f"| `{m}` | {_first_sentence(import_module(f'ditr_lite.{m}'))} |" for m in rooms()]
    return "\n".join([*lines, "", "```{toctree}", ":hidden:", "", *core(), "```", ""])
