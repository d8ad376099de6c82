"""notebooks/INSTRUCTOR.md: every part, message, command and minute that it names is there and adds up."""

import re
from pathlib import Path

import nbformat
import pytest
import student_copy

import tasks

ROOT = Path(__file__).resolve().parents[1]
GUIDE = (ROOT / "notebooks" / "INSTRUCTOR.md").read_text(encoding="utf-8")
NOTEBOOKS = {path.name[:2]: nbformat.read(path, as_version=4) for path in (ROOT / "notebooks").glob("*.ipynb")}
PARTS = sorted(set(re.findall(r'\b(\d\d): "([^"]+)"', GUIDE)))
MESSAGES = re.findall(r"\| ✗ (.+?) \|$", GUIDE, re.MULTILINE)


def headings(number):
    text = "\n".join(cell.source for cell in NOTEBOOKS[number].cells if cell.cell_type == "markdown")
    return re.findall(r"^#+ (.+)$", text, re.MULTILINE)


@pytest.mark.parametrize(("number", "part"), PARTS)
def test_a_part_that_is_named_is_there(number, part):
    assert any(part in heading for heading in headings(number)), f"{number} has {headings(number)}"


def test_the_messages_are_those_of_the_checkers():
    package = ROOT / "ditr_lite"
    checkers = "".join(p.read_text(encoding="utf-8") for p in package.rglob("*.py") if "check" in p.read_text("utf-8"))
    assert len(MESSAGES) >= 30 and [message for message in MESSAGES if message not in checkers] == []


@pytest.mark.parametrize(("plan", "minutes"), [("Plan A", 90), ("Plan B", 210)])
def test_the_minutes_of_a_plan_add_up(plan, minutes):
    table = GUIDE.split(f"## {plan}")[1].split("\n## ")[0]
    assert sum(map(int, re.findall(r"^\| (\d+) \|", table, re.MULTILINE))) == minutes


def test_the_two_days_have_six_hours_each():
    table = GUIDE.split("## Plan C")[1].split("\n## ")[0]
    for day in "12":
        assert sum(map(int, re.findall(rf"^\| {day}, (\d+) \|", table, re.MULTILINE))) == 360


def test_every_command_is_one():
    assert set(re.findall(r"`make ([\w-]+)", GUIDE)) <= set(tasks.COMMANDS)
    assert set(re.findall(r"tasks\.py ([\w-]+)", GUIDE)) <= set(tasks.COMMANDS)
    for tool in re.findall(r"tools/\w+\.py", GUIDE):
        assert (ROOT / tool).exists()


def test_what_nbgrader_is_told_are_our_marks():
    assert f'begin_solution_delimeter = "{student_copy.BEGIN}"' in GUIDE
    assert f'end_solution_delimeter = "{student_copy.END}"' in GUIDE


def test_the_guide_has_plans_boards_and_answers():
    assert len(re.findall(r"^## Plan", GUIDE, re.MULTILINE)) == 4 and GUIDE.count("**Board ") >= 5
    questions = re.findall(r"^\*\*\d+\. [^*]+\?\*\* \S", GUIDE, re.MULTILINE)
    assert len(questions) >= 8


@pytest.mark.parametrize("name", ["Dockerfile", "notebooks/INSTRUCTOR.md"])
def test_a_folder_that_a_container_writes_into_is_made_first(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    [folder] = re.findall(r'-v "\$PWD/(\w+):/\w+"', text)  # without :ro
    assert 0 < text.find(f"mkdir -p {folder}") < text.index("docker run --rm --network none")
