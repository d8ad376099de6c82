import json
from dataclasses import replace

import numpy as np
import pytest

from ditr_lite import pipeline
from ditr_lite.config import preset
from ditr_lite.data import Sample, load_sample
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
    assert gaps["flying_mean"] is None and study.against_one(rows, "10", "optical")["flying_mean"] is not None
    lines = study.format_steps(rows).splitlines()
    assert "RMSE of a draw 40.0 mm, RMSE of their mean 38.0 mm" in lines[0] and lines[3].count("[+10.0, +10.0]") == 2


@pytest.mark.parametrize(("flying", "said"), [(25.0, "worse (+5.0"), (15.0, "better (-5.0"), (20.0, "no measurable")])
def test_the_verdict_is_of_the_most_steps_that_all_frames_saw(flying, said):
    rows = {"1": [row(0.02)] * 2, "10": [row(0.03, 0.027, flying)] * 2, "1000": [row(0.09)]}
    text = study.verdicts(rows)
    assert text.startswith("10 steps against 1") and f"flying in a draw       {said}" in text
    assert "RMSE of a draw         worse (+10.0" in text and "the spread is about right" in text
    assert "too small" in study.verdicts({"1": rows["1"], "2": [row(0.05, 0.001)] * 2})


SHAPE = (64, 96)


def step_frame(shape=SHAPE):
    """A surface at 0.6 m to the left of column 30, at 0.8 m to the right; all of it in the region."""
    truth = np.full(shape, 0.6, np.float32)
    truth[:, 30:] = 0.8
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (*shape, 3), np.uint8)
    return Sample("step", rgb, truth.copy(), truth, np.ones(shape, bool))


@pytest.mark.parametrize("shape", [SHAPE, (80, 100)])
def test_a_draw_is_what_the_system_returns_for_its_seed(shape):
    ditr = pipeline.Ditr(pipeline.build(preset("tiny")), preset("tiny"))
    sample = step_frame(shape)
    sample.region[40:], sample.depth[50:60, 20:40] = False, 0
    members = study.draw_frame(ditr, sample, steps=2, count=3, seed=5)
    assert members.shape == (3, *shape)
    for k, member in enumerate(members):
        again = ditr(sample.rgb, sample.depth, sample.region, steps=2, samples=1, seed=5 + k)
        np.testing.assert_array_equal(member, again.depth)
    with pytest.raises(ValueError, match="no true region"):
        study.draw_frame(ditr, replace(sample, region=None), 1)


def test_flying_pixels_hang_between_two_surfaces():
    s = step_frame()
    assert study.flying_share(s.depth_gt, s.depth_gt, s.region) == 0
    depth = s.depth_gt.copy()
    depth[:, 30] = 0.7  # one of the four columns within two pixels of the edge
    assert study.flying_share(depth, s.depth_gt, s.region) == 25
    depth[:, 30] = 0.605  # wrong, but on the other surface
    assert study.flying_share(depth, s.depth_gt, s.region) == 0
    depth[:, 50] = 0.7  # wrong, but no edge is near
    assert study.flying_share(depth, s.depth_gt, s.region) == 0
    assert study.flying_share(depth, np.full(SHAPE, 0.6, np.float32), s.region) is None


def test_scores_of_draws_that_are_known():
    s = step_frame()
    members = np.stack([s.depth_gt + d for d in (0.03, 0.01, 0.01, 0.01)]).astype(np.float32)
    found = study.draw_scores(members, s)
    assert list(found) == list(study.SCORES)
    assert found["mean_mm"] == pytest.approx(15, abs=1e-3) and found["single_mm"] == pytest.approx(15, abs=1e-3)
    assert found["crps_mm"] == pytest.approx(15 - 3 * 20 / 12, abs=1e-3)  # three pairs lie 20 mm apart
    assert found["coverage"] == 0 and study.draw_scores(2 * s.depth_gt - members[:2] + 0.02, s)["coverage"] == 100


def test_four_honest_draws_cover_three_fifths():
    rng, s = np.random.default_rng(0), step_frame()
    truth = (0.7 + 0.01 * rng.normal(size=SHAPE)).astype(np.float32)
    members = (0.7 + 0.01 * rng.normal(size=(4, *SHAPE))).astype(np.float32)
    assert study.draw_scores(members, replace(s, depth_gt=truth))["coverage"] == pytest.approx(60, abs=2)


def test_draws_of_several_steps_stand_in_columns_and_the_best_is_named():
    rows = {n: [dict.fromkeys(study.SCORES, v), dict.fromkeys(study.SCORES)] for n, v in ((1, 2.0), (10, 1.0))}
    head, seconds, *scores = study.format_draws(rows, {1: 0.5, 10: 3.0}).splitlines()
    assert head.split() == ["1", "step", "10", "steps", "best"] and seconds.split()[-2:] == ["0.50", "3.00"]
    assert all(line.split()[-3:-1] == ["2.0", "1.0"] for line in scores)
    best = [line.split()[-1] for line in scores]
    assert best == ["10" if less else "1" for _, less in study.SCORES.values()]
    unscored = study.format_draws({1: [dict.fromkeys(study.SCORES)]}, {1: 1.0}).splitlines()[-1]
    assert unscored.split()[-2:] == ["-", "-"]
