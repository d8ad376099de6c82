"""book/: what becomes of a notebook and of the paper map on their way to a page; Sphinx itself is not run here."""

import hashlib
import importlib
import re
import sys
from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

ROOT = Path(__file__).resolve().parents[1]
MATHJAX = "d4295dc33744836935c1399feece5159577b34c5c8ffb9f1c6324cd82e03a882"  # es5/tex-svg.js of npm's mathjax 3.2.2
AXE = "29348999450cdf2849a8e70b7912fc2da85a849da39c0d0d5394f51d4a9ed95c"  # axe.min.js of npm's axe-core 4.14.1
PNG = "iVBORw0KGgo="


def load(name):
    sys.path.insert(0, str(ROOT / "book"))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(ROOT / "book"))


equation_map, notebook_pages, generated_pages = map(load, ("equation_map", "notebook_pages", "generated_pages"))

SOLVED = "def f(x):\n    # BEGIN SOLUTION\n    return 2 * x\n    # END SOLUTION"


def shown(**data):
    return new_output("display_data", data={key.replace("__", "/"): value for key, value in data.items()})


def test_alternative_text_goes_where_sphinx_looks():
    cell = new_code_cell("plot()", metadata={"alt": "two rising curves"}, outputs=[shown(image__png=PNG)])
    page = notebook_pages.page(new_notebook(cells=[new_markdown_cell("# T"), cell]), "07_metrics")
    assert page.cells[2].metadata["mystnb"]["image"] == {"alt": "two rising curves"}
    assert "mystnb" not in cell.metadata


def test_live_outputs_become_still():
    plotly, widget = "application/vnd.plotly.v1+json", "application/vnd.jupyter.widget-view+json"
    pair = new_output("display_data", data={"image/png": PNG, "text/plain": "<Figure>", plotly: {}})
    words = new_output("display_data", data={"text/plain": "a cloud", widget: {}})
    cell = new_code_cell("x", outputs=[pair, words])
    notebook_pages.still_outputs(cell)
    assert [dict(output.data) for output in cell.outputs] == [{"image/png": PNG}, {"text/plain": "a cloud"}]


def test_an_exercise_stands_open_above_its_folded_solution():
    exercise, solution = notebook_pages.exercise_and_solution(new_code_cell(SOLVED, metadata={"tags": ["a"]}))
    assert "NotImplementedError" in exercise.source and "2 * x" not in exercise.source
    assert solution.source == SOLVED and solution.metadata.tags == ["a", "hide-input"]
    assert solution.metadata.mystnb["code_prompt_show"] == "Show a solution"
    assert len(notebook_pages.exercise_and_solution(new_code_cell("x = 1"))) == 1


@pytest.mark.parametrize(
    ("link", "becomes"),
    [
        ("[a](04_ddpm_math.ipynb#x)", "[a](04_ddpm_math.ipynb#x)"),
        ("[a](https://arxiv.org/abs/1)", "[a](https://arxiv.org/abs/1)"),
        ("[a](../PAPER_MAP.md)", "[a](../equation_map.md)"),
        ("[a](../book/glossary.md#term-region)", "{term}`a <region>`"),
        ("[a](../book/glossary.md#term-signal-to-noise-ratio)", "{term}`a <signal-to-noise ratio>`"),
        ("[a](../book/glossary.md)", "[a](../glossary.md)"),
        ("see [a file](../ditr_lite/config.py) there", "see a file there"),
        ("![alt](attachment:p.png)", "![alt](attachment:p.png)"),
    ],
)
def test_links_hold_in_the_book_or_become_words(link, becomes):
    assert notebook_pages.book_links(link) == becomes


def test_the_paper_map_is_read_whole():
    found = {part.id: part for part in equation_map.parts(ROOT / "PAPER_MAP.md")}
    eq8 = found["Eq. 8"]
    assert (eq8.function, eq8.test, eq8.notebook) == ("diffusion.loss", "test_eps_loss_is_eq8", "04_ddpm_math")
    assert eq8.group == "Equations" and eq8.anchor.startswith("5 ") and "objective" in eq8.paper
    assert found["C7"].function == "peers.ideas.ImplicitRays" and found["C7"].notebook == "08_ablations"
    assert len(found) == sum(line.startswith("| ") and line[2] != "|" for line in _lines("PAPER_MAP.md"))


def _lines(name):
    return (ROOT / name).read_text(encoding="utf-8").splitlines()


def test_a_row_of_another_form_is_refused(tmp_path):
    (tmp_path / "map.md").write_text("## A\n\n| Eq. 1 | one | two |\n", encoding="utf-8")
    with pytest.raises(ValueError, match="expected five columns, got 3"):
        equation_map.parts(tmp_path / "map.md")


def test_a_link_to_a_term_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="no such term"):
        notebook_pages.book_links("[a](../book/glossary.md#term-nonsense)")


def test_links_of_the_notebooks_lead_to_terms_of_the_glossary():
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for cell in nbformat.read(path, as_version=4).cells:
            if cell.cell_type == "markdown":
                notebook_pages.book_links(cell.source)


def test_a_summary_shows_the_source_of_what_its_notebook_teaches():
    found = equation_map.parts(ROOT / "PAPER_MAP.md")
    page = generated_pages.summary("04_ddpm_math", found, ROOT)
    assert "Reference: {py:obj}" in generated_pages.summary("02_region_refinement", found, ROOT)
    assert "## Eq. 7: `diffusion.q_sample`" in page and "def q_sample(" in page
    assert "{py:obj}`schedule.make_schedule <ditr_lite.schedule.make_schedule>`" in page


def test_the_equation_map_links_into_notebooks():
    found = equation_map.parts(ROOT / "PAPER_MAP.md")
    page = generated_pages.equation_map(found, ["04_ddpm_math"], ROOT)
    assert "(notebooks/04_ddpm_math.ipynb#eq-9-as-printed-then-as-it-must-be)" in page
    assert "{py:obj}`diffusion.q_sample <ditr_lite.diffusion.q_sample>`" in page


def test_the_reference_follows_the_packages_list():
    import ditr_lite

    names = generated_pages.core()
    assert {"config", "diffusion", "boundary", "region", "pipeline"} <= set(names)
    assert "viz" in generated_pages.rooms() and all(map(generated_pages._files, names))
    assert [name for name in ditr_lite.MODULES if name in names] == names
    assert set(names) | set(generated_pages.rooms()) == set(ditr_lite.MODULES)


def test_the_cheat_sheet_names_what_the_code_has():
    from ditr_lite.config import Config

    text = (ROOT / "book" / "symbols.md").read_text(encoding="utf-8")
    config = Config()
    (height, width), cells = config.size, [side // 4 for side in config.size]
    usual = {
        "height and width of the picture, in pixels": f"{height}, {width}",
        "height and width of the latent grid": f"{cells[0]}, {cells[1]}; in a window {config.window // 4}",
        "channels of a latent": config.autoencoder.latent_channels,
        "samples drawn for one frame": config.sampler.samples,
        "diffusion steps": f"{config.schedule.timesteps:,}",
        "entries of the codebook": f"{config.autoencoder.codes:,}",
    }
    for what, value in usual.items():
        [line] = [line for line in text.splitlines() if f"| {what}" in line]
        assert line.split("|")[3].strip().startswith(str(value)), line
    code = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "ditr_lite").rglob("*.py"))
    names = {name.split(".")[-1] for name in re.findall(r"`(?:out\.)?([a-z][a-z0-9_]+)`", text)}
    assert len(names) > 30 and [name for name in names if not re.search(rf"\b{name}\b", code)] == []


@pytest.mark.parametrize(
    ("path", "digest"),
    [("book/_static/mathjax-3.2.2/tex-svg.js", MATHJAX), ("tests/browser/axe-core-4.14.1/axe.min.js", AXE)],
)
def test_what_is_not_ours_is_what_npm_has(path, digest):
    assert hashlib.sha256((ROOT / path).read_bytes()).hexdigest() == digest
    assert (ROOT / path).parent.joinpath("LICENSE").is_file()
