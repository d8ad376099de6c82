"""Write student copies of the notebooks: the same notebooks without the solutions and without outputs.

    python tools/student_copy.py [--out outputs/student] [--solved] [--install OWNER/NAME] [notebook ...]

What stands between ``# BEGIN SOLUTION`` and ``# END SOLUTION`` becomes ``raise NotImplementedError``. The checkers
below it move to a cell of their own, which ends with the number of points, so that nbgrader can mark it; both cells
carry nbgrader's metadata (schema 3). All outputs go, and no output is checked any more. Later cells use the reference
implementation from ``ditr_lite``, so that a copy runs to its end although nothing in it is solved yet.

A copy in which somebody has worked is never overwritten: it is kept, and the command says so.

``--solved`` leaves the solutions in: a source folder for ``nbgrader generate_assignment``. ``--install`` puts a first
cell into each copy that fetches the repository where ``ditr_lite`` is not installed, as on Colab.
"""

import argparse
import ast
import copy
import hashlib
import os
import re
import sys
from pathlib import Path

import nbformat

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = "# BEGIN SOLUTION", "# END SOLUTION"
STUB = 'raise NotImplementedError("your turn: replace this line")'
CHECK_TAG = "nbval-check-output"
CHECK_COMMENT = re.compile(r"^\s*#+\s*NBVAL_CHECK_OUTPUT\s*$\n?", re.MULTILINE)
MAGIC = re.compile(r"^[%!].*$|^[\w.]+\?+$", re.MULTILINE)  # what Jupyter understands and Python does not
REPOSITORY = re.compile(r"[\w.-]+/[\w.-]+")
INSTALL = """# Fetches and installs ditr_lite where it is not installed, as on Colab; elsewhere it does nothing.
import importlib.util
import os
import subprocess
import sys

if importlib.util.find_spec("ditr_lite") is None:
    folder = os.path.abspath("ditr_lite_repository")
    if not os.path.isdir(folder):
        subprocess.run(["git", "clone", "--depth", "1", "{url}", folder], check=True)
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "-e", folder], check=True)
    sys.path.insert(0, folder)  # an editable install is seen only by the next interpreter
    os.chdir(os.path.join(folder, "notebooks"))"""


def strip_solution(source: str) -> str:
    """Return a cell's source with each marked solution replaced by a stub of the same indentation.

    Raises:
        ValueError: when the markers do not pair up, or stand outside a function, where the stub would end the run.
    """
    kept: list[str] = []
    inside = False
    for number, line in enumerate(source.splitlines(), start=1):
        marker = line.strip()
        if marker not in (BEGIN, END):
            if not inside:
                kept.append(line)
            continue
        if (marker == END) != inside:
            raise ValueError(f"line {number}: {marker!r} without its partner: each {BEGIN!r} needs an {END!r}")
        inside = marker == BEGIN
        indent = line[: len(line) - len(line.lstrip())]
        if inside and not indent:
            raise ValueError(f"line {number}: {BEGIN!r} stands outside a function; move it into the function's body")
        if inside:
            kept.append(indent + STUB)
    if inside:
        raise ValueError(f"{BEGIN!r} is never closed; add {END!r}")
    return "\n".join(kept)


def checker_calls(statement: ast.stmt) -> list[str]:
    """Return the source of the calls of checkers (``….check_…(…)``) in a statement, in order."""
    calls = [node for node in ast.walk(statement) if isinstance(node, ast.Call)]
    calls.sort(key=lambda node: (node.lineno, node.col_offset))
    return [ast.unparse(node) for node in calls if getattr(node.func, "attr", "").startswith("check_")]


def split_checkers(source: str) -> tuple[str, list[str]]:
    """Split an exercise cell into what comes before its checkers, and the calls of the checkers.

    Raises:
        ValueError: when something other than checkers stands below the first one: it would belong to neither part.
    """
    statements = ast.parse(source).body
    checking = [bool(checker_calls(statement)) for statement in statements]
    if not any(checking):
        return source, []
    first = checking.index(True)
    if not all(checking[first:]):
        raise ValueError("something stands below the first checker; checkers come last in an exercise's cell")
    above = source.splitlines()[: statements[first].lineno - 1]
    return "\n".join(above).rstrip(), [call for s in statements[first:] for call in checker_calls(s)]


def functions_in(source: str) -> list[str]:
    """Return the names of the functions that a cell defines at its top level, also beside magics and as a lambda.

    None where it is not Python.
    """
    try:
        statements = ast.parse(MAGIC.sub("", source)).body
    except SyntaxError:
        return []
    names = [node.name for node in statements if isinstance(node, ast.FunctionDef)]
    lambdas = [node for node in statements if isinstance(node, ast.Assign) and isinstance(node.value, ast.Lambda)]
    return names + [target.id for node in lambdas for target in node.targets if isinstance(target, ast.Name)]


def _nbgrader(name: str, **role: bool | int) -> dict:
    """Return nbgrader's cell metadata, schema 3: ``solution`` to be written, or ``grade`` to be counted."""
    fields = {"grade_id": name, "schema_version": 3, "cell_type": "code"}
    return fields | {"grade": False, "locked": False, "solution": False, "task": False} | role


def exercise_cells(cell: nbformat.NotebookNode, solved: bool = False) -> list[nbformat.NotebookNode]:
    """Return the cells of a student copy that take the place of one exercise cell: the answer's, and the checkers'.

    Raises:
        ValueError: for markers that do not pair up, and for statements below the checkers.
    """
    above, calls = split_checkers(cell.source)
    answer = copy.deepcopy(cell)
    stripped = strip_solution(above)
    answer.source = above if solved else stripped
    if not calls:
        return [answer]
    name = functions_in(above)[0]
    answer.metadata["nbgrader"] = _nbgrader(name, solution=True)
    checkers = nbformat.v4.new_code_cell("sum([" + ", ".join(calls) + "])  # points", id=f"{cell.id}-check")
    if len(checkers.source) > 100:
        checkers.source = "sum(\n    [\n        " + ",\n        ".join(calls) + ",\n    ]\n)  # points"
    checkers.metadata["nbgrader"] = _nbgrader(f"{name}-check", grade=True, locked=True, points=len(calls))
    return [answer, checkers]


def fingerprint(notebook: nbformat.NotebookNode) -> str:
    """Return the SHA-256 of all that a person can write in a notebook: the kinds and sources of its cells."""
    written = "\0".join(f"{cell.cell_type}\0{cell.source}" for cell in notebook.cells)
    return hashlib.sha256(written.encode()).hexdigest()


def student_copy(
    notebook: nbformat.NotebookNode, name: str = "", solved: bool = False, root: str = ".."
) -> nbformat.NotebookNode:
    """Return a copy of ``notebook`` without solutions, outputs and output checks; the original stays as it is.

    Args:
        notebook: one with the solutions marked.
        name: what its copies are recognised by when they are handed in, for example ``00_start_here``.
        solved: leave the solutions in, markers included.
        root: the repository, as seen from the copy's folder; links begin there.

    Raises:
        ValueError: for an exercise that cannot be taken apart, naming the code cell.
    """
    student = copy.deepcopy(notebook)
    cells: list[nbformat.NotebookNode] = []
    code = 0
    for cell in student.cells:
        if cell.cell_type != "code":
            cell.source = cell.source.replace("](../", f"]({root}/")
            cells.append(cell)
            continue
        cell.outputs, cell.execution_count = [], None
        cell.source = CHECK_COMMENT.sub("", cell.source)
        if CHECK_TAG in cell.metadata.get("tags", []):
            cell.metadata.tags.remove(CHECK_TAG)
        try:
            cells += exercise_cells(cell, solved) if BEGIN in cell.source or END in cell.source else [cell]
        except (SyntaxError, ValueError) as error:
            raise ValueError(f"code cell {code}, {error}") from None
        code += 1
    student.cells = cells
    student.metadata.pop("widgets", None)  # the state of sliders whose outputs are gone
    student.metadata["ditr_lite"] = {"notebook": name, "fingerprint": fingerprint(student)}
    return student


def add_install_cell(student: nbformat.NotebookNode, repository: str) -> None:
    """Put the cell first that fetches ``repository`` (a clone's address) where ``ditr_lite`` is not installed."""
    student.cells.insert(0, nbformat.v4.new_code_cell(INSTALL.format(url=repository), id="install"))
    student.metadata.ditr_lite["fingerprint"] = fingerprint(student)


def recorded_fingerprint(path: Path) -> str | None:
    """Return the fingerprint with which a student copy was written, or None where the file holds none."""
    try:
        return nbformat.read(path, as_version=4).metadata.ditr_lite.fingerprint
    except (OSError, ValueError, AttributeError, nbformat.ValidationError):
        return None


def was_worked_in(path: Path) -> bool:
    """Return whether a student copy was changed since it was written; what cannot be read counts as changed."""
    recorded = recorded_fingerprint(path)
    return recorded is None or recorded != fingerprint(nbformat.read(path, as_version=4))


def seen_from(folder: Path) -> str:
    """Return the path of the repository from a folder, as links write it."""
    try:
        return Path(os.path.relpath(ROOT, folder)).as_posix()
    except ValueError:  # on another drive of Windows
        return ROOT.as_posix()


def write_copies(
    paths: list[Path], out: Path, solved: bool = False, repository: str | None = None
) -> tuple[list[Path], list[Path]]:
    """Write student copies into ``out``; return the files that are up to date, and those kept because changed.

    Raises:
        ValueError: for an exercise that cannot be taken apart, naming the notebook; then nothing is written.
    """
    copies, root = {}, seen_from(out)
    for path in paths:
        try:
            student = student_copy(nbformat.read(path, as_version=4), path.stem, solved, root)
        except ValueError as error:
            raise ValueError(f"{path.name}: {error}") from None
        if repository:
            add_install_cell(student, repository)
        copies[out / path.name] = student
    out.mkdir(parents=True, exist_ok=True)
    written, kept = [], []
    for target, student in copies.items():
        if target.exists() and was_worked_in(target):
            kept.append(target)
            continue
        written.append(target)
        if target.exists() and recorded_fingerprint(target) == student.metadata.ditr_lite.fingerprint:
            continue  # up to date; outputs that somebody has computed in it stay
        part = target.with_name(target.name + ".part")
        nbformat.write(student, part)
        os.replace(part, target)
    return written, kept


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("notebooks", nargs="*", type=Path, help="default: all in notebooks/")
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "student", help="default: outputs/student")
    parser.add_argument("--solved", action="store_true", help="leave the solutions in, for nbgrader's source folder")
    parser.add_argument("--install", metavar="OWNER/NAME", help="add a cell that fetches this GitHub repository")
    options = parser.parse_args(arguments)
    repository = options.install
    if repository and REPOSITORY.fullmatch(repository):
        repository = f"https://github.com/{repository}"
    paths = options.notebooks or sorted((ROOT / "notebooks").glob("*.ipynb"))
    if absent := [str(path) for path in paths if not path.is_file()]:
        print(f"student_copy: there is no notebook {', '.join(absent)}", file=sys.stderr)
        return 2
    try:
        written, kept = write_copies(paths, options.out, options.solved, repository)
    except (OSError, ValueError) as error:
        print(f"student_copy: {error}", file=sys.stderr)
        return 1
    print(f"{len(written)} student copies in {options.out}")
    for path in kept:
        print(f"kept as it is, because it was changed: {path} (rename or remove it to get a fresh copy)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
