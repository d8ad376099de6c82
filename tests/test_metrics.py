"""Metrics: hand-computed values, identities, properties."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite import metrics as M

PIXELS = arrays(np.float64, 12, elements=st.floats(0.05, 10.0))

PRED, TRUTH = np.array([1.1, 2.0, 3.0]), np.array([1.0, 2.0, 4.0])
METRES = st.floats(0.05, 10.0)
MAPS = arrays(np.float64, (3, 4), elements=METRES)
MASKS = arrays(bool, (3, 4))


# by hand


def test_three_pixels_by_hand():
    assert M.rmse(PRED, TRUTH) == pytest.approx(math.sqrt((0.01 + 0 + 1) / 3))
    assert M.mae(PRED, TRUTH) == pytest.approx((0.1 + 0 + 1) / 3)
    assert M.rel(PRED, TRUTH) == pytest.approx((0.1 + 0 + 0.25) / 3)
    assert M.delta(PRED, TRUTH, 1.05) == pytest.approx(100 / 3)
    assert M.delta(PRED, TRUTH, 1.11) == pytest.approx(200 / 3)
    assert M.delta(PRED, TRUTH, 1.34) == pytest.approx(100)


def test_unknown_truth_and_masked_pixels_do_not_count():
    pred = np.array([1.5, 2.0, 9.0, 9.0])
    truth = np.array([1.0, 2.0, 0.0, 1.0])
    mask = np.array([True, True, True, False])
    for score in (M.rmse, M.mae, M.rel, M.delta):
        assert score(pred, truth, mask=mask) == pytest.approx(score(pred[:2], truth[:2]))
        assert score(pred, truth, mask=mask) != pytest.approx(score(pred, truth))
    assert M.crps(pred[None], truth, mask) == pytest.approx(0.25)


def test_delta_is_strict_and_symmetric():
    assert M.delta(np.array([1.25]), np.array([1.0]), 1.25) == 0
    assert M.delta(np.array([1.0]), np.array([1.25]), 1.25) == 0
    # the paper's wording would let this one pass: |pred - gt| / gt = 0.0488 < 0.05, but gt / pred = 1.0513
    assert M.delta(np.array([0.9512]), np.array([1.0]), 1.05) == 0


def test_float32_maps_are_scored_in_double_precision():
    truth = np.full(1_000_000, 1.0, np.float32)
    assert M.mae(truth + np.float32(0.001), truth) == pytest.approx(float(np.float32(1.001)) - 1.0, rel=1e-9)


# properties


@settings(deadline=None)
@given(MAPS, MAPS)
def test_order_of_the_scores(pred, truth):
    assert M.mae(pred, truth) <= M.rmse(pred, truth) * (1 + 1e-12) + 1e-15
    shares = [M.delta(pred, truth, t) for t in (1.05, 1.10, 1.25)]
    assert 0 <= shares[0] <= shares[1] <= shares[2] <= 100


@settings(deadline=None)
@given(MAPS, st.floats(0.1, 10))
def test_units(truth, factor):
    pred = truth[::-1]
    assert M.rmse(pred * factor, truth * factor) == pytest.approx(factor * M.rmse(pred, truth), rel=1e-9, abs=1e-12)
    assert M.mae(pred * factor, truth * factor) == pytest.approx(factor * M.mae(pred, truth), rel=1e-9, abs=1e-12)
    assert M.rel(pred * factor, truth * factor) == pytest.approx(M.rel(pred, truth), rel=1e-9, abs=1e-12)


@settings(deadline=None)
@given(MAPS)
def test_a_perfect_prediction(truth):
    assert M.rmse(truth, truth) == M.mae(truth, truth) == M.rel(truth, truth) == 0
    assert M.delta(truth, truth, 1.05) == 100


# CRPS


def test_crps_by_hand():
    ensemble, truth = np.array([[1.0], [3.0]]), np.array([2.0])
    # mean |x - y| = 1; one pair at distance 2, over S (S - 1) = 2
    assert M.crps(ensemble, truth) == pytest.approx(1.0 - 2.0 / 2.0)


@settings(deadline=None)
@given(arrays(np.float64, (4, 3, 4), elements=METRES), MAPS)
def test_crps_equals_the_double_sum(ensemble, truth):
    pairs = np.abs(ensemble[:, None] - ensemble[None]).sum(axis=(0, 1)) / (2 * 4 * 3)
    expected = (np.abs(ensemble - truth).mean(axis=0) - pairs).mean()
    assert M.crps(ensemble, truth) == pytest.approx(expected, abs=1e-12)


@settings(deadline=None)
@given(MAPS, MAPS)
def test_crps_of_one_or_of_equal_members_is_the_mae(pred, truth):
    assert M.crps(pred[None], truth) == pytest.approx(M.mae(pred, truth))
    assert M.crps(np.stack([pred] * 3), truth) == pytest.approx(M.mae(pred, truth))


def test_crps_is_fair_and_matches_the_closed_form_of_a_gaussian():
    rng = np.random.default_rng(0)
    sigma, truth = 0.2, np.full(200_000, 3.0)
    # closed form at y = mu: sigma (2 phi(0) - 1 / sqrt(pi))
    expected = sigma * (2 / math.sqrt(2 * math.pi) - 1 / math.sqrt(math.pi))
    for size in (2, 8):
        scores = M.crps(rng.normal(3.0, sigma, (size, truth.size)), truth)
        assert scores == pytest.approx(expected, rel=0.02)


# evaluate


def frame() -> tuple[np.ndarray, ...]:
    truth = np.array([[1.0, 1.0, 1.0], [2.0, 2.0, 0.0]], np.float32)
    pred = np.array([[1.1, 1.2, 1.3], [2.4, 2.5, 7.0]], np.float32)
    region = np.array([[True, True, False], [False, False, True]])
    raw = np.array([[1.5, 0.0, 0.0], [2.0, 0.0, 1.0]], np.float32)
    return pred, truth, region, raw


def test_evaluate_scores_the_right_pixels():
    result = M.evaluate(*frame())
    assert tuple(result) == M.SETS
    assert {name: scores["n"] for name, scores in result.items()} == {
        "whole": 5,
        "optical": 2,
        "optical_valid": 1,
        "geometric": 2,
        "outside": 3,
    }
    mae = {name: round(scores["mae"], 5) for name, scores in result.items()}
    assert mae == {"whole": 0.3, "optical": 0.15, "optical_valid": 0.1, "geometric": 0.4, "outside": 0.4}
    assert list(result["whole"]) == [*M.METRICS, "n"]
    assert all(type(v) is float for m, v in result["whole"].items() if m != "n") and type(result["whole"]["n"]) is int


def test_evaluate_gives_none_for_empty_sets_and_missing_input():
    pred, truth, region, raw = frame()
    assert [s for s, v in M.evaluate(pred, truth).items() if v] == ["whole"]
    assert [s for s, v in M.evaluate(pred, truth, region).items() if v] == ["whole", "optical", "outside"]
    assert M.evaluate(pred, truth, np.zeros_like(region), raw)["optical"] is None
    assert M.evaluate(pred, truth, region, np.full_like(raw, 0.5))["geometric"] is None
    assert set(M.evaluate(pred, np.zeros_like(truth), region, raw).values()) == {None}


@settings(deadline=None)
@given(MAPS, MAPS, MASKS)
def test_optical_and_outside_are_the_whole(pred, truth, region):
    result = M.evaluate(pred, truth, region)
    parts = [s for s in (result["optical"], result["outside"]) if s]
    assert sum(s["n"] for s in parts) == result["whole"]["n"]
    square = sum(s["n"] * s["rmse"] ** 2 for s in parts) / result["whole"]["n"]
    assert math.sqrt(square) == pytest.approx(result["whole"]["rmse"], rel=1e-6, abs=1e-9)


# masks


def test_segmentation_scores_by_hand():
    true = np.array([[True, True, True, True, False, False]])
    pred = np.array([[False, True, True, True, True, True]])
    assert M.iou(pred, true) == pytest.approx(3 / 6)
    assert M.miss_rate(pred, true) == pytest.approx(1 / 4)
    assert M.area_ratio(pred, true) == pytest.approx(5 / 4)
    empty = np.zeros_like(true)
    assert M.iou(empty, true) == 0 and M.miss_rate(empty, true) == 1
    assert M.iou(empty, empty) is None and M.miss_rate(pred, empty) is None and M.area_ratio(pred, empty) is None


@settings(deadline=None)
@given(MASKS, MASKS)
def test_growing_a_mask_misses_less(pred, true):
    rate, grown = M.miss_rate(pred, true), M.miss_rate(pred | true[::-1], true)
    assert rate is None or grown <= rate


# bad input


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_predictions_with_holes_are_refused(bad):
    pred, truth, region, raw = frame()
    pred[1, 2] = bad  # even where there is no ground truth
    with pytest.raises(ValueError, match="dense: 1 of 6"):
        M.evaluate(pred, truth, region, raw)


def test_other_bad_input_is_refused_with_advice():
    pred, truth, region, raw = frame()
    with pytest.raises(ValueError, match="resize"):
        M.evaluate(pred.T, truth)
    with pytest.raises(ValueError, match="millimetres"):
        M.evaluate(pred, (1000 * truth).astype(np.uint16))
    with pytest.raises(ValueError, match="mask > 0"):
        M.evaluate(pred, truth, region.astype(int))
    with pytest.raises(ValueError, match="clean_depth"):
        M.evaluate(pred, truth, region, np.where(raw > 0, raw, np.nan))
    with pytest.raises(ValueError, match="clean_depth"):
        M.rmse(pred, np.where(truth > 0, truth, np.nan))
    with pytest.raises(ValueError, match="no pixel to score"):
        M.rmse(pred, np.zeros_like(truth))
    with pytest.raises(ValueError, match="above 1"):
        M.delta(pred, truth, 0.05)
    with pytest.raises(ValueError, match="axis 0"):
        M.crps(pred, truth)


def scores(rmse: float, n: int, **sets) -> dict:
    """Return what ``evaluate`` gives for a frame whose pixels are all off by ``rmse`` metres at 1 m."""
    whole = {"rmse": rmse, "mae": rmse, "rel": rmse, "d105": 0.0, "d110": 0.0, "d125": 100.0, "n": n}
    return dict.fromkeys(M.SETS) | {"whole": whole} | sets


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


def test_every_figure_of_a_table_stands_below_its_own_title():
    row = {"rmse": 0.04, "mae": 0.03, "rel": 0.05, "d105": 60.0, "d110": 70.0, "d125": 80.0, "n": 9}
    title, figures = M.format_table({"ours": {"whole": row}}, ["whole"]).splitlines()[1:3]
    titles = ["RMSE mm", "MAE mm", "REL", "d1.05 %", "d1.10 %", "d1.25 %"]
    ends = [title.index(word) + len(word) for word in titles]
    found = [figures[start:end].strip() for start, end in zip([len("method"), *ends], ends, strict=False)]
    assert found == ["40.0", "30.0", "0.0500", "60.00", "70.00", "80.00"]


def test_table_shows_millimetres_and_dashes():
    rows = {"ours": scores(0.3317, 5, optical=scores(0.15, 2)["whole"]), "flat": scores(0.3, 5)}
    lines = M.format_table(rows, ["whole", "optical"]).splitlines()
    assert lines[0] == "whole (5 pixels)" and lines[1].split()[:3] == ["method", "RMSE", "mm"]
    assert lines[2].split()[:2] == ["ours", "331.7"]
    assert lines[8].split() == ["flat"] + ["-"] * 6
    assert len({len(line) for line in lines if line.startswith(("ours", "flat", "method"))}) == 1
