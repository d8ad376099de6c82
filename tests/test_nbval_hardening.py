"""nbval alone passes cells that check nothing; with the repository's conftest.py each of them fails.

Two small notebooks, one honest and one full of planted faults, are run by a pytest of their own: with conftest.py, and
without it to show that each planted fault really is a hole.
"""

import base64
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_notebook, new_output

ROOT = Path(__file__).resolve().parents[1]
PNG = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
OTHER_PNG = base64.b64encode(base64.b64decode(PNG) + b"other").decode()
SHOW = f"from IPython.display import display\ndisplay({{'image/png': '{PNG}', 'text/plain': '<Figure>'}}, raw=True)"


def stdout(text):
    return new_output("stream", name="stdout", text=text)


def cell(source, *outputs, count=1, tag=None):
    return new_code_cell(source, outputs=list(outputs), execution_count=count, metadata={"tags": [tag] if tag else []})


def image(png, text="<Figure>"):
    return new_output("display_data", data={"image/png": png, "text/plain": text})


CHECK, RAISES = "nbval-check-output", "raises-exception"
HONEST = {
    "checked": cell("print(1 + 1)", stdout("2\n"), tag=CHECK),
    "checked by comment": cell("# NBVAL_CHECK_OUTPUT\nprint(3)", stdout("3\n")),
    "unchecked, output differs": cell("print(2)", stdout("other\n")),
    "unchecked, not run": cell("x = 1", count=None),
    "image differs": cell(SHOW, image(OTHER_PNG), tag=CHECK),
    "raises": cell("1 / 0", tag=RAISES),
    "known magic": cell("%pwd"),
    "shell succeeds": cell("!true"),
    "path and address": cell(
        "print('/some/where/data_samples/a.png <object at 0x7f00aa11bb22>')",
        stdout("/else/where/deep/data_samples/a.png <object at 0x7f99cc33dd44>\n"),
        tag=CHECK,
    ),
}
# Holes: nbval alone passes every one of these.
HOLES = {
    "count stripped, output too": (cell("print(1 + 1)", count=None, tag=CHECK), "no execution count"),
    "nothing stored": (cell("x = 2", tag=CHECK), "no stored output"),
    "raises nothing": (cell("x = 3", tag=RAISES), "nothing was raised"),
    "raises by unknown magic only": (cell("%no_such_magic", tag=RAISES), "nothing was raised"),
    "unknown line magic": (cell("%no_such_magic\nassert False"), "no_such_magic` not found"),
    "unknown cell magic": (cell("%%no_such_magic\nassert False"), "no_such_magic` not found"),
    "shell fails": (cell("!false"), "CalledProcessError"),
    "shell fails in between": (cell("!false\n!true"), "CalledProcessError"),
    "shell fails in an assignment": (cell("text = !false"), "CalledProcessError"),
}
# Faults that nbval itself finds: our wrapper must not hide them.
FAULTS = {
    "output differs": (cell("print(1 + 1)", stdout("3\n"), tag=CHECK), "Cell outputs differ"),
    "image's text differs": (cell(SHOW, image(PNG, "<Other>"), tag=CHECK), "Cell outputs differ"),
    "path's own part differs": (
        cell("print('/some/data_samples/a.png')", stdout("/some/data_samples/b.png\n"), tag=CHECK),
        "Cell outputs differ",
    ),
    "exception": (cell("1 / 0"), "ZeroDivisionError"),
}
BAD = HOLES | FAULTS


def run(folder, cells):
    """Run ``cells`` (name -> cell), each kind of notebook a file; return {name: reason of failure, None if it passed}.

    Bad cells have a notebook, and so a kernel, of their own: what they leave behind must not reach the honest ones.
    """
    names = {"honest": [name for name in cells if name in HONEST], "bad": [name for name in cells if name in BAD]}
    for notebook in filter(names.get, names):
        content = new_notebook(cells=[cells[name] for name in names[notebook]])
        nbformat.write(content, folder / f"{notebook}.ipynb")
    options = ["--nbval-lax", "--nbval-current-env", "--nbval-cell-timeout=60", "--junitxml=report.xml"]
    sanitize = f"--nbval-sanitize-with={ROOT / 'tests' / 'nbval_sanitize.cfg'}"
    (folder / "pytest.ini").write_text("[pytest]\n")  # keeps the repository's own settings out
    command = [sys.executable, "-m", "pytest", "--color=no", "-p", "no:cacheprovider", *options, sanitize, "."]
    subprocess.run(command, cwd=folder, capture_output=True, timeout=300)
    outcomes = {}
    for case in ElementTree.parse(folder / "report.xml").iter("testcase"):
        name = names[Path(case.get("classname")).stem][int(case.get("name").removeprefix("Cell "))]
        outcomes[name] = "\n".join(problem.text for problem in case) or None
    return outcomes


@pytest.fixture(scope="module")
def hardened(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hardened")
    shutil.copy(ROOT / "conftest.py", folder)
    return run(folder, HONEST | {name: cell for name, (cell, _) in BAD.items()})


def test_every_cell_was_run(hardened):
    assert hardened.keys() == HONEST.keys() | BAD.keys() and not HONEST.keys() & BAD.keys()


def test_honest_cells_pass(hardened):
    assert {name: hardened[name] for name in HONEST if hardened[name]} == {}


def test_bad_cells_fail_and_say_why(hardened):
    wrong = {name: hardened[name] for name, (_, reason) in BAD.items() if reason not in str(hardened[name])}
    assert wrong == {}


def test_nbval_alone_would_pass_the_holes(tmp_path):
    """Where this fails, a newer nbval has closed the hole itself and our wrapper can lose that part."""
    assert run(tmp_path, {name: cell for name, (cell, _) in HOLES.items()}) == dict.fromkeys(HOLES)
