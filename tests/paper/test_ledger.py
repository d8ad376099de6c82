"""The ledger: twenty entries, each with a computation and an honest verdict; each says what it should."""

import re

import pytest
from test_notebooks import READING_ORDER

from ditr_lite.paper import ledger

FIGURES = {  # what must stand in the sentence, whatever the weights
    ledger.noise_scale: "1.00 and 1.00",
    ledger.signal_left: "% at T/2",
    ledger.intersection: "True; two lines one pixel apart share 0 pixels exactly, 32 of 32",
    ledger.unknown_pixels: "10 mm over known pixels",
    ledger.bands: "3 rows of T3 under the wording (ClearGrasp, DenseDepth, DepthGrasp), in 0 under",
    ledger.impossible: "DenseDepth in T1, DepthGrasp, SwinDRNet in T2, 18 of 18 entries of T5; read as RMSE, REL",
    ledger.optical_weight: "59 to 88 % of the weight on optical pixels (52 to 100 % with rounding)",
    ledger.dataset_sizes: "27,000; TODD's 57,715 is the count of TransCG",
    ledger.learning_rates: "3.0e-04 to 1.5e-03",
    ledger.operations: "1.1 ms and 0.1 G a call",
    ledger.inputs: "boundaries from ",
    ledger.base_rate: "6.4e-05",
    ledger.in_region_evidence: "keep_and_fill_debiased",
    ledger.latent_target: "mm off",
    ledger.attention: "another image",
    ledger.refinement: "at 256 × 192",
    ledger.gradients: "False; a nudge of 1e-4 changes 0 of 64",
    ledger.held_out: "8 glass and metal shapes, of which 1 in training, rooms included (round_mirror)",
    ledger.surpassed: "T2 d125 (TranspareNet), T3 rel (SwinDRNet), T3 d110 (SwinDRNet), T3 d125 (SwinDRNet)",
    ledger.posterior_mean: "times the RMSE",
}


def test_there_are_twenty_entries_each_with_its_own_computation():
    assert [e.number for e in ledger.ENTRIES] == list(range(1, 21))
    assert len({e.measured for e in ledger.ENTRIES}) == 20
    assert all(e.measured.__module__ == ledger.__name__ for e in ledger.ENTRIES)


def test_every_entry_says_where_what_and_how_it_ends():
    for e in ledger.ENTRIES:
        assert all((e.where, e.says, e.ours)) and e.holds in ledger.VERDICTS
        assert e.notebook in READING_ORDER
    assert {e.holds for e in ledger.ENTRIES} == set(ledger.VERDICTS)  # no verdict is idle


def test_the_table_is_markdown_and_computed():
    lines = ledger.format_ledger().splitlines()
    assert len(lines) == 22 and {line.replace("\\|", "").count("|") for line in lines} == {8}
    assert all(e.measured().replace("|", "\\|") in line for e, line in zip(ledger.ENTRIES, lines[2:], strict=True))
    few = ledger.format_ledger(ledger.ENTRIES[4:6]).splitlines()
    assert [line.split(" | ")[0] for line in few[2:]] == ["| 5", "| 6"]


@pytest.mark.parametrize("finding", FIGURES, ids=lambda f: f.__name__)
def test_the_sentence_holds_what_was_found(finding):
    sentence = finding()
    assert FIGURES[finding] in sentence and len(sentence) < 260, sentence
    assert finding() == sentence  # the same seed, the same figures


def test_every_finding_is_tested():
    made = {f for f in vars(ledger).values() if getattr(f, "__module__", "") == ledger.__name__}
    other = {ledger.committed, ledger.format_ledger, ledger.Entry}
    assert {f for f in made if not f.__name__.startswith("_")} - other == set(FIGURES)


def test_one_draw_costs_nearly_the_root_of_two():
    ratio, many, one = map(float, re.findall(r"[\d.]+(?= times| mm| *$)|\d+$", ledger.posterior_mean()))
    assert 1.35 < ratio < 1.4143 and many < 0.6 * one


def test_the_printed_attention_cannot_see_the_image_through_a_constant_latent():
    printed, reversed_ = map(float, re.findall(r"\de[-+]\d+", ledger.attention()))
    assert printed < 1e-5 and reversed_ > 1e-2


def test_figures_of_ours_are_read_from_the_committed_results():
    values = ledger.committed()
    assert values["command"].startswith("python -m ditr_lite evaluate") and values["weights_sha256"]
    rmse = values["summary"]["methods"]["keep_and_fill"]["optical"]["rmse"]
    assert f"keep_and_fill {1000 * rmse:.0f}" in ledger.in_region_evidence()
