"""tools/timings.py: a notebook is measured without being changed, and the tables are those of the stored figures."""

import json
from pathlib import Path

import nbformat
import pytest
import timings
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

ROOT = Path(__file__).resolve().parents[1]
ROW = {"seconds": 12.3, "peak_memory_mb": 1234, "slowest_part": "2 · Wait", "slowest_part_seconds": 9.6}
STORED = {"machine": {"processor": "a chip", "python": "Python 3.12"}, "notebooks": {"01_b": ROW, "00_a": ROW}}
PAGE = f"before\n{timings.BEGIN}\nold\n{timings.END}\nafter\n"


def test_a_notebook_is_measured(tmp_path):
    cells = [
        new_markdown_cell("# Title\n## 1 · Quick"),
        new_code_cell("x = 1"),
        new_markdown_cell("## 2 · Slow and large"),
        new_code_cell("import time\ndata = bytearray(300_000_000)\ntime.sleep(1)"),
    ]
    path = tmp_path / "n.ipynb"
    nbformat.write(new_notebook(cells=cells), path)
    before = path.read_bytes()
    row = timings.measure(path)
    assert path.read_bytes() == before
    assert 1 <= row["seconds"] < 60 and row["slowest_part"] == "2 · Slow and large"
    assert 300 <= row["peak_memory_mb"] < 1000


def test_the_table_stands_between_the_marks():
    page = timings.with_table(PAGE, STORED)
    assert page.startswith("before\n") and page.endswith("after\n") and "old" not in page
    assert page.index("| 00_a | 12 | 1,234 MB | 2 · Wait, 10 s |") < page.index("| 01_b |")
    assert "on 2 cores of a chip, Python 3.12" in page and timings.with_table(page, STORED) == page


@pytest.mark.parametrize("page", ["", PAGE + PAGE, PAGE.replace(timings.END, "")])
def test_a_page_without_the_marks_is_refused(page):
    with pytest.raises(ValueError, match="once each"):
        timings.with_table(page, STORED)


def test_outdated_tables_are_found_and_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(timings, "ROOT", tmp_path)
    (tmp_path / "notebooks").mkdir()
    for name in timings.PAGES:
        (tmp_path / name).write_text(PAGE, encoding="utf-8")
    (tmp_path / "notebooks" / "timings.json").write_text(json.dumps(STORED), encoding="utf-8")
    assert timings.main(["--check"]) == 1 and "README.md, notebooks/INSTRUCTOR.md" in capsys.readouterr().err
    assert timings.main(["--tables"]) == 0 and timings.main(["--check"]) == 0


def test_the_tables_are_up_to_date():
    assert timings.main(["--check"]) == 0


def test_what_is_stored_are_notebooks_of_the_collection():
    stored = ROOT / "notebooks" / "timings.json"
    rows = json.loads(stored.read_text(encoding="utf-8"))["notebooks"] if stored.exists() else {}
    assert set(rows) <= {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")}
    for row in rows.values():
        assert 0 < row["slowest_part_seconds"] <= row["seconds"] and row["peak_memory_mb"] > 50


def test_before_the_first_measurement_the_table_says_so():
    assert "make timings" in timings.with_table(PAGE, {"notebooks": {}})


def test_a_busy_machine_is_warned_of(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(timings, "ROOT", tmp_path)
    monkeypatch.setattr(timings, "_on_two_cores", lambda: None)
    monkeypatch.setattr(timings, "measure", lambda path: ROW)
    (tmp_path / "notebooks").mkdir()
    for name in timings.PAGES:
        (tmp_path / name).write_text(PAGE, encoding="utf-8")
    for busy in (90, 3):
        monkeypatch.setattr(timings.psutil, "cpu_percent", lambda interval, busy=busy: busy)
        assert timings.main(["00_a.ipynb"]) == 0
        assert ("busy (90 %)" in capsys.readouterr().err) == (busy == 90)
    assert "| 00_a | 12 |" in (tmp_path / "README.md").read_text(encoding="utf-8")
    monkeypatch.setattr(timings, "_processor", lambda: "another chip")
    with pytest.raises(SystemExit):  # one row of another machine would stand under its name with all others
        timings.main(["00_a.ipynb"])
    assert "the other times are of" in capsys.readouterr().err and timings.main([]) == 0
