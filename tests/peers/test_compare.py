import json

import numpy as np
import pytest

from ditr_lite.peers import compare, networks

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
    "regression, bare": 0.05,
    "regression": 0.045,
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
    return compare.summarise_peers(scores)


def test_ratios_and_changes_are_those_of_the_means(report):
    assert report["ratio"]["regression"]["optical"][0] == pytest.approx(40 / 45)
    assert report["ablation"]["0"]["+DP"]["optical"] == pytest.approx((0.75, 0.75, 0.75))  # paired: no spread is left
    assert report["ablation"]["1"]["+RR"]["whole"][0] == pytest.approx(44 / 46)
    mean, low, high = report["minus_ditr"]["true region"]["optical"]
    assert low < mean < high < 0


def test_every_idea_is_a_peer():
    assert set(compare.IDEAS) == {*networks.NAMES, "rgb_only_aligned"}


def test_errors_by_seed_leave_out_frames_without_such_pixels(report, scores):
    errors = compare.by_seed({**report, "rmse_m": scores}, "BB", "optical")
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
    optical, whole = compare.ratio_verdict(
        {**report, "ratio": {"regression": {"optical": ratio, "whole": (0.9, 0.7, 1.1)}}}
    ).splitlines()
    lies = "above" if ratio[2] < 0.73 else "below" if ratio[1] > 0.74 else "inside"
    assert said in optical and optical.endswith(f"Table V, optical) lies {lies} our interval")
    assert whole.startswith("DITR's whole error") and whole.endswith(
        "paper's 0.76 to DFNet (Table I, overall) lies inside our interval"
    )


def test_like_is_compared_with_like():
    assert {k: round(ratio, 2) for k, (ratio, _) in compare.PAPER.items()} == {"optical": 0.73, "whole": 0.76}


def test_tables_name_every_row_and_survive_json(report):
    again = json.loads(json.dumps(report))
    networks, ablation, oracles = (
        f(again) for f in (compare.format_peers, compare.format_ablation, compare.format_oracles)
    )
    assert (
        "regression, bare" in networks
        and compare.EQUAL in networks
        and "harmonic" in networks
        and "0.89 [0.89, 0.89]" in networks
    )
    assert ablation.count("seed 1") == 3 and ablation.count("-25 [-25, -25] %") == 2 and "IV: -33 %, -5 %" in ablation
    assert all(name in oracles for name in compare.ORACLES)


def test_a_study_needs_trained_arms(tmp_path):
    with pytest.raises(ValueError, match="no weights in"):
        compare.arm_system(tmp_path, "dp", 0)


def test_every_method_is_asked_about_every_frame():
    from ditr_lite.data import load_sample
    from ditr_lite.pipeline import Ditr

    ditr, sample = Ditr.from_pretrained(), load_sample("val_00000")
    rows = {"ditr": lambda s, out: out.depth, "truth": lambda s, out: np.where(s.depth_gt > 0, s.depth_gt, 1)}
    (found,) = compare.score_methods([sample], ditr, rows).values()
    assert set(found) == {"ditr", "truth"} and found["truth"]["optical"] == 0 < found["ditr"]["optical"]
