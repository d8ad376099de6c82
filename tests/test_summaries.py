"""Averages over frames, their intervals, the table; all by the names that ``metrics`` gives them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite import metrics as M
from ditr_lite import summaries

PIXELS = arrays(np.float64, 12, elements=st.floats(0.05, 10.0))


def scores(rmse: float, n: int, **sets) -> dict:
    """Return what ``evaluate`` gives for a frame whose pixels are all off by ``rmse`` metres at 1 m."""
    whole = {"rmse": rmse, "mae": rmse, "rel": rmse, "d105": 0.0, "d110": 0.0, "d125": 100.0, "n": n}
    return dict.fromkeys(M.SETS) | {"whole": whole} | sets


# averages and intervals


def test_average_is_per_image_with_the_pooled_value_beside_it():
    one = M.evaluate(np.array([[1.1]]), np.array([[1.0]]))
    three = M.evaluate(np.array([[1.3, 1.3, 1.3]]), np.array([[1.0, 1.0, 1.0]]))
    whole = M.average([one, three])["whole"]
    assert whole["rmse"] == pytest.approx(0.2) and whole["mae"] == pytest.approx(0.2)
    assert whole["pooled"]["mae"] == pytest.approx((0.1 + 3 * 0.3) / 4)
    assert whole["pooled"]["rmse"] == pytest.approx(math.sqrt((0.01 + 3 * 0.09) / 4))
    assert (whole["n"], whole["images"]) == (4, 2)


@settings(deadline=None)
@given(st.lists(st.tuples(PIXELS, PIXELS), min_size=1, max_size=4))
def test_pooling_equals_scoring_everything_at_once(frames):
    pooled = M.average([M.evaluate(p[None], g[None]) for p, g in frames])["whole"]["pooled"]
    together = M.evaluate(*(np.concatenate(rows)[None] for rows in zip(*frames, strict=True)))["whole"]
    assert pooled == pytest.approx({m: together[m] for m in M.METRICS}, rel=1e-6, abs=1e-9)


def test_average_leaves_out_images_without_such_pixels():
    glass = scores(0.3, 2)["whole"]
    result = M.average([scores(0.1, 5, optical=glass), scores(0.2, 5)])
    assert result["optical"]["images"] == 1 and result["optical"]["rmse"] == 0.3
    assert result["whole"]["images"] == 2 and M.average([scores(0.2, 5)])["optical"] is None
    with pytest.raises(ValueError, match="nothing to average"):
        M.average([])


def test_bootstrap_interval_is_that_of_the_mean():
    values = np.random.default_rng(1).normal(5.0, 2.0, 400)
    mean, low, high = summaries.bootstrap_mean(values)
    assert mean == pytest.approx(values.mean())
    expected = 1.96 * values.std() / math.sqrt(len(values))
    assert (high - mean, mean - low) == (pytest.approx(expected, rel=0.1), pytest.approx(expected, rel=0.1))
    assert (
        summaries.bootstrap_mean(values) == summaries.bootstrap_mean(values) != summaries.bootstrap_mean(values, seed=1)
    )


def test_paired_bootstrap_keeps_pairs_together():
    hard = np.random.default_rng(2).normal(5.0, 2.0, 50)
    mean, low, high = summaries.paired_bootstrap(hard + 0.1, hard)
    assert (mean, low, high) == pytest.approx((0.1, 0.1, 0.1))  # unpaired, the interval would be about 1.6 wide
    assert summaries.paired_bootstrap([1.0, None, 3.0], [0.5, 9.0, None])[0] == 0.5
    with pytest.raises(ValueError, match="same images"):
        summaries.paired_bootstrap([1.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="finite"):
        summaries.bootstrap_mean([None])


# table


def test_table_shows_millimetres_and_dashes():
    rows = {"ours": scores(0.3317, 5, optical=scores(0.15, 2)["whole"]), "flat": scores(0.3, 5)}
    lines = M.format_table(rows, ["whole", "optical"]).splitlines()
    assert lines[0] == "whole (5 pixels)" and lines[1].split()[:3] == ["method", "RMSE", "mm"]
    assert lines[2].split()[:3] == ["ours", "331.7", "331.7"]
    assert lines[8].split() == ["flat"] + ["-"] * 6
    assert len({len(line) for line in lines if line.startswith(("ours", "flat", "method"))}) == 1


def test_a_ratio_of_means_keeps_pairs_together():
    hard = np.linspace(0.5, 2, 30)
    assert np.allclose(summaries.ratio_bootstrap(list(0.75 * hard), list(hard)), 0.75)
    mean, low, high = summaries.ratio_bootstrap([1.0, 2.0, 3.0, None], [1.0, 4.0, 1.0, 5.0])
    assert mean == 1.0 and low < 1 < high  # the mean of the ratios would be 1.5
    flat, values = np.ones(400), np.random.default_rng(1).normal(5.0, 1.0, 400)
    _, low, high = summaries.ratio_bootstrap(values, flat)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / math.sqrt(400), rel=0.1)
    with pytest.raises(ValueError, match="common images"):
        summaries.ratio_bootstrap([None], [1.0])
    with pytest.raises(ValueError, match="n >= 1; got 1 images, n = 0"):
        summaries.ratio_bootstrap([1.0], [1.0], n=0)
    with pytest.raises(ValueError, match="same images"):
        summaries.ratio_bootstrap([1.0], [1.0, 2.0])


def test_an_interval_is_told_in_the_unit_and_style_asked_for():
    assert summaries.format_interval((0.0012, -0.0034, 0.0051), 1000) == "+1.2 [-3.4, +5.1]"
    assert summaries.format_interval([0.5, 0.25, 0.75], style=".2f") == "0.50 [0.25, 0.75]"
    assert summaries.format_interval(None) == "-" and summaries.format_interval(None, missing="x") == "x"
