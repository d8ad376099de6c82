"""Every part of the paper has an entry, every done entry its three links, and the page is the current one."""

from dataclasses import replace
from pathlib import Path

import paper_map
import pytest
from test_notebooks import READING_ORDER

from ditr_lite.studies.peer_tables import IDEAS

ROOT = Path(__file__).resolve().parents[1]
ENTRIES = paper_map.entries()
# What the paper has, counted in the paper and not taken from the map; N counts what we add to it.
COUNTS = {"Eq. ": 9, "I": 4, "S": 9, "T": 6, "A": 2, "F": 13, "C": 11, "N": 3}
REQUIRED = [f"{kind}{n}" for kind, count in COUNTS.items() for n in range(1, count + 1)]
GOOD = next(entry for entry in ENTRIES if entry.id == "Eq. 7")


def test_no_part_of_the_paper_is_missing_or_twice():
    assert [entry.id for entry in ENTRIES] == REQUIRED


def test_every_entry_is_what_it_says():
    assert [problem for entry in ENTRIES for problem in paper_map.problems(entry, ROOT)] == []
    for entry in ENTRIES:
        assert entry.paper and (entry.notebook in READING_ORDER or entry.status == "left out"), entry.id


def test_the_stand_in_of_a_compared_system_is_the_one_that_the_tables_score():
    systems = {name for says in IDEAS.values() for name in says.rstrip(")").rpartition("(")[2].split(", ")}
    compared = [entry for entry in ENTRIES if entry.id.startswith("C")]
    assert {entry.paper.split(";")[0] for entry in compared} == systems
    assert {entry.notebook for entry in compared} == {"08_ablations"}  # where they are presented


def test_the_page_is_the_current_one():
    text = (ROOT / "PAPER_MAP.md").read_text(encoding="utf-8")
    assert text == paper_map.page(ENTRIES), "run python tools/paper_map.py"
    assert all(f"\n| {entry.id} |" in text for entry in ENTRIES)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"function": "diffusion.q_simple"}, "no function diffusion.q_simple"),
        ({"function": "difusion.q_sample"}, "no function difusion.q_sample"),
        ({"function": "diffusion"}, "no function diffusion"),
        ({"function": "loss_types.WRONG_ABS_M"}, "no function loss_types.WRONG_ABS_M"),  # a number
        ({"function": "-"}, "no function -"),
        ({"test": "test_diffusion.py::test_eq7"}, "no test test_diffusion.py::test_eq7"),
        ({"test": "test_difusion.py::test_eps_loss_is_eq8"}, "no test"),
        ({"test": "test_diffusion.py::generator"}, "no test"),  # a helper
        ({"test": "-"}, "no test -"),
        ({"anchor": "Eq. 7 as printed"}, "no cell 04_ddpm_math: Eq. 7 as printed"),
        ({"anchor": "-"}, "no cell"),
        ({"notebook": "04_ddpm"}, "no cell 04_ddpm"),
    ],
)
def test_a_dead_link_is_named_unless_left_out(change, message):
    assert paper_map.problems(GOOD, ROOT) == []
    (problem,) = paper_map.problems(replace(GOOD, **change), ROOT)
    assert problem.startswith("Eq. 7 is done, but there is ") and message in problem
    assert paper_map.problems(replace(GOOD, **change, status="left out"), ROOT) == []


def test_a_cell_id_and_an_assigned_test_are_found_too():
    assert paper_map.problems(replace(GOOD, anchor="cell-012"), ROOT) == []
    assert paper_map.has_test(ROOT / "tests", "exercises/test_start.py::test_a_planted_mistake_is_named")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [(" | done |", " | finished |", "expected status"), ("metrics.rmse | ", "metrics.rmse ", "expected three lines")],
)
def test_a_malformed_entry_is_refused(old, new, message):
    text = paper_map.ENTRIES
    assert old in text
    with pytest.raises(ValueError, match=message):
        paper_map.read(text.replace(old, new, 1))
