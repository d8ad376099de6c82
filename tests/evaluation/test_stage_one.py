import numpy as np
import pytest

from ditr_lite import pipeline
from ditr_lite.data import Sample
from ditr_lite.evaluation.stage_one import PER_CLASS, class_map, class_scores, mask_errors, score_stage_one

SHAPE = (64, 96)


def test_class_map_merges_to_the_region_that_the_pipeline_finds(tiny):
    rng = np.random.default_rng(0)
    rgb, depth = np.zeros((*SHAPE, 3), np.uint8), rng.uniform(0.4, 0.9, SHAPE).astype(np.float32)
    found = class_map(tiny, rgb, depth)
    assert found.shape == SHAPE and found.dtype == np.uint8 and set(np.unique(found)) <= {0, 1, 2}
    out = tiny(rgb, depth, steps=1, samples=1)
    np.testing.assert_array_equal(found > 0, out.probability > 0.5)


def test_class_map_comes_back_to_the_size_of_the_frame(tiny):
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (50, 120, 3), np.uint8)
    assert class_map(tiny, rgb, rng.uniform(0.4, 0.9, (50, 120)).astype(np.float32)).shape == (50, 120)


def test_class_scores_of_a_frame_that_can_be_counted():
    material = np.zeros((4, 10), np.uint8)
    material[0], material[1] = 1, 2
    found = np.zeros_like(material)
    found[0, :6], found[0, 6:8], found[1, :5], found[2, 0] = 1, 2, 2, 1
    scores = class_scores(found, material)
    assert scores["iou_transparent"] == pytest.approx(6 / 11)  # one false alarm
    assert scores["iou_reflective"] == pytest.approx(5 / 12)  # two pixels of glass are called mirrors
    assert scores["recall_transparent"] == pytest.approx(0.8)  # which costs their recall nothing
    assert scores["recall_reflective"] == pytest.approx(0.5)
    assert tuple(scores) == PER_CLASS
    only_glass = class_scores(found, np.where(material == 1, material, 0))
    assert only_glass["iou_reflective"] is None and only_glass["recall_reflective"] is None
    with pytest.raises(ValueError, match="should be alike"):
        class_scores(found, material.T)


def test_mask_errors():
    true = np.zeros(SHAPE, bool)
    true[20:40, 30:60] = True
    assert mask_errors(true, true) == {"miss_rate": 0.0, "area_ratio": 1.0}
    assert mask_errors(~true, true)["miss_rate"] == 1.0


def test_overlap_is_of_the_claim_and_the_other_two_of_the_refined_region(tiny):
    true = np.zeros(SHAPE, bool)
    true[20:40, 30:60] = True
    grown = np.zeros(SHAPE, bool)
    grown[10:50, 20:70] = True
    zero = np.zeros(SHAPE, np.float32)
    probability = np.where(true, 0.9, 0.1).astype(np.float32)
    out = pipeline.Completion(zero, grown, zero, ~true, ~true, ~true, probability, zero, zero, ())
    sample = Sample("test_00000", np.zeros((*SHAPE, 3), np.uint8), zero + 0.6, region=true)
    scores = score_stage_one(out, sample, tiny)
    assert scores["iou"] == 1.0 and scores["miss_rate"] == 0.0 and scores["area_ratio"] > 1.2
