"""tools/student_copy.py: exercises that nbgrader can mark, work that is kept, a first cell that installs."""

import ast
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
import student_copy as students
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
EXERCISE = """import math


def area(r):
    # BEGIN SOLUTION
    return math.pi * r**2
    # END SOLUTION


def double(x):
    # BEGIN SOLUTION
    return 2 * x
    # END SOLUTION


_ = checks.check_area(area), checks.check_double(double)"""


def notebook(source=EXERCISE):
    stored = [new_output("stream", name="stdout", text="✓ area\n✓ double\n")]
    cells = [new_markdown_cell("# Circles", id="a"), new_code_cell(source, id="b", outputs=stored, execution_count=1)]
    return new_notebook(cells=cells)


@pytest.fixture
def original(tmp_path):
    nbformat.write(notebook(), tmp_path / "00_circles.ipynb")
    return tmp_path / "00_circles.ipynb"


def test_an_exercise_becomes_an_answer_and_its_checkers():
    _, answer, checkers = students.student_copy(notebook()).cells
    assert answer.source.startswith("import math") and answer.source.count(students.STUB) == 2
    assert "check_" not in answer.source and answer.source == answer.source.rstrip()
    assert checkers.source == "sum([checks.check_area(area), checks.check_double(double)])  # points"
    assert checkers.outputs == [] and checkers.id == "b-check"
    assert answer.metadata.nbgrader == {
        "schema_version": 3,
        "grade_id": "area",
        "cell_type": "code",
        "solution": True,
        "grade": False,
        "locked": False,
        "task": False,
    }
    assert checkers.metadata.nbgrader == answer.metadata.nbgrader | {
        "grade_id": "area-check",
        "solution": False,
        "grade": True,
        "locked": True,
        "points": 2,
    }


def test_the_checkers_cell_ends_with_the_points():
    source = students.student_copy(notebook()).cells[2].source
    verdicts = type("checks", (), {"check_area": staticmethod(bool), "check_double": staticmethod(bool)})
    assert eval(source, {"checks": verdicts, "area": 1, "double": 0}) == 1


def test_solutions_can_stay_for_nbgrader_to_take_out():
    _, answer, checkers = students.student_copy(notebook(), solved=True).cells
    assert answer.source.count(students.BEGIN) == 2 and "math.pi" in answer.source
    assert checkers.metadata.nbgrader.points == 2


def test_what_stands_below_the_checkers_is_refused():
    with pytest.raises(ValueError, match="code cell 0, something stands below the first checker"):
        students.student_copy(notebook(EXERCISE + "\nprint(area(1))"))


def test_links_lead_to_the_repository_from_wherever_a_copy_lies(tmp_path):
    path = ROOT / "notebooks" / "08_ablations.ipynb"
    students.write_copies([path], tmp_path / "a" / "b")
    student = nbformat.read(tmp_path / "a" / "b" / path.name, as_version=4)
    linked = [part.split(")")[0] for cell in student.cells for part in cell.source.split("](")[1:]]
    assert any("data_samples" in link for link in linked)
    for link in linked:
        if ".." in link:
            assert (tmp_path / "a" / "b" / link.split("#")[0]).exists(), link


def test_a_copy_that_somebody_worked_in_is_kept(original, tmp_path, capsys):
    out = tmp_path / "out"
    assert students.main([str(original), "--out", str(out)]) == 0 and "kept" not in capsys.readouterr().out
    target = out / original.name
    student = nbformat.read(target, as_version=4)
    student.cells[1].source = "my own work"
    nbformat.write(student, target)
    before = target.read_bytes()
    assert students.main([str(original), "--out", str(out)]) == 0
    assert target.read_bytes() == before
    printed = capsys.readouterr().out
    assert printed.startswith("0 student copies") and f"kept as it is, because it was changed: {target}" in printed


@pytest.mark.parametrize("content", ["", "{}", '{"cells": [], "metadata": {}, "nbformat": 4, "nbformat_minor": 5}'])
def test_a_file_that_is_no_copy_of_ours_is_kept(content, original, tmp_path):
    (tmp_path / "out").mkdir()
    target = tmp_path / "out" / original.name
    target.write_text(content)
    assert students.write_copies([original], tmp_path / "out") == ([], [target])
    assert target.read_text() == content


def test_a_copy_that_was_only_run_keeps_its_outputs_until_the_notebook_changes(original, tmp_path):
    out = tmp_path / "out"
    [target], _ = students.write_copies([original], out)
    student = nbformat.read(target, as_version=4)
    student.cells[1].outputs = [new_output("stream", name="stdout", text="mine\n")]
    nbformat.write(student, target)
    students.write_copies([original], out)
    assert nbformat.read(target, as_version=4).cells[1].outputs
    nbformat.write(notebook(EXERCISE.replace("area", "surface")), original)
    students.write_copies([original], out)
    assert "surface" in target.read_text() and nbformat.read(target, as_version=4).cells[1].outputs == []


def test_nothing_is_written_when_one_notebook_is_bad(original, tmp_path, capsys):
    bad = tmp_path / "01_bad.ipynb"
    nbformat.write(notebook("# END SOLUTION"), bad)
    assert students.main([str(original), str(bad), "--out", str(tmp_path / "out")]) == 1
    assert "01_bad.ipynb" in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_every_exercise_can_be_marked(path):
    student = students.student_copy(nbformat.read(path, as_version=4), path.stem)
    assert student.metadata.ditr_lite.notebook == path.stem and "widgets" not in student.metadata
    marks = [cell.metadata.nbgrader for cell in student.cells if "nbgrader" in cell.metadata]
    assert len({mark.grade_id for mark in marks}) == len(marks) >= 6  # an answer and its checkers at three levels
    answers, checkers = marks[::2], marks[1::2]
    assert all(mark.solution and not mark.grade for mark in answers)
    assert all(mark.grade and mark.locked and mark.points > 0 for mark in checkers)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_nothing_depends_on_an_answer(path):
    """So an unsolved copy runs to its end as the notebook itself does, which is executed cell by cell elsewhere."""
    solved = students.student_copy(nbformat.read(path, as_version=4), path.stem, solved=True)
    answers, others = set(), []
    for cell in solved.cells:
        mark = cell.metadata.get("nbgrader", {})
        if mark.get("solution"):
            answers |= set(students.functions_in(cell.source))
        elif cell.cell_type == "code" and not mark and not cell.source.startswith("%"):
            others.append(cell.source)
    used = {node.id for source in others for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name)}
    made = {node.id for node in ast.walk(ast.parse("\n".join(others))) if _is_stored(node)}
    assert answers & (used - made) == set()


def _is_stored(node):
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)


def test_the_install_cell_does_nothing_where_the_package_is():
    source = students.INSTALL.format(url="nowhere")
    subprocess.run([sys.executable, "-c", source], check=True, cwd=ROOT)


def test_the_install_cell_fetches_what_is_missing(tmp_path, original):
    """Run the cell in an interpreter in which nothing is installed and git and pip only note their arguments."""
    assert students.main([str(original), "--out", str(tmp_path / "out"), "--install", "someone/ditr_lite"]) == 0
    student = nbformat.read(tmp_path / "out" / original.name, as_version=4)
    nbformat.validate(student)
    pretend = (
        "import os, subprocess\ncalls = []\n"
        "def run(command, check):\n    calls.append(command)\n"
        "    os.makedirs('ditr_lite_repository/notebooks', exist_ok=True)\n"
        "subprocess.run = run\n"
    )
    shown = "\nprint([c[1:3] for c in calls], calls[0][4], os.getcwd(), sys.path[0])"
    command = [sys.executable, "-I", "-S", "-c", pretend + student.cells[0].source + shown]
    done = subprocess.run(command, check=True, cwd=tmp_path, capture_output=True, text=True).stdout
    folder = tmp_path.resolve() / "ditr_lite_repository"
    assert "[['clone', '--depth'], ['-m', 'pip']] https://github.com/someone/ditr_lite" in done
    assert done.split()[-2:] == [str(folder / "notebooks"), str(folder)]
    assert not students.was_worked_in(tmp_path / "out" / original.name)
