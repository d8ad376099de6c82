"""tools/grade.py: planted submissions get the verdicts that they deserve, and cannot touch what is not theirs."""

import csv
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import grade
import nbformat
import pytest
import student_copy
from nbformat.v4 import new_code_cell, new_notebook, new_output

ROOT = Path(__file__).resolve().parents[1]
NAME = "00_start_here"
ORIGINAL = nbformat.read(ROOT / "notebooks" / f"{NAME}.ipynb", as_version=4)
RIGHT = {
    cell.metadata.nbgrader.grade_id: cell.source
    for cell in student_copy.student_copy(ORIGINAL, NAME, solved=True).cells
    if cell.metadata.get("nbgrader", {}).get("solution")
}
WRONG = RIGHT | {"rmse": "def rmse(pred, gt):\n    return ((pred - gt)[gt > 0] ** 2).mean()"}
ENDLESS = RIGHT | {"unproject": "def unproject(u, v, z, camera):\n    while True:\n        pass"}
DELETES = RIGHT | {
    "rmse": """import shutil
from pathlib import Path
import ditr_lite

def rmse(pred, gt):
    for folder in (Path.cwd().parent, Path(ditr_lite.__file__).parents[1], Path.home(), Path(gettempdir())):
        shutil.rmtree(folder, ignore_errors=True)
    return 0.0

from tempfile import gettempdir
"""
}


def submission(answers, name=NAME):
    """Return a student copy with these answers; its set-up cell imports only what the exercises need, to be quick."""
    student = student_copy.student_copy(ORIGINAL, name)
    setup = next(cell for cell in student.cells if cell.cell_type == "code")
    lines = [line for line in setup.source.splitlines() if re.match(r"import numpy|from ditr_lite\.exercises", line)]
    setup.source = "\n".join(lines)
    for cell in student.cells:
        cell.source = answers.get(cell.metadata.get("nbgrader", {}).get("grade_id"), cell.source)
    return student


def hand_in(folder, **submissions):
    for student, notebook in submissions.items():
        (folder / student).mkdir(parents=True)
        nbformat.write(notebook, folder / student / f"{NAME}.ipynb")


def graded(folder, tmp_path, *arguments):
    target = tmp_path / "grades.csv"
    assert grade.main([str(folder), "--csv", str(target), *arguments]) == 0
    with target.open(encoding="utf-8-sig", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return {(row["file"].split("/")[0], row["exercise"]): row for row in rows}


def state_of(*folders):
    return {p: p.stat().st_mtime_ns for f in folders for p in (ROOT / f).rglob("*") if "__pycache__" not in p.parts}


def test_planted_submissions(tmp_path, capsys):
    folder = tmp_path / "submitted"
    hand_in(
        folder,
        right=submission(RIGHT),
        wrong=submission(WRONG),
        empty=submission({}),
        endless=submission(ENDLESS),
        files=submission(DELETES),
        last=submission(RIGHT),
    )
    before = state_of("ditr_lite", "data_samples", "notebooks", "tools")
    handed_in = {p: p.read_bytes() for p in folder.rglob("*.ipynb")}
    rows = graded(folder, tmp_path, "--timeout", "30")
    assert state_of("ditr_lite", "data_samples", "notebooks", "tools") == before
    assert {p: p.read_bytes() for p in folder.rglob("*.ipynb")} == handed_in

    verdicts = {student: [rows[student, e]["verdict"] for e in RIGHT] for student in ("right", "last", "empty")}
    assert verdicts["right"] == verdicts["last"] == ["right"] * 4 and verdicts["empty"] == ["not attempted"] * 4
    assert rows["wrong", "rmse"]["verdict"] == "wrong"
    assert rows["wrong", "rmse"]["reason"] == "the square root is missing"
    assert rows["endless", "unproject"]["verdict"] == "stopped" and "endless" in rows["endless", "unproject"]["reason"]
    assert rows["endless", "shadow_width"]["verdict"] == "right"
    assert rows["files", "rmse"]["points"] == "0" and rows["files", "disparity_to_depth"]["verdict"] == "right"
    printed = capsys.readouterr().out
    assert f"right/{NAME}.ipynb: 4 of 4" in printed and f"wrong/{NAME}.ipynb: 3 of 4" in printed


def test_what_is_no_submission_gets_a_line_too(tmp_path):
    folder = tmp_path / "submitted"
    hand_in(folder, damaged=new_notebook(), strange=new_notebook(cells=[new_code_cell("1 / 0")]))
    (folder / "damaged" / f"{NAME}.ipynb").write_text('{"cells": ')
    (folder / "strange" / f"{NAME}.ipynb").rename(folder / "strange" / "essay.ipynb")
    (folder / "damaged" / ".ipynb_checkpoints").mkdir()
    (folder / "damaged" / ".ipynb_checkpoints" / "x.ipynb").write_text("")
    rows = graded(folder, tmp_path)
    assert {key[0]: row["verdict"] for key, row in rows.items()} == {
        "damaged": "unreadable",
        "strange": "unknown notebook",
    }


def test_a_function_that_is_not_there_and_one_in_a_cell_of_the_student(tmp_path):
    notebook = submission({})
    kept = [cell for cell in notebook.cells if cell.metadata.get("nbgrader", {}).get("grade_id") != "rmse"]
    kept.append(new_code_cell(RIGHT["unproject"]))
    notebook.cells = kept
    tasks = grade.tasks_of(ORIGINAL)
    prepared, missing = grade.with_our_checkers(notebook, tasks, whole=False)
    assert [task.exercise for task in missing] == ["rmse"]
    sources = [cell.source for cell in prepared.cells]
    assert sources.index("_ = checks.check_unproject(unproject)") == sources.index(RIGHT["unproject"]) + 1
    assert {task.level for task in tasks} == {1, 2, 3}
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        levels = {task.level for task in grade.tasks_of(nbformat.read(path, as_version=4))}
        assert set() < levels <= {1, 2, 3}, path.name
    whole, _ = grade.with_our_checkers(notebook, tasks, whole=True)
    assert len(prepared.cells) < len(whole.cells)


def test_an_interruption_keeps_what_was_graded_and_a_place_that_is_none_is_refused_first(tmp_path, monkeypatch, capsys):
    hand_in(tmp_path / "submitted", a=new_notebook(), b=new_notebook())
    asked = []

    def one(path, *_):
        asked.append(path)
        if len(asked) > 1:
            raise KeyboardInterrupt
        return [grade.Row("a", NAME, "f", "f", "right", "", 1)]

    monkeypatch.setattr(grade, "grade", one)
    assert grade.main([str(tmp_path / "submitted"), "--csv", str(tmp_path / "g.csv")]) == 130
    assert "interrupted; what was graded is in" in capsys.readouterr().err
    assert len((tmp_path / "g.csv").read_text(encoding="utf-8-sig").splitlines()) == 2
    asked.clear()
    assert grade.main([str(tmp_path / "submitted"), "--csv", str(tmp_path / "g.csv" / "h.csv")]) == 2
    assert "is no folder to write into" in capsys.readouterr().err and not asked


def test_answers_above_the_heading_or_beside_magics_are_found():
    tasks = grade.tasks_of(ORIGINAL)
    notebook = submission({k: f"%%time\n{v}" if k == "rmse" else v for k, v in RIGHT.items()})
    assert not grade.with_our_checkers(notebook, tasks, whole=False)[1]
    notebook.cells = [cell for cell in notebook.cells if not grade.EXERCISES.search(cell.source)]
    assert len(grade.with_our_checkers(notebook, tasks, whole=False)[1]) == len(tasks)
    assert grade.answers_above(notebook, tasks) and not grade.answers_above(submission(RIGHT), tasks)
    for source in (
        "!pip list\ndef f(x):\n    return x",
        "f = lambda x: x",
        "%timeit 1\nnp.sum?\ndef f(x):\n    return x",
    ):
        assert student_copy.functions_in(source) == ["f"]


def test_a_cell_that_is_not_python_is_told_from_one_that_is_missing():
    task = grade.tasks_of(ORIGINAL)[0]
    broken = new_notebook(cells=[new_code_cell(f"def {task.functions[0]}(x:\n    return x")])
    assert grade.why_missing(broken, task) == ("stopped", "SyntaxError: the cell that defines it is not Python")
    assert grade.why_missing(new_notebook(), task)[0] == "missing"


@pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes")
def test_odd_names_and_odd_metadata_stop_nobody(tmp_path):
    folder = tmp_path / "submitted"
    hand_in(folder, a=new_notebook(metadata={"ditr_lite": "x"}))
    (folder / "a").rename(folder / os.fsdecode(b"M\xfcller"))
    (row,) = graded(folder, tmp_path).values()
    assert row["file"] == f"M\N{REPLACEMENT CHARACTER}ller/{NAME}.ipynb" and row["verdict"] == "unreadable"


def test_a_name_from_above_the_exercises_is_found_by_running_all(monkeypatch):
    runs = []

    def run_apart(notebook, timeout, limit):
        runs.append(len(notebook.cells))
        for cell in notebook.cells:
            if "task" in cell.metadata:
                cell.metadata["seconds"] = 0.1
                cell.outputs = [
                    new_output("stream", text="✗ RMSE: stopped with NameError: name 'mine' is not defined\n")
                ]
        return notebook

    monkeypatch.setattr(grade, "run_apart", run_apart)
    options = grade.argparse.Namespace(whole=False, timeout=1, limit=1)
    path = ROOT / "notebooks" / f"{NAME}.ipynb"
    rows = grade.grade(path, path.parent, {NAME: grade.tasks_of(ORIGINAL)}, options)
    assert len(runs) == 2 and runs[0] < runs[1] and rows[1].verdict == "wrong"


@pytest.mark.parametrize(
    ("printed", "seconds", "said"),
    [
        ("✓ RMSE\n", 1, ("right", "")),
        ("✓ RMSE\n✗ RMSE: too large\n", 1, ("wrong", "too large")),  # the submission's own line comes first
        ("✓ RMSE or so\n", 1, ("stopped", "the checker printed nothing")),
        ("✗ RMSE: not attempted yet\n", 1, ("not attempted", "not attempted yet")),
        ("", 60, ("stopped", "no answer within 60 seconds: an endless loop?")),
        ("", None, ("stopped", "never run: the kernel died or the time for the notebook was up")),
    ],
)
def test_the_last_line_of_the_checker_counts(printed, seconds, said):
    cell = new_code_cell("", outputs=[new_output("stream", text=printed)])
    if seconds is not None:
        cell.metadata["seconds"] = seconds
    assert grade.verdict(cell, "RMSE", 60) == said


def test_a_spreadsheet_gets_no_formulas(tmp_path):
    grade.write_csv([grade.Row("=1+1.ipynb", "", "", "", "unreadable", "Zoë")], tmp_path / "g.csv")
    content = (tmp_path / "g.csv").read_bytes()
    assert content.startswith(b"\xef\xbb\xbf") and b"'=1+1.ipynb" in content and "Zoë".encode() in content


def test_nothing_is_overwritten_and_nothing_is_run_without_a_folder(tmp_path, capsys):
    (tmp_path / "old.csv").write_text("mine")
    assert grade.main([str(tmp_path), "--csv", str(tmp_path / "old.csv")]) == 2
    assert "there already" in capsys.readouterr().err and (tmp_path / "old.csv").read_text() == "mine"
    assert grade.main([str(tmp_path / "nowhere")]) == 2 and "a folder" in capsys.readouterr().err
    assert grade.main([str(tmp_path)]) == 2 and "no notebook" in capsys.readouterr().err


def test_a_submission_sees_no_variable_that_it_does_not_need(monkeypatch, tmp_path):
    monkeypatch.setenv("MY_TOKEN", "secret")
    seen = grade.surroundings(tmp_path)
    assert "MY_TOKEN" not in seen and seen["HOME"].startswith(str(tmp_path))


def test_a_worker_is_ended_with_all_that_it_started():
    code = "import subprocess, sys; subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']).wait()"
    worker = subprocess.Popen([sys.executable, "-c", code])
    family = grade.psutil.Process(worker.pid)
    while not family.children():
        assert worker.poll() is None
    [child] = family.children()
    grade.end(worker)
    assert worker.poll() is not None
    deadline = time.monotonic() + 10  # a killed process is there until the system has taken note
    while child.is_running() and child.status() != "zombie":
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda p: p.stem)
def test_every_checker_of_the_collection_is_known_by_name(path):
    tasks = grade.tasks_of(nbformat.read(path, as_version=4))
    assert len(tasks) >= 4 and len({task.checker for task in tasks}) == len(tasks)


def test_what_notebook_10_reads_lies_beside_the_copy_of_the_package():
    source = """import ditr_lite as dl
cluster = dl.data.SAMPLES.parent / "tools" / "cluster"
print(*sorted(path.suffix for path in cluster.iterdir()))"""
    done = grade.run_apart(new_notebook(cells=[new_code_cell(source)]), timeout=120, limit=240)
    assert [out.get("text") for out in done.cells[0].outputs] == [".sbatch .yaml\n"]
