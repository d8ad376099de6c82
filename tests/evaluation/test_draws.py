from dataclasses import replace

import numpy as np
import pytest

from ditr_lite import pipeline
from ditr_lite.config import preset
from ditr_lite.data import Sample
from ditr_lite.evaluation import draws

SHAPE = (64, 96)


def step_frame(shape=SHAPE):
    """A surface at 0.6 m to the left of column 30, at 0.8 m to the right; all of it in the region."""
    truth = np.full(shape, 0.6, np.float32)
    truth[:, 30:] = 0.8
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (*shape, 3), np.uint8)
    return Sample("step", rgb, truth.copy(), truth, np.ones(shape, bool))


@pytest.mark.parametrize("shape", [SHAPE, (80, 100)])
def test_the_mean_of_the_draws_is_what_the_system_returns(shape):
    ditr = pipeline.Ditr(pipeline.build(preset("tiny")), preset("tiny"))
    sample = step_frame(shape)
    sample.region[40:], sample.depth[50:60, 20:40] = False, 0
    members = draws.draw_frame(ditr, sample, steps=2, count=3, seed=5)
    out = ditr(sample.rgb, sample.depth, sample.region, steps=2, samples=3, seed=5)
    assert members.shape == (3, *shape)
    np.testing.assert_allclose(members.mean(0), out.depth, rtol=1e-5)
    np.testing.assert_allclose(members.std(0, ddof=1), out.std, atol=1e-5)
    with pytest.raises(ValueError, match="no true region"):
        draws.draw_frame(ditr, replace(sample, region=None), 1)


def test_flying_pixels_hang_between_two_surfaces():
    s = step_frame()
    assert draws.flying_share(s.depth_gt, s.depth_gt, s.region) == 0
    depth = s.depth_gt.copy()
    depth[:, 30] = 0.7  # one of the four columns within two pixels of the edge
    assert draws.flying_share(depth, s.depth_gt, s.region) == 25
    depth[:, 30] = 0.605  # wrong, but on the other surface
    assert draws.flying_share(depth, s.depth_gt, s.region) == 0
    depth[:, 50] = 0.7  # wrong, but no edge is near
    assert draws.flying_share(depth, s.depth_gt, s.region) == 0
    assert draws.flying_share(depth, np.full(SHAPE, 0.6, np.float32), s.region) is None


def test_scores_of_draws_that_are_known():
    s = step_frame()
    members = np.stack([s.depth_gt + d for d in (0.03, 0.01, 0.01, 0.01)]).astype(np.float32)
    found = draws.draw_scores(members, s)
    assert list(found) == list(draws.SCORES)
    assert found["mean_mm"] == pytest.approx(15, abs=1e-3) and found["single_mm"] == pytest.approx(15, abs=1e-3)
    assert found["crps_mm"] == pytest.approx(15 - 3 * 20 / 12, abs=1e-3)  # three pairs lie 20 mm apart
    assert found["coverage"] == 0 and draws.draw_scores(2 * s.depth_gt - members[:2] + 0.02, s)["coverage"] == 100


def test_four_honest_draws_cover_three_fifths():
    rng, s = np.random.default_rng(0), step_frame()
    truth = (0.7 + 0.01 * rng.normal(size=SHAPE)).astype(np.float32)
    members = (0.7 + 0.01 * rng.normal(size=(4, *SHAPE))).astype(np.float32)
    assert draws.draw_scores(members, replace(s, depth_gt=truth))["coverage"] == pytest.approx(60, abs=2)


def test_spread_and_error_are_those_of_the_regions_pixels():
    s = step_frame()
    s.region[10:] = False
    members = np.stack([s.depth_gt + 0.01, s.depth_gt + 0.03])
    spread, error = draws.spread_and_error([members] * 2, [s, s])
    assert spread.shape == error.shape == (2 * 960,)
    np.testing.assert_allclose(spread, 0.02 / np.sqrt(2), rtol=1e-4)
    np.testing.assert_allclose(error, 0.02, rtol=1e-4)


def test_calibrated_draws_are_found_calibrated():
    rng = np.random.default_rng(1)
    spread = rng.uniform(0.005, 0.05, 80_003)
    expected, observed = draws.reliability(spread, rng.normal(0, spread))
    np.testing.assert_allclose(observed, expected, rtol=0.05)
    assert (np.diff(expected) > 0).all()
    np.testing.assert_allclose(draws.reliability(spread, 3 * spread)[1], 3 * draws.reliability(spread, spread)[0])
    with pytest.raises(ValueError, match="same pixels"):
        draws.reliability(spread, spread[1:])


def test_dropping_what_is_doubted_lowers_the_error_of_the_rest():
    error = np.array([0.01, -0.04, 0.02, 0.03])
    np.testing.assert_allclose(
        draws.rejection(np.abs(error), error, (0.25, 0.5, 1)), [0.01, np.sqrt(2.5e-4), np.sqrt(7.5e-4)]
    )
    np.testing.assert_allclose(draws.rejection(-np.abs(error), error, (0.25,)), [0.04])
