import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ditr_lite import baselines, datasets, metrics, pipeline, store
from ditr_lite.config import override, preset
from ditr_lite.data import Sample
from ditr_lite.evaluation import scoring, stage_one
from ditr_lite.evaluation.protocols import CLEARGRASP, PROTOCOLS
from ditr_lite.evaluation.scoring import format_report, run_methods, summary, to_json
from ditr_lite.pipeline import Completion

REAL = Path(__file__).resolve().parents[3] / "shared" / "real"
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="no real frames beside the repository")
SHAPE = (64, 96)


def make_sample(name="a", seed=0):
    """A tilted plane at about 0.6 m with a box-shaped region that reads 3 cm too far, half of it not at all."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 255, (*SHAPE, 3), np.uint8)
    truth = np.tile(np.linspace(0.5, 0.7, SHAPE[1], dtype=np.float32), (SHAPE[0], 1))
    region = np.zeros(SHAPE, bool)
    region[20:36, 30:50] = True
    depth = truth + np.float32(0.03) * region
    depth[20:28, 30:50] = 0  # inside
    depth[50:54, 10:20] = 0  # outside: a geometric hole
    truth = truth.copy()
    truth[0] = 0
    return Sample(name, rgb, depth, truth, region)


class FakeDitr:
    """Finds the true region grown by two columns, adds a known error where it paints, and counts its calls."""

    config = preset("tiny")

    def __init__(self, error_m=0.01, spoil=False):
        self.error_m, self.spoil, self.calls = error_m, spoil, []

    def refine(self, mask):
        return pipeline.Ditr.refine(self, mask)

    def __call__(self, rgb, depth, region, steps, samples):
        self.calls.append((depth.copy(), region, steps, samples))
        probability = None
        if region is None:
            region = np.zeros(SHAPE, bool)
            region[20:36, 30:52] = True
            probability = region.astype(np.float32)
        painted = np.tile(np.linspace(0.5, 0.7, SHAPE[1], dtype=np.float32), (SHAPE[0], 1)) + np.float32(self.error_m)
        out = pipeline.compose(depth, painted, painted, region)
        if self.spoil:
            out[60, 60] = np.nextafter(out[60, 60], np.float32(1))
        maps = {key: region for key in ("boundary_rgb", "boundary_depth", "boundary_da")}
        branches = {"optical": painted, "geometric": painted, "windows": ()}
        return Completion(out, region, 0 * out, **maps, probability=probability, **branches)


@pytest.fixture(scope="module")
def partly(tiny):
    """The same system, which untrained claims every pixel, with a threshold above which it claims half of a frame."""
    sample = make_sample()
    median = float(np.median(tiny.find_region(sample.rgb, sample.depth)[0]))
    settings = {"refine.threshold": median, "refine.median": 0, "refine.dilate": 0}
    return pipeline.Ditr(tiny.parts, override(tiny.config, **settings))


def test_every_method_gets_the_region_and_composition_of_ditr():
    seen = []

    def method(rgb, depth, region):
        seen.append(region)
        return np.full(depth.shape, 9, np.float32)

    sample, ditr = make_sample(), FakeDitr()
    (result,) = run_methods([sample], ditr, {"mine": method}, progress=False)
    assert len(ditr.calls) == 1 and ditr.calls[0][1] is None
    assert seen[0][:, 50:52].any() and not sample.region[:, 50:52].any()  # the predicted region, not the true one
    scores = result["methods"]["mine"]
    filled = sample.region | seen[0] | (sample.depth == 0)
    expected = metrics.evaluate(
        np.where(filled, np.float32(9), sample.depth), sample.depth_gt, sample.region, sample.depth
    )
    assert scores == expected
    assert np.isclose(result["methods"]["ditr"]["optical"]["rmse"], 0.01, atol=1e-6)
    assert np.isclose(result["methods"]["sensor"]["optical_valid"]["rmse"], 0.03, atol=1e-6)
    assert result["methods"]["sensor"]["whole"]["n"] == ((sample.depth > 0) & (sample.depth_gt > 0)).sum()
    assert result["methods"]["sensor"]["geometric"] is None


def test_all_baselines_are_run_by_default_and_options_reach_ditr():
    ditr = FakeDitr()
    (result,) = run_methods([make_sample()], ditr, given_region=True, steps=3, samples_per_frame=5, progress=False)
    assert set(result["methods"]) == {"ditr", "sensor", *baselines.REGISTRY}
    assert (ditr.calls[0][1] == make_sample().region).all() and ditr.calls[0][2:] == (3, 5)
    assert result["stage_one"] is None  # nothing was found, so there is nothing to score


@pytest.mark.parametrize("name", ["ditr", "sensor"])
def test_no_method_takes_the_row_of_another(name):
    ditr = FakeDitr()
    with pytest.raises(ValueError, match=f"cannot be called '{name}'"):
        run_methods([make_sample()], ditr, {name: baselines.raw}, progress=False)
    assert not ditr.calls


def test_stage_one_figures():
    (result,) = run_methods([make_sample()], FakeDitr(), {}, progress=False)
    found = result["stage_one"]
    assert np.isclose(found["iou"], 20 / 22) and found["miss_rate"] == 0
    refined = FakeDitr().refine(make_sample().region)
    assert np.isclose(found["area_ratio"], 16 * 22 / refined.sum()) and refined.sum() > 16 * 20


def test_classes_are_scored_where_materials_are_known(tiny):
    sample = make_sample()
    glass = replace(sample, material=sample.region.astype(np.uint8))
    results = run_methods([sample, glass], tiny, {}, steps=1, samples_per_frame=1, progress=False)
    assert set(results[0]["stage_one"]) == set(stage_one.STAGE_ONE)
    found = stage_one.class_map(tiny, glass.rgb, glass.depth)
    scores = stage_one.class_scores(found, glass.material)
    assert {k: results[1]["stage_one"][k] for k in scores} == scores
    report = summary(results)
    assert report["stage_one"]["recall_transparent"] == [scores["recall_transparent"]] * 3
    assert report["stage_one"]["iou_reflective"] is None  # there was none
    text = format_report(report)
    assert "recall_transparent" in text and "iou_reflective" not in text
    assert "transparent" not in format_report(summary(results[:1]))


def test_a_reading_that_changed_by_one_bit_is_noticed():
    good, bad = (run_methods([make_sample()], FakeDitr(spoil=spoil), {}, progress=False) for spoil in (False, True))
    assert good[0]["kept"] and not bad[0]["kept"]
    assert "bit for bit" in format_report(summary(good)) and "CHANGED" in format_report(summary(bad))
    assert not summary(good + bad)["kept"] and "CHANGED" in format_report(summary(bad + good))


def test_a_reading_that_is_no_number_counts_as_missing():
    odd, missing = make_sample(), make_sample()
    odd.depth[40:44, 60:70], odd.depth[5, 5:8], missing.depth[40:44, 60:70], missing.depth[5, 5:8] = np.nan, -1, 0, 0
    ditr = FakeDitr()
    results = run_methods([odd, missing], ditr, progress=False)
    assert results[0] == results[1] and results[0]["kept"]
    assert np.array_equal(ditr.calls[0][0], missing.depth)


def test_refusals_are_counted_and_do_not_stop_the_run():
    class Everywhere(FakeDitr):
        def __call__(self, rgb, depth, region, steps, samples):
            return super().__call__(rgb, depth, np.ones(SHAPE, bool), steps, samples)

    empty = make_sample("empty")
    empty.depth[:] = 0
    results = run_methods([make_sample("a"), empty], Everywhere(), progress=False)
    report = summary(results)
    assert results[0]["methods"]["nearest"] is None and results[0]["methods"]["raw"] is not None
    assert results[1]["methods"] == dict.fromkeys(results[1]["methods"])
    assert report["methods"]["nearest"] is None and report["methods"]["raw"]["whole"]["images"] == 1
    assert report["differences"]["nearest"]["optical"] is None
    assert (
        report["refused"]["ditr"] == {"no reading in the frame": 1} and sum(report["refused"]["nearest"].values()) == 2
    )
    assert "nearest refused 1 of 2 frames: no reading outside the region" in format_report(report)
    json.dumps(report, allow_nan=False)


def test_a_method_that_returns_no_depth_map_is_refused_by_name():
    (result,) = run_methods([make_sample()], FakeDitr(), {"mine": lambda rgb, d, r: d[:4]}, progress=False)
    assert result["methods"]["mine"] is None and "mine should have shape" in result["refused"]["mine"]


def test_missing_truth_or_region_is_named():
    bare = Sample("bare", make_sample().rgb, make_sample().depth)
    with pytest.raises(ValueError, match="bare has no ground-truth depth"):
        run_methods([bare], FakeDitr(), progress=False)
    bare = Sample("bare", make_sample().rgb, make_sample().depth, make_sample().depth_gt)
    with pytest.raises(ValueError, match="bare has no true region"):
        run_methods([bare], FakeDitr(), given_region=True, progress=False)
    (result,) = run_methods([bare], FakeDitr(), {}, progress=False)
    assert result["methods"]["ditr"]["optical"] is None and result["stage_one"] is None
    with pytest.raises(ValueError, match="no results"):
        summary([])


def test_summary_averages_images_and_pairs_differences():
    results = [
        run_methods([make_sample(str(k))], FakeDitr(0.01 * k), {"raw": baselines.raw}, progress=False)[0]
        for k in (1, 2, 3)
    ]
    report = summary(results)
    assert np.isclose(report["methods"]["ditr"]["optical"]["rmse"], 0.02, atol=1e-6)
    assert np.isclose(report["methods"]["ditr"]["optical"]["pooled"]["rmse"], 0.01 * np.sqrt(14 / 3), atol=1e-6)
    mean, low, high = report["differences"]["raw"]["optical_valid"]
    assert np.isclose(mean, 0.02 - 0.03, atol=1e-6) and low <= mean <= high
    assert np.isclose(low, -0.02, atol=1e-6) and np.isclose(high, 0, atol=1e-6)
    assert report["stage_one"]["iou"][0] == pytest.approx(20 / 22)
    means, pooled = (block.splitlines() for block in format_report(report).split("Pooled over all pixels instead"))
    column = 1 + metrics.SETS.index("optical")
    (row,) = (line.split() for line in pooled[2:5] if line.startswith("ditr"))
    assert row[column] == f"{10 * np.sqrt(14 / 3):.1f}" == "21.6"
    assert any(line.split()[:2] == ["ditr", "20.0"] for line in means)


def test_the_sensor_is_compared_where_it_read_something_only():
    report = summary(run_methods([make_sample()], FakeDitr(), {}, progress=False))
    minus = report["differences"]["sensor"]
    assert minus["optical_valid"][0] == pytest.approx(0.01 - 0.03, abs=1e-6)
    assert minus["optical"] is minus["geometric"] is None  # there DITR is scored on other pixels, too


def test_cleargrasp_protocol_cleans_the_input_and_scores_the_region_at_its_size():
    sample, ditr = make_sample(), FakeDitr()
    (result,) = run_methods([sample], ditr, {}, progress=False, protocol=CLEARGRASP)
    assert len(ditr.calls) == 1  # the input needs no cleaning, so nothing runs twice
    assert np.isclose(result["protocol"]["ditr"]["optical"]["rmse"], 0.01, atol=1e-6)
    sample.depth[2, 2], sample.depth[2, 3] = 0.05, 2.0
    (result,) = run_methods([sample], ditr, {}, progress=False, protocol=CLEARGRASP)
    assert len(ditr.calls) == 3 and ditr.calls[2][0][2, 2] == 0 and ditr.calls[2][0][2, 3] == 1.5
    assert [region for _, region, *_ in ditr.calls] == [None] * 3
    assert (
        result["kept"] and result["methods"]["ditr"]["whole"]["rmse"] > 0.01
    )  # our own tables take the frame as it is
    assert "As ClearGrasp's code scores" in format_report(summary([result]), CLEARGRASP)


def test_a_frame_that_a_protocol_leaves_without_a_reading_is_counted():
    near = make_sample()
    near.depth[:] = np.where(near.depth > 0, 0.05, 0)  # ClearGrasp's code drops what is nearer than 10 cm
    results = run_methods([make_sample("b"), near], FakeDitr(), {}, progress=False, protocol=CLEARGRASP)
    text = format_report(summary(results, CLEARGRASP), CLEARGRASP)
    assert "ditr refused 1 frames as that code feeds them: no reading in the frame" in text
    assert "ditr refused 1 of" not in text


def test_pooled_columns_of_a_protocol_reach_the_report_and_the_json(tmp_path):
    small, large = make_sample("a"), make_sample("b")
    small.region[24:] = False
    results = run_methods([small, large], FakeDitr(), {}, True, progress=False, protocol=PROTOCOLS["transparenet"])
    rows = [r["protocol"]["ditr"] for r in results]
    for row, metric in zip(rows, (0.01, 0.03), strict=True):
        row["optical"]["mae"] = metric
    n = [row["optical"]["n"] for row in rows]
    pooled = (0.01 * n[0] + 0.03 * n[1]) / sum(n)
    store.save_part("region", pipeline.build(preset("tiny"))["region"].state_dict(), preset("tiny"), tmp_path, {})
    values = to_json(results, "c", tmp_path, PROTOCOLS["transparenet"])
    assert np.isclose(values["summary"]["protocol"]["ditr"]["optical"]["mae"], pooled) and not np.isclose(pooled, 0.02)
    text = format_report(summary(results, PROTOCOLS["transparenet"]), PROTOCOLS["transparenet"])
    assert "As TranspareNet's code scores: region; 256 x 144" in text and f"{1000 * pooled:.1f}" in text


def test_json_holds_checksums_command_and_every_frame(tmp_path):
    config = preset("tiny")
    store.save_part("region", pipeline.build(config)["region"].state_dict(), config, tmp_path, {})
    results = run_methods([make_sample("a"), make_sample("b")], FakeDitr(), progress=False)
    values = json.loads(json.dumps(to_json(results, "the command", tmp_path, split="test"), allow_nan=False))
    assert values["weights_sha256"] == {"region": store.sha256(tmp_path / "region.safetensors")}
    assert values["command"] == "the command" and values["split"] == "test"
    assert list(values["rmse_m"]) == ["a", "b"]
    mean = np.mean([frame["ditr"]["optical"] for frame in values["rmse_m"].values()])
    assert np.isclose(mean, values["summary"]["methods"]["ditr"]["optical"]["rmse"], atol=1e-6)
    missed = np.mean([frame["miss_rate"] for frame in values["stage_one"].values()])
    assert list(values["stage_one"]) == ["a", "b"]
    assert np.isclose(missed, values["summary"]["stage_one"]["miss_rate"][0], atol=1e-6)


def test_the_real_system_keeps_what_it_must(partly):
    (result,) = run_methods([make_sample()], partly, {}, steps=1, samples_per_frame=1, progress=False)
    assert result["kept"] and result["methods"]["ditr"]["whole"]["n"] == (SHAPE[0] - 1) * SHAPE[1]
    sample = make_sample()
    out, adjusted = (partly(sample.rgb, sample.depth, steps=1, samples=1, adjust=a) for a in (False, True))
    assert 0.3 < out.region.mean() < 0.7 and np.array_equal(out.region, adjusted.region)
    assert scoring.kept_bit_for_bit(out, sample.depth) and not scoring.kept_bit_for_bit(adjusted, sample.depth)


def test_readings_too_sparse_to_survive_resizing_do_not_stop_it(tiny):
    depth = np.zeros((256, 384), np.float32)
    depth[3, 5] = 0.6  # nearest neighbour at a quarter of the size takes other pixels
    out = tiny(np.zeros((256, 384, 3), np.uint8), depth, np.zeros(depth.shape, bool), steps=1, samples=1)
    assert out.depth[3, 5] == np.float32(0.6) and np.isfinite(out.depth).all() and (out.depth > 0).all()


@needs_real
def test_real_cleargrasp_frame(tiny):
    frames = datasets.ClearGrasp(REAL / "cleargrasp_d435")
    methods = {name: baselines.REGISTRY[name] for name in ("raw", "nearest")}
    results = run_methods(
        [frames["000000123"]],
        tiny,
        methods,
        given_region=True,
        steps=1,
        samples_per_frame=1,
        progress=False,
        protocol=CLEARGRASP,
    )
    raw = results[0]["methods"]["sensor"]["optical_valid"]
    assert np.isclose(raw["mae"], 0.016, atol=1e-3) and results[0]["kept"]
    assert results[0]["protocol"]["raw"]["optical"]["n"] < results[0]["methods"]["raw"]["optical"]["n"] / 20


@needs_real
def test_real_cleargrasp_frames_have_one_class(tiny):
    frame = datasets.ClearGrasp(REAL / "cleargrasp_d435")["000000123"]
    (result,) = run_methods([frame], tiny, {}, steps=1, samples_per_frame=1, progress=False)
    assert 0 <= result["stage_one"]["recall_transparent"] <= 1 and result["stage_one"]["iou_reflective"] is None


def test_methods_are_ranked_by_their_error_on_one_pixel_set():
    rows = {"ditr": {"optical": {"rmse": 0.02}}, "raw": {"optical": {"rmse": 0.01}}, "nearest": {"optical": None}}
    rows |= {"sensor": {"optical": {"rmse": 0.001}}, "refused": {}}
    assert scoring.ranked(rows, "optical") == ["raw", "ditr"]
