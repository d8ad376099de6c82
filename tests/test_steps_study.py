import json

import numpy as np
import pytest

from ditr_lite import steps_study as study
from ditr_lite.data import load_sample


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
    assert table.splitlines()[1].split()[:2] == ["1", "2"] and "+0.0 [+0.0, +0.0]" in table
