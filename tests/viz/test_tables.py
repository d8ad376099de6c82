"""Tables as text: aligned, with the digits that were asked for."""

import numpy as np
import pytest

from ditr_lite.viz.tables import table


def test_numbers_stand_right_and_text_left():
    text = table({"name": ["a", "long"], "mm": [1.25, 10], "n": [1, 12_000], "x": [None, np.float32(0.5)]})
    assert text.splitlines() == ["name   mm       n    x", "a     1.2       1    -", "long   10  12,000  0.5"]


def test_digits_are_set_for_all_columns_or_for_one():
    columns = {"a": [0.123], "b": [0.123]}
    assert table(columns, 2).splitlines()[1].split() == ["0.12", "0.12"]
    assert table(columns, {"b": 3}).splitlines()[1].split() == ["0.1", "0.123"]


def test_a_whole_number_stored_as_a_float_keeps_its_digits():
    assert table({"a": [2.0]}, 2).splitlines()[1] == "2.00"


@pytest.mark.parametrize("columns", [{}, {"a": [1], "b": [1, 2]}])
def test_columns_that_do_not_fit_are_refused(columns):
    with pytest.raises(ValueError, match="all of the same length"):
        table(columns)
