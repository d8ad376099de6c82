"""What people bring: every case of the table gives what it should; see ``input_cases.py``."""

import input_cases
import pytest

CASES = input_cases.table()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_an_input_gives_what_it_should(case, tmp_path):
    case.run(tmp_path)


def test_the_table_is_large_and_its_names_are_unique():
    assert len(CASES) >= 150 and len({case.name for case in CASES}) == len(CASES)
