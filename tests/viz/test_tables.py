"""Tables as text: aligned, with the digits that were asked for."""

import numpy as np
import pytest

from ditr_lite.evaluation import results, uncertainty
from ditr_lite.studies import peer_tables, trials
from ditr_lite.viz.tables import WIDTH, table


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


def test_the_tables_of_studies_fit_beside_a_file_browser():
    calibration, peers = results.read("calibration"), results.read("peers")
    texts = [
        table(uncertainty.coverage_columns(calibration), 0),
        trials.format_trials(trials.trials()).split("\n\n")[0],
    ]
    for split in peers["splits"].values():
        makers = (peer_tables.format_peers, peer_tables.format_ablation, peer_tables.format_oracles)
        texts += [make(split) for make in makers]
    widths = {text.splitlines()[0]: max(map(len, text.splitlines())) for text in texts}
    assert {heading: width for heading, width in widths.items() if width > WIDTH} == {}
