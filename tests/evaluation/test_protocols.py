"""Each row of the table of protocols: what it scores, cleans, pools; all selectable by name."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ditr_lite import cli as command_line
from ditr_lite import metrics
from ditr_lite.data import Sample
from ditr_lite.evaluation import protocols
from ditr_lite.evaluation.protocols import CLEARGRASP, PROTOCOLS, Protocol
from ditr_lite.paper import audit

SHAPE = (24, 32)


def sample(region_rows=8, far=1.0, **changes):
    """A wall at 0.8 m; glass in the upper rows, an opaque object in the lower ones, one row unknown."""
    truth = np.full(SHAPE, 0.8, np.float32)
    truth[-1] = 0
    truth[-2] = far
    region, instances = np.zeros(SHAPE, bool), np.zeros(SHAPE, np.uint8)
    region[:region_rows] = True
    instances[:region_rows], instances[16:20] = 1, 2
    frame = Sample("a", np.zeros((*SHAPE, 3), np.uint8), truth.copy(), truth, region, instances=instances)
    return replace(frame, **changes)


def own_size(name):
    return replace(PROTOCOLS[name], size=None)


def offset(frame, inside=0.02, outside=0.005):
    return (np.where(frame.depth_gt > 0, frame.depth_gt, 0.8) + np.where(frame.region, inside, outside)).astype(
        np.float32
    )


def test_the_command_line_offers_every_protocol():
    assert tuple(PROTOCOLS) == command_line.evaluate.PROTOCOLS and PROTOCOLS["cleargrasp"] is CLEARGRASP
    args = command_line.parser().parse_args(["evaluate", "--protocol", "dfnet"])
    assert args.protocol == "dfnet"
    with pytest.raises(ValueError, match="invalid choice"):
        command_line.parser().parse_args(["evaluate", "--protocol", "nobody"])


@pytest.mark.parametrize("name", PROTOCOLS)
def test_only_the_reported_sets_are_scored_and_a_perfect_map_is_perfect(name):
    frame, protocol = sample(), PROTOCOLS[name]
    scores = protocol.score(offset(frame, 0, 0), frame)
    assert tuple(scores) == metrics.SETS and {k for k, v in scores.items() if v} == set(protocol.sets)
    for key in protocol.sets:
        assert scores[key]["rmse"] < 1e-6 and scores[key]["d105"] == 100
    assert "inf" not in protocol.describe() and all(protocol.label(key) for key in protocol.sets)


DESCRIBED = {
    "cleargrasp": "region; 256 x 144; input 0.1 to 1.5 m, clipped",
    "lidf": "region; 256 x 144",
    "transparenet": "region; 256 x 144; truth beyond 0.01 m; REL is a median; mae, d105, d110, d125 pooled",
    "dfnet": "region and whole; 320 x 240; input 0.3 to 1.5 m; truth 0.3 to 1.5 m; empty counts as perfect",
    "swindrnet": "instances and background; 224 x 126",
    "d3roma": "whole; own size; truth 0.2 to 2 m",
    "marigold": "whole; own size; scale and shift fitted",
}


def test_every_protocol_is_as_its_code_has_it():
    assert {name: protocol.describe() for name, protocol in PROTOCOLS.items()} == DESCRIBED


@pytest.mark.parametrize(
    ("name", "height", "width"),
    [
        ("cleargrasp", 144, 256),
        ("lidf", 144, 256),
        ("transparenet", 144, 256),
        ("dfnet", 240, 320),
        ("swindrnet", 126, 224),
        ("d3roma", *SHAPE),
        ("marigold", *SHAPE),
    ],
)
def test_the_size_decides_how_many_pixels_there_are(name, height, width):
    truth = np.zeros(SHAPE, np.float32)
    truth[12] = 0.8  # one row, so that height and width count apart
    protocol = replace(PROTOCOLS[name], sets=("whole",))
    scores = protocol.score(np.full(SHAPE, 0.8, np.float32), sample(depth_gt=truth))
    rows = int((np.arange(height) * SHAPE[0] // height == 12).sum())
    assert scores["whole"]["n"] == rows * width


def test_what_is_pooled_is_averaged_over_pixels_and_the_rest_over_images():
    few, many = (dict.fromkeys(metrics.METRICS, value) | {"n": n} for value, n in ((1.0, 1), (5.0, 3)))
    results = [dict.fromkeys(metrics.SETS) | {"optical": scores} for scores in (few, many)]
    row = PROTOCOLS["transparenet"].average(results)["optical"]
    assert {m: row[m] for m in metrics.METRICS} == {"rmse": 3, "mae": 4, "rel": 3, "d105": 4, "d110": 4, "d125": 4}
    assert PROTOCOLS["lidf"].average(results)["optical"]["d110"] == 3


def test_resizing_is_by_nearest_neighbour():
    half = Protocol("half", ("optical",), (2, 2), near_m=0.1, far_m=1.5)
    truth = np.array([[1, 9, 1, 9], [9, 9, 9, 9], [0, 9, 1, 9], [9, 9, 9, 9]], np.float32)
    region = np.array([[1, 0, 0, 0], [0, 0, 0, 0], [1, 0, 1, 0], [0, 0, 0, 0]], bool)
    scores = half.score(np.full((4, 4), 1.25, np.float32), sample(depth_gt=truth, region=region, instances=None))
    assert scores["optical"]["n"] == 2 and scores["optical"]["rmse"] == 0.25
    assert scores["optical"]["d125"] == 0  # strict: 1.25 is not below 1.25


def test_cleaning_the_input():
    depth = np.array([[0.05, 0.2, 1.0, 2.0]], np.float32)
    np.testing.assert_array_equal(CLEARGRASP.prepare(depth), np.array([[0, 0.2, 1.0, 1.5]], np.float32))  # clipped
    np.testing.assert_array_equal(PROTOCOLS["dfnet"].prepare(depth), np.array([[0, 0, 1.0, 0]], np.float32))  # dropped
    np.testing.assert_array_equal(PROTOCOLS["marigold"].prepare(depth), depth)
    assert CLEARGRASP.prepare(depth).dtype == np.float32


def test_truth_out_of_range_is_not_scored():
    frame = sample(far=2.5)
    assert own_size("dfnet").score(offset(frame), frame)["whole"]["n"] == 22 * 32
    assert own_size("d3roma").score(offset(frame), frame)["whole"]["n"] == 22 * 32
    assert own_size("marigold").score(offset(frame), frame)["whole"]["n"] == 23 * 32


def test_instances_and_background():
    frame = sample()
    scores = own_size("swindrnet").score(offset(frame), frame)
    assert scores["optical"]["n"] == 12 * 32 and scores["outside"]["n"] == 11 * 32
    assert scores["optical"]["mae"] == pytest.approx((8 * 0.02 + 4 * 0.005) / 12, abs=1e-6)
    assert PROTOCOLS["swindrnet"].label("optical") == "instances" and CLEARGRASP.label("optical") == "region"
    without = own_size("swindrnet").score(offset(frame), replace(frame, instances=None))
    assert without["optical"]["n"] == 8 * 32  # all that is known is the region


def test_the_median_of_rel_hides_a_bad_minority():
    frame = sample()
    pred = offset(frame)
    pred[0] += 1.0  # one row in eight
    mean, median = (own_size(n).score(pred, frame)["optical"] for n in ("cleargrasp", "transparenet"))
    assert median["rel"] == pytest.approx(0.02 / 0.8, abs=1e-6) and mean["rel"] > 5 * median["rel"]
    assert median["rmse"] == mean["rmse"]


def test_pooling_one_column_can_turn_the_order_of_rmse_and_mae():
    small, large = sample(region_rows=1), sample(region_rows=15)
    protocol = own_size("transparenet")
    results = [protocol.score(offset(small, 0.01), small), protocol.score(offset(large, 0.05), large)]
    row = protocol.average(results)["optical"]
    assert row["rmse"] == pytest.approx(0.03, abs=1e-6) and row["mae"] == pytest.approx(0.0475, abs=1e-6)
    assert [f.test for f in audit.audit_table({"x": row})] == ["rmse >= mae"]
    assert audit.audit_table({"x": own_size("lidf").average(results)["optical"]}) == []


def test_an_empty_region_counts_as_perfect_or_not_at_all():
    empty, full = sample(region_rows=0), sample()
    for name, shares in {"dfnet": 2, "cleargrasp": 1}.items():
        protocol = own_size(name)
        row = protocol.average([protocol.score(offset(frame, 0.2), frame) for frame in (empty, full)])["optical"]
        assert row["images"] == shares and row["d110"] == 100 * (shares - 1) / shares
        assert row["pooled"]["mae"] == pytest.approx(0.2, abs=1e-6)  # no pixels, no weight
    protocol = own_size("dfnet")
    assert protocol.average([protocol.score(offset(empty), empty)])["optical"]["pooled"]["mae"] == 0
    unknown = replace(full, region=None, instances=None)
    assert protocol.score(offset(full), unknown)["optical"] is None  # unknown is not empty


@settings(deadline=None, max_examples=30)
@given(st.floats(0.3, 3), st.floats(-0.2, 0.5))
def test_alignment_forgives_any_scale_and_shift(scale, shift):
    frame = sample(depth_gt=np.tile(np.linspace(0.5, 1.5, 32, dtype=np.float32), (24, 1)))
    pred = (scale * frame.depth_gt + shift + 0.1).astype(np.float32)
    assert own_size("marigold").score(np.maximum(pred, 0.01), frame)["whole"]["rmse"] < 0.02 or pred.min() < 0.01
    assert own_size("marigold").score(frame.depth_gt, frame)["whole"]["rmse"] < 1e-5


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000))
def test_alignment_never_raises_the_squared_error(seed):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(1.0, 2.0, SHAPE).astype(np.float32)
    pred = rng.uniform(1.0, 2.0, SHAPE).astype(np.float32)
    assert metrics.rmse(protocols.fitted(pred, truth), truth) <= metrics.rmse(pred, truth) + 1e-6
    np.testing.assert_array_equal(protocols.fitted(pred, np.zeros_like(truth)), pred)  # nothing to fit to


@pytest.mark.parametrize(
    "bad",
    [
        {"sets": ("glass",)},
        {"sets": ()},
        {"sets": ("whole",), "pooled": ("rmsle",)},
        {"sets": ("whole",), "foreground": "x"},
    ],
)
def test_a_protocol_with_unknown_names_is_refused(bad):
    with pytest.raises(ValueError, match="expected sets of"):
        Protocol("bad", **bad)
