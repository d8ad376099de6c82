"""Run the notebooks that students handed in, and write what the checkers say into a CSV file.

    python tools/grade.py FOLDER [--csv FILE] [--timeout 60] [--limit 600] [--whole]

FOLDER holds student copies (``make students``) in any arrangement, for example ``ann/00_start_here.ipynb``. Which
notebook a file is stands in its metadata, or in its name. Only its set-up cell and its exercises are run, each file in
a fresh kernel; where a name is missing then, and with ``--whole``, all of it. The checkers are ours, whatever the file
holds in their place; each runs in a cell of its own.

Nothing of a submission runs in this repository or in FOLDER: each gets a temporary copy of the package and of the data
samples, which is thrown away, an own home folder, and no variable of your environment that it does not need. It still
runs as you: grade strangers' work in the container (see notebooks/INSTRUCTOR.md).

One line for each checker: file, notebook, exercise, checker, verdict, reason, points, own cells that raised, level. The
verdict is ``right``, ``wrong``, ``not attempted``, ``missing`` (no such function), ``stopped`` (time limit, dead
kernel), ``unreadable`` or ``unknown notebook``.
"""

import argparse
import ast
import csv
import dataclasses
import datetime
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import nbformat
import psutil
from nbclient import NotebookClient
from nbclient.exceptions import DeadKernelError
from student_copy import checker_calls, functions_in, student_copy

ROOT = Path(__file__).resolve().parents[1]
LEVEL = re.compile(r"^(?:#+ |\*\*)Level (\d)", re.MULTILINE)
EXERCISES = re.compile(r"^#+ .*\bexercises?\b", re.IGNORECASE | re.MULTILINE)
# What an interpreter needs of its surroundings; keys and tokens of the person who grades are none of it.
PASSED_ON = ("PATH", "LANG", "LC_ALL", "LC_CTYPE", "SYSTEMROOT", "SYSTEMDRIVE", "COMSPEC", "PATHEXT", "WINDIR")
NOT_ATTEMPTED = "not attempted yet"


@dataclasses.dataclass
class Task:
    """One checker: the exercise that it belongs to, its call, the name that it prints, and the exercise's level."""

    exercise: str
    functions: list[str]
    call: str
    checker: str
    level: int


@dataclasses.dataclass
class Row:
    """One line of the CSV file."""

    file: str
    notebook: str
    exercise: str
    checker: str
    verdict: str
    reason: str = ""
    points: int = 0
    cells_raised: int = 0
    level: int = 0


def tasks_of(original: nbformat.NotebookNode) -> list[Task]:
    """Return the checkers of a notebook of the collection; their names are those in its stored outputs.

    Raises:
        ValueError: when an exercise's stored output has not one line for each of its checkers.
    """
    printed = {}
    for cell in original.cells:
        if cell.cell_type == "code":
            text = "".join(out.get("text", "") for out in cell.outputs)
            printed[cell.id] = [line[2:].split(":")[0] for line in text.splitlines() if line[:1] in "✓✗"]
    tasks = []
    functions: list[str] = []
    level = 0
    for cell in student_copy(original).cells:
        if cell.cell_type == "markdown" and (found := LEVEL.search(cell.source)):
            level = int(found[1])
        mark = cell.metadata.get("nbgrader", {})
        if mark.get("solution"):
            functions, names = functions_in(cell.source), printed[cell.id]
        if not mark.get("grade"):
            continue
        calls = _calls(cell.source)
        if len(calls) != len(names):
            raise ValueError(f"exercise {functions[0]}: {len(calls)} checkers, but its stored output names {names}")
        tasks += [Task(functions[0], functions, *pair, level) for pair in zip(calls, names, strict=True)]
    return tasks


def _calls(source: str) -> list[str]:
    return [call for statement in ast.parse(source).body for call in checker_calls(statement)]


def notebook_of(submission: nbformat.NotebookNode, path: Path, known: list[str]) -> str | None:
    """Return which notebook of the collection a submission is, by its metadata or else by its name; None if neither."""
    recorded = submission.metadata.get("ditr_lite", {}).get("notebook")
    if recorded in known:
        return recorded
    return next((name for name in known if name in path.stem), None)


def with_our_checkers(
    submission: nbformat.NotebookNode, tasks: list[Task], whole: bool
) -> tuple[nbformat.NotebookNode, list[Task]]:
    """Return the notebook to run, and the tasks for which the submission has no function.

    Each checker stands behind the last cell that defines one of its exercise's functions, and is marked by its number
    in ``metadata["task"]``.
    """
    code, started = [], whole
    for cell in submission.cells:
        started = started or (cell.cell_type == "markdown" and bool(EXERCISES.search(cell.source)))
        is_setup = cell.cell_type == "code" and not code
        if cell.cell_type == "code" and (started or is_setup) and not cell.metadata.get("nbgrader", {}).get("grade"):
            tags = {"tags": cell.metadata.get("tags", [])}
            code.append(nbformat.v4.new_code_cell(cell.source, metadata=tags))
    missing = []
    behind: dict[int, list[nbformat.NotebookNode]] = {}
    for number, task in enumerate(tasks):
        places = [k for k, cell in enumerate(code) if set(task.functions) & set(functions_in(cell.source))]
        if not places:
            missing.append(task)
            continue
        checker = nbformat.v4.new_code_cell(f"_ = {task.call}", metadata={"task": number})
        behind.setdefault(places[-1], []).append(checker)
    cells = [c for k, cell in enumerate(code) for c in (cell, *behind.get(k, []))]
    return nbformat.v4.new_notebook(cells=cells), missing


def run(path: Path, timeout: float) -> None:
    """Execute a notebook file in a fresh kernel in the present folder, and save it after every cell.

    Args:
        path: the notebook; what its cells raise is recorded in it, and the next cell runs.
        timeout: seconds after which a cell is interrupted.
    """
    notebook = nbformat.read(path, as_version=4)
    began = [0.0]

    def start(cell, cell_index):
        began[0] = time.monotonic()

    def save(cell, cell_index, **_):
        cell.metadata["seconds"] = time.monotonic() - began[0]
        part = path.with_suffix(".part")
        nbformat.write(notebook, part)
        os.replace(part, path)

    client = NotebookClient(
        notebook,
        timeout=timeout,
        interrupt_on_timeout=True,
        allow_errors=True,
        kernel_name="python3",
        resources={"metadata": {"path": str(Path.cwd())}},
        on_cell_start=start,
        on_cell_executed=save,
    )
    try:
        client.execute()
    except DeadKernelError:
        print("the kernel died", file=sys.stderr)


def run_apart(notebook: nbformat.NotebookNode, timeout: float, limit: float) -> nbformat.NotebookNode:
    """Execute a notebook in a temporary copy of the repository, in a process that ends after ``limit`` seconds."""
    temporary = tempfile.TemporaryDirectory
    # Two folders: a submission may delete all that is around it, and its results are still there to be read.
    with temporary(ignore_cleanup_errors=True) as copy, temporary(ignore_cleanup_errors=True) as results:
        for part in ("ditr_lite", "data_samples", "tools/cluster"):  # notebook 10 reads the files of the last
            shutil.copytree(ROOT / part, Path(copy, part), ignore=shutil.ignore_patterns("__pycache__"))
        for part in ("notebooks", "home", "tmp"):
            Path(copy, part).mkdir()
        path = Path(results, "submission.ipynb")
        nbformat.write(notebook, path)
        command = [sys.executable, str(Path(__file__).resolve()), "--run", str(path), "--timeout", str(timeout)]
        silent = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        worker = subprocess.Popen(command, cwd=Path(copy, "notebooks"), env=surroundings(Path(copy)), **silent)
        try:
            worker.wait(limit)
        except subprocess.TimeoutExpired:
            print("the time for the notebook is up", file=sys.stderr)
        finally:
            end(worker)
        return nbformat.read(path, as_version=4)


def surroundings(copy: Path) -> dict[str, str]:
    """Return the environment variables of a submission: little of ours, and every folder inside the copy."""
    environment = {name: os.environ[name] for name in PASSED_ON if name in os.environ}
    environment |= {"PYTHONPATH": str(copy), "HOME": str(copy / "home"), "USERPROFILE": str(copy / "home")}
    environment |= {"TMPDIR": str(copy / "tmp"), "TEMP": str(copy / "tmp"), "TMP": str(copy / "tmp")}
    return environment | {"OMP_NUM_THREADS": "2", "TQDM_DISABLE": "1", "PYTHONUTF8": "1"}


def end(worker: subprocess.Popen) -> None:
    """End a process and all that it started."""
    try:
        family = [*psutil.Process(worker.pid).children(recursive=True), psutil.Process(worker.pid)]
    except psutil.NoSuchProcess:
        family = []
    for process in family:
        try:
            process.kill()
        except psutil.NoSuchProcess:
            continue
    worker.wait()


def verdict(cell: nbformat.NotebookNode | None, name: str, timeout: float) -> tuple[str, str]:
    """Return verdict and reason of one executed checker cell; ``None`` is a cell that is not there any more.

    The checker prints last, so the last line with its name counts: what the submission itself printed comes before.
    """
    if cell is None or "seconds" not in cell.metadata:
        return "stopped", "never run: the kernel died or the time for the notebook was up"
    text = "".join(out.get("text", "") for out in cell.outputs if out.output_type == "stream")
    lines = [line for line in text.splitlines() if line == f"✓ {name}" or line.startswith(f"✗ {name}: ")]
    if not lines:
        raised = [f"{out.ename}: {out.evalue}" for out in cell.outputs if out.output_type == "error"]
        if cell.metadata.seconds >= timeout:
            return "stopped", f"no answer within {timeout:g} seconds: an endless loop?"
        return "stopped", (raised or ["the checker printed nothing"])[0]
    if lines[-1].startswith("✓"):
        return "right", ""
    reason = lines[-1].split(": ", 1)[1]
    return ("not attempted" if reason == NOT_ATTEMPTED else "wrong"), reason


def grade(path: Path, folder: Path, tasks: dict[str, list[Task]], options: argparse.Namespace) -> list[Row]:
    """Run one submission and return a row for each checker.

    Args:
        path: of the submission.
        folder: that it was handed in with.
        tasks: notebook of the collection -> its checkers.
        options: of the command line.
    """
    file = os.fsencode(path.relative_to(folder).as_posix()).decode("utf-8", "replace")  # names may be of any encoding
    try:
        submission = nbformat.read(path, as_version=4)
        nbformat.validate(submission)
        name = notebook_of(submission, path, list(tasks))
        if name is None:
            return [Row(file, "", "", "", "unknown notebook", "neither its metadata nor its name says which one it is")]
        whole = options.whole or answers_above(submission, tasks[name])
        rows = _run_and_read(file, name, submission, tasks[name], options, whole)
        if not whole and any("NameError" in row.reason for row in rows):
            rows = _run_and_read(file, name, submission, tasks[name], options, True)
    except Exception as error:  # whatever was handed in, the others are graded
        return [Row(file, "", "", "", "unreadable", f"{type(error).__name__}: {error}".splitlines()[0])]
    return rows


def answers_above(submission: nbformat.NotebookNode, tasks: list[Task]) -> bool:
    """Return whether an answer stands above the heading of the exercises, or there is no such heading."""
    missing = {whole: with_our_checkers(submission, tasks, whole)[1] for whole in (False, True)}
    return len(missing[True]) < len(missing[False])


def _run_and_read(file, name, submission, tasks, options, whole) -> list[Row]:
    prepared, missing = with_our_checkers(submission, tasks, whole)
    done = run_apart(prepared, options.timeout, options.limit)
    cells = {cell.metadata["task"]: cell for cell in done.cells if "task" in cell.metadata}
    ours = {cell.source for cell in nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4).cells}
    raised = sum(
        any(out.output_type == "error" for out in cell.outputs)
        for cell in done.cells
        if "task" not in cell.metadata
        and "raises-exception" not in cell.metadata.get("tags", [])
        and cell.source not in ours  # such as an appendix, whose set-up was not run
    )
    rows = []
    for number, task in enumerate(tasks):
        if task in missing:
            said, reason = why_missing(submission, task)
        else:
            said, reason = verdict(cells.get(number), task.checker, options.timeout)
        points = int(said == "right")
        rows.append(Row(file, name, task.exercise, task.checker, said, reason, points, raised, task.level))
    return rows


def why_missing(submission: nbformat.NotebookNode, task: Task) -> tuple[str, str]:
    """Return verdict and reason of a task of which no function was found."""
    names = "|".join(map(re.escape, task.functions))
    if any(re.search(rf"^def ({names})\b", cell.source, re.MULTILINE) for cell in submission.cells):
        return "stopped", "SyntaxError: the cell that defines it is not Python"
    return "missing", f"no function called {' or '.join(task.functions)}"


def write_csv(rows: list[Row], path: Path) -> None:
    """Write the rows as a CSV file that spreadsheets open as text: UTF-8 with its mark, and no formulas."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    with part.open("w", newline="", encoding="utf-8-sig") as stream:
        writer = csv.writer(stream)
        writer.writerow(field.name for field in dataclasses.fields(Row))
        for row in rows:
            values = dataclasses.astuple(row)
            writer.writerow("'" + v if isinstance(v, str) and v[:1] in tuple("=+-@") else v for v in values)
    os.replace(part, path)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, help="where the submitted notebooks are, in any arrangement")
    parser.add_argument("--csv", type=Path, help="default: outputs/grades_<date and time>.csv")
    parser.add_argument("--timeout", type=float, default=60, help="seconds for one cell; default: 60")
    parser.add_argument("--limit", type=float, default=600, help="seconds for one notebook; default: 600")
    parser.add_argument("--whole", action="store_true", help="run all cells, not only set-up and exercises")
    parser.add_argument("--run", type=Path, help=argparse.SUPPRESS)  # the worker's side of run_apart
    options = parser.parse_args(arguments)
    if options.run:
        run(options.run, options.timeout)
        return 0
    now = datetime.datetime.now().strftime("%Y-%m-%d_%H%M%S")
    target = options.csv or ROOT / "outputs" / f"grades_{now}.csv"
    if options.folder is None or not options.folder.is_dir():
        print(
            f"grade: a folder of submitted notebooks is wanted (make grade FOLDER=...), got {options.folder}",
            file=sys.stderr,
        )
        return 2
    if target.exists():
        print(f"grade: {target} is there already; name another file with --csv", file=sys.stderr)
        return 2
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        print(f"grade: {target.parent} is no folder to write into: {error.strerror}", file=sys.stderr)
        return 2
    paths = sorted(p for p in options.folder.rglob("*.ipynb") if ".ipynb_checkpoints" not in p.parts)
    if not paths:
        print(f"grade: no notebook (*.ipynb) in {options.folder}", file=sys.stderr)
        return 2
    originals = sorted((ROOT / "notebooks").glob("*.ipynb"))
    try:
        tasks = {path.stem: tasks_of(nbformat.read(path, as_version=4)) for path in originals}
    except ValueError as error:
        print(f"grade: {error}; the notebooks are needed with their outputs", file=sys.stderr)
        return 2
    rows: list[Row] = []
    try:
        for path in paths:
            graded = grade(path, options.folder, tasks, options)
            rows += graded
            write_csv(rows, target)  # each time: an interruption loses one submission
            print(f"{graded[0].file}: {sum(row.points for row in graded)} of {len(graded)}", flush=True)
    except KeyboardInterrupt:
        print(f"grade: interrupted; what was graded is in {target}" if rows else "grade: interrupted", file=sys.stderr)
        return 130
    print(f"{len(rows)} lines in {target}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
