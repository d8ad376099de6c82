import math

import numpy as np
import pytest
import torch

from ditr_lite import store
from ditr_lite.boundary import ExactBoundary, boundaries_from_labels, depth_boundaries, get_backend, true_maps
from ditr_lite.boundary.learned import build_nets
from ditr_lite.config import preset
from ditr_lite.data import TRANSPARENT, Sample, list_samples, load_sample
from ditr_lite.evaluation import boundary as boundary_scoring
from ditr_lite.evaluation.boundary import bench, canny, format_scores, score_backends, summarise, tune_canny


@pytest.fixture(scope="module")
def frames():
    return [load_sample(name) for name in list_samples("val")[:3]]


def test_truth_is_outlines_and_those_with_a_jump(frames):
    outline, jumps = true_maps(frames[0])
    assert np.array_equal(outline, boundaries_from_labels(frames[0].instances))
    assert np.array_equal(jumps, depth_boundaries(frames[0].instances, frames[0].depth_gt, 0.01))
    assert 0 < jumps.sum() < outline.sum()
    with pytest.raises(ValueError, match="rendered scenes"):
        true_maps(Sample("real", frames[0].rgb, frames[0].depth))


def test_a_perfect_backend_scores_one_and_none_scores_nothing(frames):
    frame = frames[0]
    exact = ExactBoundary(frame.instances, frame.depth_gt)
    scores = score_backends([frame], {"exact": exact, "none": get_backend("none")}, dict(sigma=1, high=90, ratio=0.3))
    for m in ("m_rgb", "m_d", "m_da"):
        precision, recall, f, glass = scores[m]["exact"][frame.name]
        assert recall == 1 and (m == "m_da" or (precision, f) == (1, 1))  # M_DA: within two pixels of a jump
        assert glass in (1, None) and (glass is None) == (not (true_maps(frame)[1] & (frame.material == 1)).any())
        assert scores[m]["none"][frame.name][:3] == [None, 0, 0]
    assert set(scores["m_rgb"]) == {"exact", "none", "canny"} and "canny" not in scores["m_d"]


def test_recall_on_glass_counts_glass_only():
    instances, gt = np.zeros((20, 30), np.uint8), np.ones((20, 30), np.float32)
    instances[4:12, 3:12], instances[4:12, 17:26] = 1, 2
    gt[instances > 0] = 0.8
    material = np.where(instances == 2, TRANSPARENT, 0).astype(np.uint8)
    frame = Sample(
        "made", np.zeros((20, 30, 3), np.uint8), gt, gt, material > 0, material=material, instances=instances
    )
    half = boundaries_from_labels(np.where(instances == 1, 1, 0))
    row = score_backends([frame], {"half": lambda image: half}, dict(sigma=0, high=90, ratio=0.3))["m_rgb"]["half"][
        "made"
    ]
    assert row == [1.0, 0.5, pytest.approx(2 / 3, abs=1e-4), 0.0]


def test_canny_is_opencvs_and_is_tuned_to_the_best_of_its_grid(frames, monkeypatch):
    grid = {"sigma": (1.0, 3.0), "high": (30, 120), "ratio": (0.5,)}
    monkeypatch.setattr(boundary_scoring, "CANNY", grid)
    best = tune_canny(frames)

    def mean_f(**settings):
        scores = score_backends(frames, {}, settings)
        return np.mean([row[2] for row in scores["m_rgb"]["canny"].values()])

    others = {(s, h): mean_f(sigma=s, high=h, ratio=0.5) for s in grid["sigma"] for h in grid["high"]}
    assert others[best["sigma"], best["high"]] == max(others.values()) > min(others.values())
    found = canny(frames[0].rgb, **best)
    assert found.dtype == bool and found.shape == frames[0].depth.shape
    assert canny(frames[0].rgb, 1.0, 30, 0.5).sum() > canny(frames[0].rgb, 1.0, 250, 0.5).sum()


def test_summary_by_hand():
    rows = {"a": [1.0, 0.5, 0.6, None], "b": [None, 0.0, 0.0, 0.0]}
    best = {"a": [1.0, 1.0, 0.9, None], "b": [0.5, 0.5, 0.5, 0.2]}
    table = summarise({"m_rgb": {"classical": rows, "learned": best}})["m_rgb"]
    assert table["classical"]["precision"][0] == 1 and table["classical"]["f"][0] == pytest.approx(0.3)
    assert table["classical"]["f_gain"] == pytest.approx([0.4, 0.3, 0.5])
    assert table["classical"]["glass_recall"] == [0, 0, 0] and "f_gain" not in table["learned"]
    text = format_scores({"m_rgb": table})
    assert "+0.400 [+0.300, +0.500]" in text and len(text.splitlines()) == 3


def test_bench_keeps_every_frames_f(frames, tmp_path, monkeypatch):
    monkeypatch.setattr(boundary_scoring, "CANNY", {"sigma": (1.0,), "high": (90,), "ratio": (0.3,)})
    state = build_nets().state_dict() | {"thresholds": torch.tensor([0.3, 0.3])}
    store.save_part("boundary", state, preset("tiny"), tmp_path, {})
    results = bench(frames[:2], frames[2:], weights=tmp_path)
    assert results["canny"]["high"] == 90
    assert list(results["f"]["m_rgb"]) == ["classical", "learned", "canny"]
    mean = results["summary"]["m_rgb"]["classical"]["f"][0]
    assert mean == pytest.approx(np.mean(list(results["f"]["m_rgb"]["classical"].values())), abs=1e-3)
    assert all(math.isfinite(v) for v in results["f"]["m_da"]["classical"].values())
    with pytest.raises(ValueError, match="no SAM checkpoint"):
        bench(frames[:1], frames[2:], weights=tmp_path, sam=tmp_path)
