"""Sphinx's settings of the book; ``book/build.py`` gathers the pages and runs it."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import ditr_lite  # noqa: E402

project = "ditr_lite"
author = "The ditr_lite developers"
copyright = "the ditr_lite developers; code MIT, text and pictures CC BY 4.0"
version = release = ditr_lite.__version__
language = "en-GB"

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["downloads/**"]
suppress_warnings = ["myst.header", "misc.highlighting_failure"]

# Nothing runs: a page shows the outputs that its notebook was saved with.
nb_execution_mode = "off"
nb_merge_streams = True
nb_output_stderr = "show"
nb_ipywidgets_js = {}  # nothing is live, and these would come from other hosts

myst_enable_extensions = ["amsmath", "attrs_inline", "deflist", "dollarmath"]
myst_heading_anchors = 4
myst_heading_slug_func = "equation_map.slug"
myst_dmath_double_inline = True

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
add_module_names = False
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

# One file that carries its glyphs: version 4 fetches letters such as \mathcal from another host.
mathjax_path = "mathjax-3.2.2/tex-svg.js"
mathjax3_config = {"tex": {"tags": "none"}, "options": {"enableMenu": False}}

html_theme = "furo"
html_title = "ditr_lite"
html_static_path = ["_static"]
html_favicon = "_static/favicon.svg"
html_css_files = ["book.css"]
html_js_files = ["book.js"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_permalinks_icon = "#"
html_theme_options = {"navigation_with_keys": False, "top_of_page_buttons": []}
html_domain_indices = False


def _plain_text(app, what, name, obj, options, lines: list[str]) -> None:
    """Let a docstring's ``|x|`` stay as it is, and an indented block after a colon keep its lines."""
    for number, line in enumerate(lines):
        pieces = line.split("``")
        pieces[::2] = [piece.replace("|", r"\|") for piece in pieces[::2]]
        lines[number] = "``".join(pieces)
    for number, (line, gap, block) in enumerate(zip(lines, lines[1:], lines[2:], strict=False)):
        if line.endswith(":") and not line.endswith("::") and not gap and block.startswith("    "):
            lines[number] = line + ":"


def _only_ours(app, what, name, obj, skip: bool, options) -> bool | None:
    """Leave out what a class has from another library, whose docstrings need that library's own roles."""
    return True if not (getattr(obj, "__module__", None) or "ditr_lite").startswith("ditr_lite") else None


def _roles(app, pagename, templatename, context, doctree) -> None:
    """Mend what a screen reader is told: levels of headings in the side bar, names of folds that hide their words."""
    tree = context.get("furo_navigation_tree", "")
    context["furo_navigation_tree"] = tree.replace('role="heading"', 'role="heading" aria-level="2"')
    context["body"] = context.get("body", "").replace('<summary aria-label="Toggle hidden content">', "<summary>")


def setup(app) -> dict[str, bool]:
    """Connect the changes to members, docstrings (before napoleon reads them: 400 < 500) and pages."""
    app.connect("autodoc-skip-member", _only_ours)
    app.connect("autodoc-process-docstring", _plain_text, priority=400)
    app.connect("html-page-context", _roles, priority=900)  # after furo's own
    return {"parallel_read_safe": True}
