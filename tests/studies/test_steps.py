import json

import numpy as np
import pytest

from ditr_lite.data import load_sample
from ditr_lite.studies import steps as study


@pytest.fixture(scope="module")
def sample():
    return load_sample("val_00000")


def noisy(sample, steps, seed):
    truth = np.where(sample.depth_gt > 0, sample.depth_gt, 1).astype(np.float32)
    return truth + 0.01 * np.random.default_rng([steps, seed]).normal(size=truth.shape).clip(-4, 4).astype(np.float32)


def test_the_mean_of_independent_members_gains_a_square_root(sample):
    scores = study.score_members([noisy(sample, 1, k) for k in range(4)], sample)
    assert scores["single"]["optical"] == pytest.approx(0.01, rel=0.05)
    assert scores["mean"]["1"] == pytest.approx(scores["single"])
    assert scores["mean"]["4"]["optical"] == pytest.approx(0.005, rel=0.05)
    assert scores["spread"]["geometric"] == pytest.approx(0.01, rel=0.1)
    assert 0 <= scores["flying_mean"] < 50 and 0 <= scores["flying_single"] < 50


def test_a_plan_is_followed_saved_and_shown(sample):
    saved = []
    rows = study.run_plan(noisy, [sample, sample], {1: (2, 2), 10: (1, 1)}, lambda r: saved.append(list(r)))
    assert saved == [["1"], ["1", "10"]] and [len(r) for r in rows.values()] == [2, 1]
    table = study.format_steps(json.loads(json.dumps(rows)), "geometric")
    assert table.startswith("geometric, 1 step, 2 frames, 2 draws") and "   10 steps, 1 frames" in table
    assert study.format_flying(rows).count("\n") == 2


def row(error, spread=0.01, flying=20.0, count=4):
    mean = {str(2**k): {"optical": error - 0.001 * k} for k in range(count.bit_length()) if 2**k <= count}
    parts = {"single": {"optical": error}, "mean": mean, "crps": {"optical": error / 2}, "spread": {"optical": spread}}
    return parts | {"flying_single": flying, "flying_mean": flying}


def test_more_steps_are_compared_on_their_own_frames_and_members():
    rows = {"1": [row(0.02), row(0.06)], "10": [row(0.03), row(0.07)], "1000": [row(0.03, count=1)]}
    gaps = study.against_one(rows, "1000", "optical")  # one frame, one member: 30 - 20 mm, whatever the other frame
    assert gaps["single"] == pytest.approx((0.01,) * 3) and gaps["mean"] == pytest.approx((0.01,) * 3)
    assert study.against_one(rows, "10", "geometric")["single"] is None
    lines = study.format_steps(rows).splitlines()
    assert "RMSE of a draw 40.0 mm, RMSE of their mean 38.0 mm" in lines[0] and lines[3].count("[+10.0, +10.0]") == 2


@pytest.mark.parametrize(("flying", "said"), [(25.0, "worse (+5.0"), (15.0, "better (-5.0"), (20.0, "no measurable")])
def test_the_verdict_is_of_the_most_steps_that_all_frames_saw(flying, said):
    rows = {"1": [row(0.02)] * 2, "10": [row(0.03, 0.027, flying)] * 2, "1000": [row(0.09)]}
    text = study.verdicts(rows)
    assert text.startswith("10 steps against 1") and f"flying in a draw       {said}" in text
    assert "RMSE of a draw         worse (+10.0" in text and "the spread is about right" in text
    assert "too small" in study.verdicts({"1": rows["1"], "2": [row(0.05, 0.001)] * 2})
