"""The audit: what it finds in the paper's tables, that it never accuses honest ones, that it sees planted faults."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite import metrics
from ditr_lite.paper import audit, tables

RECORDS = {name: table.records() for name, table in tables.TABLES.items()}
DEPTHS = arrays(np.float64, (2, 3, 4), elements=st.floats(0.2, 5.0))
FRAMES = st.lists(DEPTHS, min_size=1, max_size=4)


# the paper's tables


def test_the_impossible_rows_of_tables_1_and_2():
    found = [(name, f.row) for name in ("T1", "T2") for f in audit.audit_table(RECORDS[name])]
    assert found == [("T1", "DenseDepth"), ("T2", "DepthGrasp"), ("T2", "SwinDRNet")]
    assert all(f.test == "rmse >= mae" for name in ("T1", "T2") for f in audit.audit_table(RECORDS[name]))


def test_all_18_entries_of_table_5_are_impossible_and_tables_3_and_4_are_clean():
    found = audit.audit_table(RECORDS["T5"])
    assert len(found) == 18 == len({(f.row, f.part) for f in found})
    assert {f.test for f in found} == {"rmse >= mae"}
    assert audit.audit_table(RECORDS["T3"]) == audit.audit_table(RECORDS["T4"]) == []


def test_the_worded_delta_is_refuted_by_three_rows_of_table_3():
    assert audit.below_rel_floor(RECORDS["T3"], worded=True) == ["ClearGrasp", "DenseDepth", "DepthGrasp"]
    assert audit.below_rel_floor(RECORDS["T3"], worded=False) == []
    # DepthGrasp's REL as printed is just below the field's bound, too: only rounding saves it
    assert audit.below_rel_floor(RECORDS["T3"], worded=False, rounding=(0, 0)) == ["DepthGrasp"]


def test_six_orders_of_table_5():
    orders = {o.order: o for o in audit.rank_orders(tables.T5, tables.T1)}
    assert len(orders) == 6 and next(iter(orders)) == ("rmse", "rel", "mae")
    best, second = orders["rmse", "rel", "mae"], orders["mae", "rmse", "rel"]
    assert (best.possible, best.entries, best.between, best.pairs) == (14, 18, 26, 27)
    assert best.misses == [("DITR", "mae")] and best.by_metric == {"rmse": 9, "mae": 8, "rel": 9}
    assert (second.possible, second.by_metric["rel"]) == (18, 0)
    assert (orders["rmse", "mae", "rel"].possible, orders["rmse", "mae", "rel"].between) == (0, 15)
    assert orders["rel", "rmse", "mae"].possible == 18 and orders["rel", "rmse", "mae"].by_metric["rel"] == 1


def test_weight_of_optical_pixels_for_dfnet():
    part = tables.T5.reordered(("rmse", "rel", "mae")).records()["DFNet"]
    weights = {
        m: audit.implied_weight(
            RECORDS["T1"]["DFNet"][m], part[f"optical.{m}"], part[f"geometric.{m}"], 1 + (m == "rmse"), 0.0005
        )
        for m in audit.LOWER_IS_BETTER
    }
    values = [w[1] for w in weights.values()]
    assert (min(values), max(values)) == (pytest.approx(0.5926, abs=1e-4), pytest.approx(0.875))
    assert min(w[0] for w in weights.values()) == pytest.approx(0.5217, abs=1e-4)
    assert max(w[2] for w in weights.values()) == 1


def test_who_surpasses_ditr():
    assert audit.beaten_in(RECORDS["T1"], "DITR") == audit.beaten_in(RECORDS["T5"], "DITR") == {}
    assert audit.beaten_in(RECORDS["T2"], "DITR") == {"d125": "TranspareNet"}
    assert audit.beaten_in(RECORDS["T3"], "DITR") == dict.fromkeys(("rel", "d110", "d125"), "SwinDRNet")
    assert audit.beaten_in(RECORDS["T3"], "DITR", ["rmse"]) == {}
    assert audit.beaten_in(RECORDS["T3"], "LIDF", ["rmse"]) == {"rmse": "DITR"}
    with pytest.raises(ValueError, match="no row"):
        audit.beaten_in(RECORDS["T1"], "OURS")


# honest tables


@settings(deadline=None)
@given(FRAMES)
def test_honest_scores_are_never_accused(frames):
    region = np.zeros((3, 4), bool)
    region[:2, 1:3] = True
    average = metrics.average([metrics.evaluate(pred, truth, region) for pred, truth in frames])
    for row in (average["whole"], average["optical"], average["whole"]["pooled"]):
        printed = {k: round(row[k], 3 if k in audit.LOWER_IS_BETTER else 2) for k in metrics.METRICS}
        assert audit.audit_table({"ours": printed}) == []
        exact = {k: row[k] * (1 + 1e-12 * (k == "rmse")) for k in metrics.METRICS}
        assert audit.audit_table({"ours": exact}, rounding=(1e-12, 1e-9)) == []


@settings(deadline=None)
@given(FRAMES)
def test_the_field_s_floor_holds_and_the_worded_one_for_worded_shares(frames):
    pred, truth = np.concatenate([f[0] for f in frames]), np.concatenate([f[1] for f in frames])
    row = metrics.evaluate(pred, truth)["whole"]
    assert row["rel"] >= audit.rel_floor(row["d105"], row["d110"], row["d125"]) - 1e-9
    error = np.abs(pred - truth) / truth
    worded = [100 * np.mean(error < t - 1) for _, t in audit.SHARES]
    assert error.mean() >= audit.rel_floor(*worded, worded=True) - 1e-9


def test_the_field_s_floor_is_reached_by_pixels_that_are_too_near():
    truth = np.ones((1, 3))
    pred = truth / np.array([[1.05, 1.10, 1.25]])
    row = metrics.evaluate(pred - 1e-12, truth)["whole"]
    assert row["rel"] == pytest.approx(audit.rel_floor(row["d105"], row["d110"], row["d125"]), abs=1e-9)
    assert row["rel"] < audit.rel_floor(row["d105"], row["d110"], row["d125"], worded=True)


@settings(deadline=None)
@given(DEPTHS, st.integers(1, 11), st.sampled_from([1, 2]))
def test_implied_weight_is_the_share_of_pixels(maps, n, power):
    error = np.abs(maps[0] - maps[1]).ravel()
    whole, inside, outside = (np.mean(e**power) ** (1 / power) for e in (error, error[:n], error[n:]))
    assume(abs(inside - outside) > 1e-3)
    low, value, high = audit.implied_weight(whole, inside, outside, power)
    assert low == pytest.approx(n / 12, abs=1e-6) == high and value == pytest.approx(n / 12, abs=1e-6)
    wide = audit.implied_weight(whole, inside, outside, power, rounding=1e-4)
    assert wide[0] <= value + 1e-9 and wide[2] >= min(value, 1) - 1e-9


@settings(deadline=None)
@given(DEPTHS, DEPTHS)
def test_honest_breakdowns_put_the_right_order_first_with_full_marks(first, second):
    region = np.zeros((3, 4), bool)
    region[:2] = True
    names = {"a": metrics.evaluate(*first, region), "b": metrics.evaluate(*second, region)}
    wholes = {n: tuple(s["whole"][m] for m in audit.LOWER_IS_BETTER) for n, s in names.items()}
    parts = {
        n: tuple(s[key][m] for key in ("outside", "optical") for m in audit.LOWER_IS_BETTER) for n, s in names.items()
    }
    whole = tables.Table("W", "", audit.LOWER_IS_BETTER, wholes)
    part = tables.Table("P", "", tables.T5.columns, parts)
    printed = {o.order: o for o in audit.rank_orders(part, whole, rounding=1e-9)}[audit.LOWER_IS_BETTER]
    assert (printed.possible, printed.between) == (printed.entries, printed.pairs) == (4, 6)


# planted faults


def row(**changes):
    return {"ours": {"rmse": 0.03, "mae": 0.02, "rel": 0.04, "d105": 80.0, "d110": 90.0, "d125": 98.0} | changes}


@pytest.mark.parametrize(
    ("changes", "test"),
    [
        ({"mae": 0.032}, "rmse >= mae"),
        ({"d110": 79.0}, "shares rise"),
        ({"d125": 89.0}, "shares rise"),
        ({"d125": 100.1}, "share <= 100 %"),
        ({"rel": 0.010}, "rel >= bands"),
    ],
)
def test_a_planted_fault_is_found_and_named(changes, test):
    assert audit.audit_table(row()) == []
    (finding,) = audit.audit_table(row(**changes))
    assert (finding.row, finding.part, finding.test) == ("ours", "", test)
    assert any(f"{x:g}" in finding.text for x in changes.values())


def test_rounding_is_allowed_for_and_no_more():
    assert audit.audit_table(row(mae=0.031)) == []  # .0305 and .0305 both round so
    assert audit.audit_table(row(mae=0.031), rounding=(0, 0)) != []
    assert audit.audit_table(row(d105=90.01)) == [] and audit.audit_table(row(d105=90.02)) != []


def test_parts_are_told_apart_and_other_columns_ignored():
    (finding,) = audit.audit_table({"x": {"a.rmse": 0.1, "a.mae": 0.2, "b.rmse": 0.2, "b.mae": 0.1, "n": -5}})
    assert finding.part == "a"


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="nothing to audit"):
        audit.audit_table({})
    for bad in (-0.1, float("nan")):
        with pytest.raises(ValueError, match="ours, rmse"):
            audit.audit_table(row(rmse=bad))
    with pytest.raises(ValueError, match="any weight"):
        audit.implied_weight(0.02, 0.0205, 0.0200, rounding=0.0005)
    with pytest.raises(ValueError, match="no method in common"):
        audit.rank_orders(tables.T5, tables.T4)
