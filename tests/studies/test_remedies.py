"""Remedies: every run works on a frame, the edge meter finds a shift, and the table says what the intervals say."""

import json

import numpy as np
import pytest
import remedy_study

from ditr_lite import store
from ditr_lite.data import Sample, list_samples, load_sample
from ditr_lite.evaluation import results
from ditr_lite.studies import remedies

RESULT = store.WEIGHTS / "results_remedies.json"
SCENE = load_sample(list_samples("rooms_val")[4])


@pytest.mark.parametrize("name", remedies.RUNS)
def test_every_run_completes_a_frame(name, tiny):
    before = SCENE.depth.copy()
    depth = remedies.RUNS[name](tiny, SCENE)
    assert depth.shape == SCENE.depth.shape and np.isfinite(depth).all() and (depth > 0).all()
    assert (SCENE.depth == before).all()


def test_every_remedy_names_runs_and_pixels_that_there_are():
    for remedy in remedies.REMEDIES:
        assert {remedy.before, remedy.after} <= set(remedies.RUNS) and remedy.where in remedies.PIXELS
        assert remedy.before != remedy.after
    used = {run for remedy in remedies.REMEDIES for run in (remedy.before, remedy.after)}
    assert used == set(remedies.RUNS) and {remedy.where for remedy in remedies.REMEDIES} == set(remedies.PIXELS)


def test_errors_are_those_of_the_pixels_that_are_named(tiny, monkeypatch):
    truth = np.ones((4, 6), np.float32)
    region = np.zeros((4, 6), bool)
    region[:, :3] = True
    sample = Sample("s", np.zeros((4, 6, 3), np.uint8), truth, truth, region)
    runs = {"as it is": lambda d, s: s.depth_gt + 0.01 * s.region, "better": lambda d, s: s.depth_gt + 0.002}
    monkeypatch.setattr(remedies, "RUNS", runs)
    pair = [remedies.Remedy("x", "y", "as it is", "better", where) for where in ("in the region", "outside it")]
    inside, outside = remedies.remedy_errors(tiny, sample, pair)
    assert inside == {"before_m": pytest.approx(0.01, abs=1e-5), "after_m": pytest.approx(0.002, abs=1e-5)}
    assert outside == {"before_m": 0, "after_m": pytest.approx(0.002, abs=1e-5)}
    holes = remedies.Remedy("x", "y", "as it is", "better", "holes outside it")
    assert remedies.remedy_errors(tiny, sample, [holes]) == [{"before_m": None, "after_m": None}]


@pytest.mark.parametrize("shift", [-5, 0, 3])
def test_the_edge_meter_peaks_where_depth_is_aligned(shift):
    m_rgb = np.zeros((20, 60), bool)
    m_rgb[:, [10, 33]] = True
    shifts = np.arange(-8, 9)
    found = remedies.edge_agreement(m_rgb, remedies.moved_sideways(m_rgb, -shift), shifts)
    peak = shifts[found == found.max()]
    assert found.max() == 1 and peak.tolist() == list(range(shift - 2, shift + 3))  # it forgives two pixels
    assert not remedies.edge_agreement(m_rgb, np.zeros_like(m_rgb), shifts).any()


def test_what_is_moved_out_of_the_picture_does_not_come_back():
    image = np.arange(1, 9).reshape(2, 4)
    assert remedies.moved_sideways(image, 1).tolist() == [[0, 1, 2, 3], [0, 5, 6, 7]]
    assert remedies.moved_sideways(image, -3).tolist() == [[4, 0, 0, 0], [8, 0, 0, 0]]
    assert np.array_equal(remedies.moved_sideways(image, 0), image)


def test_the_verdict_is_that_of_the_interval():
    assert remedies.effect([-0.01, -0.02, -0.001]) == "helps"
    assert remedies.effect([0.01, 0.001, 0.02]) == "costs"
    assert remedies.effect([0.01, -0.001, 0.02]) == "not clear"
    assert remedies.effect(None) == "not measured"


def test_the_table_has_a_line_for_every_row():
    row = {"symptom": "s", "knob": "`k`", "where": "outside it", "before_m": [0.01, None], "after_m": [0.02, None]}
    rows = [{**row, "minus_m": [0.01, 0.005, 0.015]}, {**row, "minus_m": None, "before_m": [None]}]
    text = remedies.remedy_table(rows)
    first, second = text.splitlines()[2:]
    assert first == "| s | `k` | outside it | 10.0 | 20.0 | +10.0 [+5.0, +15.0] | costs |"
    assert second == "| s | `k` | outside it | - | 20.0 | - | not measured |"


def test_the_committed_results_are_whole():
    result = json.loads(RESULT.read_text(encoding="utf-8"))
    assert [row["knob"] for row in result["rows"]] == [remedy.knob for remedy in remedies.REMEDIES]
    for row in result["rows"]:
        assert len(row["before_m"]) == len(row["after_m"]) == len(result["frames"])
    assert result["split"] == "rooms_val" and result["command"].startswith("python tools/remedy_study.py")


def test_the_command_writes_what_it_measured(tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(remedy_study.Ditr, "from_pretrained", lambda: tiny)
    monkeypatch.setattr(remedies, "REMEDIES", remedies.REMEDIES[:1])
    out = tmp_path / "results_remedies.json"
    assert remedy_study.main(["--limit", "1", "--json", str(out)]) == 0
    assert "| all distances off by one factor |" in capsys.readouterr().out
    written = results.read("remedies", tmp_path)
    assert len(written["frames"]) == 1 and written["rows"][0]["before_m"][0] > 0.1


def test_what_lowers_the_error_helps_and_what_raises_it_costs(tiny, monkeypatch):
    errors = [[{"before_m": 0.03 + 0.001 * k, "after_m": after} for after in (0.01, 0.05)] for k in range(4)]
    monkeypatch.setattr(remedies, "REMEDIES", remedies.REMEDIES[:2])
    monkeypatch.setattr(remedies, "remedy_errors", lambda ditr, k: errors[k])
    helps, costs = remedies.score_remedies(tiny, range(4))
    assert helps["minus_m"][0] == pytest.approx(-0.0215) and remedies.effect(helps["minus_m"]) == "helps"
    assert costs["minus_m"][0] == pytest.approx(0.0185) and remedies.effect(costs["minus_m"]) == "costs"
