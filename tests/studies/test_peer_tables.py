import json

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from ditr_lite.data import load_sample
from ditr_lite.evaluation.statistics import paired_bootstrap
from ditr_lite.files import write_depth
from ditr_lite.peers import system
from ditr_lite.studies import peer_tables as compare
from ditr_lite.viz.tables import WIDTH

RNG = np.random.default_rng(0)
LEVELS = {  # method -> RMSE in metres about which its frames lie
    compare.SHIPPED: 0.030,
    compare.EQUAL: 0.040,
    "true region": 0.020,
    "no detail network": 0.035,
    "truth through the autoencoder": 0.010,
    "one sample": 0.031,
    "sixteen samples": 0.0299,
    "harmonic": 0.07,
    f"{compare.EQUAL}, seed 1": 0.041,
    "regression": 0.045,
    "regression, seed 1": 0.046,
    "equal time, true region": 0.035,
    "BB, seed 0": 0.060,
    "+DP, seed 0": 0.045,
    "+RR, seed 0": 0.044,
    "BB, seed 1": 0.062,
    "+DP, seed 1": 0.046,
    "+RR, seed 1": 0.044,
}


@pytest.fixture(scope="module")
def scores():
    frames = {}
    for i in range(20):
        hard = RNG.uniform(0.5, 1.5)
        frames[f"f{i}"] = {
            n: {k: None if k == "optical" and i == 3 else hard * v for k in compare.SETS} for n, v in LEVELS.items()
        }
    return frames


@pytest.fixture(scope="module")
def report(scores):
    return {**compare.summarise_peers(scores), "rmse_m": scores}


def test_ratios_and_changes_are_those_of_the_means(report):
    assert report["ratio"]["regression"]["optical"][0] == pytest.approx(44 / 45)
    assert report["ablation"]["0"]["+DP"]["optical"] == pytest.approx((0.75, 0.75, 0.75))  # paired: no spread is left
    assert report["ablation"]["1"]["+RR"]["whole"][0] == pytest.approx(44 / 46)
    mean, low, high = report["minus_ditr"]["true region"]["optical"]
    assert low < mean < high < 0


def test_every_idea_is_a_peer():
    assert set(compare.IDEAS) == set(system.PEERS)


def test_errors_by_seed_leave_out_frames_without_such_pixels(report):
    errors = compare.by_seed(report, "BB", "optical")
    assert errors.shape == (2, 19) and np.allclose(errors[1] / errors[0], 62 / 60)


@pytest.mark.parametrize(
    ("ratio", "said"),
    [
        ((0.65, 0.60, 0.70), "smaller: 0.65 [0.60, 0.70] times that of regression; the paper's 0.73 to DFNet (Table V"),
        ((0.80, 0.70, 1.10), "not measurably different: 0.80 [0.70, 1.10] times that of regression"),
        ((0.80, 0.75, 0.90), "smaller: 0.80"),
        ((1.20, 1.10, 1.30), "larger: 1.20"),
    ],
)
def test_the_verdict_follows_the_interval(report, ratio, said):
    made = {**report, "ratio": {"regression": {"optical": ratio, "whole": (0.9, 0.7, 1.1)}}}
    optical, whole, holes = compare.ratio_verdict(made).splitlines()
    lies = "above" if ratio[2] < 0.73 else "below" if ratio[1] > 0.74 else "inside"
    assert said in optical and optical.endswith(f"Table V, optical) lies {lies} our interval")
    assert whole.startswith("+RR's whole error") and whole.endswith(
        "paper's 0.76 to DFNet (Table I, overall) lies inside our interval"
    )
    assert holes.startswith("In the holes none of 2 other methods has an error measurably smaller than +RR's")
    assert "the lowest is regression +" in holes


def test_the_papers_ratio_is_set_beside_that_of_its_own_system_alone(report, monkeypatch):
    ratios = {"optical": (0.9, 0.85, 0.95), "whole": (0.9, 0.85, 0.95)}
    best = {"optical": "rgb_only", "whole": "point_completion"}  # not the same one for every set of pixels
    monkeypatch.setattr(compare, "best_peer", lambda report, key: best[key])
    made = {**report, "ratio": dict.fromkeys(("regression", *best.values()), ratios)}
    *own, optical, whole, _ = compare.ratio_verdict(made).splitlines()
    flattered = ", the best of the peers at that on these very frames: chosen by them, it is flattered"
    assert len(own) == 2 and all("to DFNet" in line for line in own)
    assert optical.endswith(f"0.90 [0.85, 0.95] times that of rgb_only{flattered}")
    assert whole.endswith(f"0.90 [0.85, 0.95] times that of point_completion{flattered}")
    assert "paper" not in optical + whole


def test_the_best_of_many_equal_methods_is_not_called_better():
    rng, names = np.random.default_rng(0), (*compare.IDEAS, *compare.REGISTRY)
    plain, told = 0, 0
    for _ in range(40):
        rows = {n: 0.03 + 0.01 * rng.normal(size=32) for n in (*names, compare.PAPERS)}
        scores = {f: {n: dict.fromkeys(compare.SETS, row[f]) for n, row in rows.items()} for f in range(32)}
        mean = {n: {"geometric": [row.mean()]} for n, row in rows.items()}
        plain += any(paired_bootstrap(rows[n], rows[compare.PAPERS], n=200)[2] < 0 for n in names)
        told += f"holes none of {len(names)}" not in compare.holes_verdict({"mean": mean, "rmse_m": scores})
    assert plain > 10 and told <= 6


def test_what_fills_holes_better_is_named(report, scores):
    better = {f: {**row, "harmonic": {**row["harmonic"], "geometric": 0.01}} for f, row in scores.items()}
    *_, holes = compare.ratio_verdict({**report, "rmse_m": better}).splitlines()
    assert "In the holes 1 of 2 other methods has an error measurably smaller" in holes and "harmonic (a base" in holes


def test_like_is_compared_with_like():
    assert {k: round(ratio, 2) for k, (ratio, _) in compare.PAPER.items()} == {"optical": 0.73, "whole": 0.76}


def test_tables_name_every_row_and_survive_json(report):
    again = json.loads(json.dumps(report))
    makers = (compare.format_peers, compare.format_ablation, compare.format_oracles)
    peers, ablation, oracles = (make(again) for make in makers)
    assert compare.EQUAL in peers and "harmonic" in peers and "0.98 [0.98, 0.98]" in peers
    assert "regression, seed 1" in peers and f"{compare.EQUAL}, seed 1" in peers
    assert ablation.count("seed 1") == 3 and ablation.count("-25 [-25, -25] %") == 2 and "IV: -33 %, -5 %" in ablation
    assert all(name in oracles for name in (*compare.ORACLES, "equal time, true region"))
    everything = compare.format_study({"splits": {"test": again, "rooms": again}, "real": REAL})
    assert everything.count(peers) == 2 and "rooms split, 20 frames" in everything


REAL = {
    "bottle": {"ditr": {"optical": 0.01, "geometric": None}, "regression": {"optical": 0.02, "geometric": 0.03}},
    "desk": {"ditr": {"moved": 0.01}, "regression": {"moved": 0.05}},
    "glasses": {"ditr": {"moved": None}, "regression": {"moved": None}},
}


def test_real_frames_are_scored_by_truth_or_by_what_moved():
    head, ditr, regression = compare.format_real(REAL).splitlines()
    assert head.startswith("1 real frames with truth, 1 others")
    assert ditr.split() == ["ditr", "10.0", "-", "1.00"] and regression.split() == [
        "regression",
        "20.0",
        "30.0",
        "5.00",
    ]


def test_the_best_peer_is_a_peer(report):
    assert compare.best_peer(report) == "regression"
    assert compare.with_seeds(report["mean"], "regression") == ["regression", "regression, seed 1"]


def test_the_worst_frame_is_where_a_peer_loses_most_to_ditr(report, scores):
    worse = {f: {**row, "regression": {**row["regression"]}} for f, row in scores.items()}
    worse["f7"]["regression"]["optical"] = 9.0
    assert compare.failure_frames({**report, "rmse_m": worse}) == {"regression": "f7"}


def test_a_frame_stands_for_one_peer_only(report, scores):
    peers = ("regression", "adversarial")
    worse = {f: {**row, **{p: {**row["regression"]} for p in peers}} for f, row in scores.items()}
    for peer, second in zip(peers, (0.0, 8.0), strict=True):
        worse["f7"][peer]["optical"] = 9.0
        worse["f5"][peer]["optical"] += second
    mean = dict.fromkeys(peers, {})
    found = compare.failure_frames({"mean": mean, "rmse_m": worse})
    assert found == {"regression": "f7", "adversarial": "f5"}


def test_an_error_has_a_character():
    truth, region = np.full((20, 20), 0.5), np.zeros((20, 20), bool)
    region[4:16, 4:16] = True
    far = compare.error_character(truth + 0.03, truth, region)
    assert far["offset"] == pytest.approx(0.03) and far["shape"] == pytest.approx(0, abs=1e-9)
    at_the_rim = truth.copy()
    at_the_rim[4:6, 4:16] += 0.05
    rim = compare.error_character(at_the_rim, truth, region)
    assert rim["outline"] > rim["rmse"] > rim["offset"] > 0
    with pytest.raises(ValueError, match="no pixel of the region has a true depth"):
        compare.error_character(truth, 0 * truth, region)


def test_failures_are_told_in_words(tmp_path):
    sample = load_sample("val_00000")
    write_depth(tmp_path / "regression.png", np.where(sample.depth_gt > 0, sample.depth_gt, 1) + 0.1 * sample.region)
    failures = compare.read_failures({"failures": {"regression": "val_00000"}}, tmp_path)
    told = compare.format_failures(failures)
    assert "+100.0" in told and told.endswith("the glass is too far as a whole")
    near_outline = distance_transform_edt(sample.region) <= 3
    rough = sample.depth_gt + np.where(np.indices(near_outline.shape)[1] % 2, 0.1, -0.1) * near_outline
    told = compare.format_failures([("single_latent_diffusion", sample, rough)])
    assert told.endswith("its shape is wrong, above all its outline")
    assert max(map(len, told.splitlines())) <= WIDTH


def test_the_training_is_told_from_the_results():
    rows = [("ditr", 0, "ditr_optical-0", 80), ("ditr", 0, "ditr_detail-0", 40), ("ditr", 1, "ditr_optical-1", 118)]
    parts = {
        name: {"arm": arm, "seed": seed, "cpu_seconds": s} for arm, seed, name, s in (*rows, ("bb", 0, "bb-0", 120))
    }
    told = compare.format_training({"trained": parts, "settings": {"size": [96, 128]}}, (192, 256)).splitlines()
    assert told[0].startswith("2 arms, 2.0 to 2.0 minutes") and told[1].endswith(": ditr")
    assert (
        "33% of the time" in told[2]
        and told[3] == "working size 128 x 96 pixels; the shipped system works at 256 x 192"
    )
