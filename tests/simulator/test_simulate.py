import threading
import time
from concurrent.futures import Future
from dataclasses import replace
from multiprocessing import active_children

import numpy as np
import pytest

from ditr_lite.camera import Camera, shadow_width_px
from ditr_lite.cli.shared import MAX_SEED
from ditr_lite.data import OPAQUE, REFLECTIVE, TRANSPARENT, Sample, read_sample, save_sample
from ditr_lite.loss_types import Cause, LossType, label
from ditr_lite.simulator import simulate as simulator
from ditr_lite.simulator.scenes import Scene, Thing, look_at
from ditr_lite.simulator.simulate import simulate, simulate_many
from ditr_lite.simulator.stereo import Matcher

MATT = {"type": "matt", "texture": "noise", "texture_seed": 1, "roughness": 0.1, "infrared": 0.6}
MATT["colours"] = np.array([[0.3, 0.3, 0.3], [0.7, 0.7, 0.7]])
GLASS = {"type": "thin_glass", "ior": 1.5, "tint": np.ones(3), "infrared": 0.9}
MIRROR = {"type": "mirror", "metal": "Ag", "roughness": 0.1}
HEIGHT_M, THICK_M = 0.12, 0.004


@pytest.fixture(autouse=True)
def small_and_quick(monkeypatch):
    """A quarter of the pixels, few paths, and a sensor without dropouts."""
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(simulator, "SIZE", (96, 128))
    monkeypatch.setattr(simulator, "INFRARED_SIZE", (116, 200))
    monkeypatch.setattr(simulator, "RGB_PASSES", 1)
    monkeypatch.setattr(simulator, "RGB_SAMPLES", 1)
    monkeypatch.setattr(simulator, "INFRARED_SAMPLES", 4)
    monkeypatch.setattr(simulator.sensor, "random_matcher", lambda rng: Matcher(edge=0, holes=0))


def measure(monkeypatch, *things):
    """Simulate a hand-made scene seen from 0.6 m, looking down almost vertically."""
    eye = 0.6 * np.array([0, -np.cos(np.deg2rad(85)), np.sin(np.deg2rad(85))])
    light = {"at": np.array([0.3, -0.5, 1.5]), "size": 0.3, "power": np.full(3, 6.0)}
    scene = Scene(0, list(things), MATT, [], look_at(eye, np.zeros(3)), [light], 0.5)
    monkeypatch.setattr(simulator, "random_scene", lambda seed, split: scene)
    return simulate(0)


def sheet(kind, material, half=0.05):
    """Return a level plate whose upper side floats 12 cm above the table, under the optical axis."""
    pose = np.eye(4)
    pose[2, 3] = HEIGHT_M - THICK_M / 2
    return Thing("slab", kind, np.array([half, half, THICK_M / 2]), pose, material)


def inner(mask, margin=4):
    """Return the mask without a border of its bounding box."""
    v, u = np.nonzero(mask)
    out = np.zeros_like(mask)
    out[v.min() + margin : v.max() - margin, u.min() + margin : u.max() - margin] = True
    return out & mask


def test_the_same_seed_gives_the_same_sample():
    first, again, other = simulate(4, "test", True), simulate(4, "test", True), simulate(5, "test")
    for key in ("rgb", "depth", "depth_gt", "material", "instances", "loss", "cause", "ir_left", "ir_right"):
        assert np.array_equal(getattr(first, key), getattr(again, key)), key
    assert first.stereo == again.stereo and not np.array_equal(first.depth_gt, other.depth_gt)
    assert other.ir_left is None and first.name == "test_00004" and first.meta["split"] == "test"


@pytest.mark.parametrize("split", ["test", "rooms"])
def test_the_largest_seed_that_the_command_takes_is_rendered(split, small_rooms):
    assert simulate(MAX_SEED, split).name == f"{split}_{MAX_SEED}"


def test_labels_agree_with_each_other_and_with_the_depths():
    sample = simulate(4, "test")
    assert sample.rgb.shape == (96, 128, 3) and sample.rgb.dtype == np.uint8 and sample.depth.dtype == np.float32
    assert np.array_equal(sample.region, sample.material > OPAQUE)
    assert np.array_equal(sample.loss, label(sample.depth, sample.depth_gt, sample.region))
    kinds = np.array([OPAQUE] + [thing["kind"] for thing in sample.meta["things"]])
    assert np.array_equal(sample.material, kinds[sample.instances])
    lossless = np.isin(sample.loss, (LossType.OUTSIDE_FINE, LossType.INSIDE_FINE, LossType.UNKNOWN))
    assert np.array_equal(sample.cause == Cause.NONE, lossless)
    assert (sample.material[sample.cause == Cause.TRANSMISSION] == TRANSPARENT).all()
    assert (sample.material[sample.cause == Cause.REFLECTION] == REFLECTIVE).all()
    assert (sample.loss[sample.cause == Cause.MISMATCH] == LossType.OUTSIDE_WRONG).all()


def test_raw_depth_of_a_matt_table_is_the_truth_within_the_noise(monkeypatch):
    sample = measure(monkeypatch)
    both = (sample.depth > 0) & (sample.depth_gt > 0)
    error = (sample.depth - sample.depth_gt)[both]
    assert both.mean() > 0.85 and (sample.loss == LossType.OUTSIDE_FINE).mean() > 0.85
    assert abs(np.median(error)) < 0.002 and np.median(np.abs(error)) < 0.003  # 0.6 m away


def test_a_glass_sheet_reads_as_the_table_behind_it_or_not_at_all(monkeypatch):
    sample = measure(monkeypatch, sheet(TRANSPARENT, GLASS))
    core = inner(sample.region)
    assert core.sum() > 200 and np.abs(sample.depth_gt[core] - (0.6 - HEIGHT_M)).max() < 0.03
    assert (sample.loss[core] == LossType.INSIDE_FINE).mean() < 0.05
    readings = sample.depth[core & (sample.depth > 0)]
    assert readings.size > 50 and np.median(readings) == pytest.approx(0.6, abs=0.02)  # the table
    assert set(np.unique(sample.cause[core])) <= {Cause.TRANSMISSION, Cause.NONE}


def test_a_mirror_never_reads_as_its_own_surface(monkeypatch):
    sample = measure(monkeypatch, sheet(REFLECTIVE, MIRROR))
    core = inner(sample.region)
    assert (sample.loss[core] == LossType.INSIDE_FINE).mean() < 0.05
    assert (sample.cause[core] == Cause.REFLECTION).mean() > 0.95


def test_an_opaque_plate_reads_well_and_casts_both_shadows_of_parallax(monkeypatch):
    plate = sheet(OPAQUE, {**MATT, "texture_seed": 2}, half=0.03)
    sample = measure(monkeypatch, plate)
    core = inner(sample.instances == 1)
    assert (sample.loss[core] == LossType.OUTSIDE_FINE).mean() > 0.8
    centre = np.nonzero(core)[1].mean()
    from_left, from_right = (np.nonzero(sample.cause == c) for c in (Cause.PARALLAX, Cause.STEREO_OCCLUSION))
    # the RGB camera stands between the two: each infrared camera misses a strip on the far side of the plate
    assert from_left[1].size and (from_left[1] > centre).mean() > 0.9
    assert from_right[1].size and (from_right[1] < centre).mean() > 0.9
    offset = -sample.stereo.rgb_from_left[0][3]
    rows = np.bincount(from_left[0], minlength=96)[np.nonzero(core)[0].min() : np.nonzero(core)[0].max()]
    width = shadow_width_px(0.6 - HEIGHT_M, 0.6, offset, sample.camera.fx)
    assert width - 2.5 < np.median(rows) < width + 0.5  # visible_from forgives a pixel at either side


@pytest.fixture
def small_rooms(monkeypatch):
    pytest.importorskip("pyoidn")
    monkeypatch.setattr(simulator, "ROOM_SIZE", (72, 96))
    monkeypatch.setattr(simulator, "ROOM_SAMPLES", 2)


def test_a_room_scene_is_measured_labelled_and_noted_in_full(small_rooms):
    first, again = simulate(9, "rooms", True), simulate(9, "rooms", True)
    for key in ("rgb", "depth", "depth_gt", "material", "instances", "loss", "cause", "ir_left", "ir_right"):
        assert np.array_equal(getattr(first, key), getattr(again, key)), key
    assert first.name == "rooms_00009" and first.rgb.shape == (72, 96, 3)
    assert np.array_equal(first.loss, label(first.depth, first.depth_gt, first.region))
    noted = {
        "seed",
        "split",
        "place",
        "distance_m",
        "surrounding",
        "matcher",
        "exposure",
        "strays",
        "disparities",
        "far_m",
    }
    assert noted <= first.meta.keys() and first.ir_left.shape[1] <= simulator.ROOM_WIDEST


@pytest.mark.parametrize("near_m", [0.08, 0.15, 0.5, 3.0])
def test_the_search_range_reaches_what_is_nearest(near_m):
    camera = Camera(300, 300, 159.5, 119.5, 320, 240)
    for seed in range(20):
        depth = np.full((240, 320), near_m)
        stereo, disparities = simulator._room_stereo(np.random.default_rng(seed), camera, depth)
        assert stereo.camera.fx * stereo.baseline_m / near_m < disparities <= 96


@pytest.mark.parametrize("empty, share, kept", [(True, 0.0, True), (False, 0.0, False), (False, 0.01, True)])
def test_a_room_that_is_meant_to_be_without_glass_is_kept(empty, share, kept):
    region = np.zeros((100, 100), bool)
    region.ravel()[: int(share * region.size)] = True
    depth, meta = np.ones((100, 100), np.float32), {"split": "rooms_train", "empty": empty}
    sample = Sample("x", np.zeros((100, 100, 3), np.uint8), depth, depth, region, meta=meta)
    assert simulator._worth_keeping(sample) is kept
    assert not simulator._worth_keeping(replace(sample, depth=np.zeros_like(depth)))


def test_many_scenes_resume_and_skip_by_seed_alone(tmp_path, monkeypatch):
    calls = []

    shipped = simulate(4, "test")
    blank = replace(shipped, region=np.zeros_like(shipped.region))

    def stand_in(seed, split, keep_infrared=False, preset=None):
        calls.append(seed)
        return blank if seed % 2 else shipped

    monkeypatch.setattr(simulator, "simulate", stand_in)
    monkeypatch.setattr(simulator, "ProcessPoolExecutor", InPlace)
    paths = simulate_many(tmp_path, "test", count=3)
    assert [p.name for p in paths] == ["test_00000", "test_00002", "test_00004"]
    assert np.array_equal(read_sample(paths[0]).instances, shipped.instances)
    done = len(calls)
    assert simulate_many(tmp_path, "test", count=3) == paths and len(calls) == done  # nothing is rendered twice
    assert len(simulate_many(tmp_path, "test", count=4)) == 4
    with pytest.raises(ValueError, match="0 of 1 scenes were worth keeping: go on with another --first-seed"):
        monkeypatch.setattr(simulator, "simulate", lambda *_: blank)
        simulate_many(tmp_path, "test", count=1, first_seed=100)


@pytest.mark.parametrize(("stored", "asked"), [(None, "d415"), ("d415", None), ("d415", "l515")])
def test_scenes_of_another_sensor_are_not_taken_for_ones_own(tmp_path, monkeypatch, stored, asked):
    monkeypatch.setattr(simulator, "simulate", lambda *_: pytest.fail("rendered"))
    meta = {"sensor": stored} if stored else {}
    sample = Sample("x", np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), np.float32), meta=meta)
    save_sample(sample, tmp_path / "test" / "test_00004")
    with pytest.raises(ValueError, match=f"test_00004 was measured by {stored or 'a random sensor'}, not .*another"):
        simulate_many(tmp_path, "test", count=1, preset=asked)
    monkeypatch.setattr(simulator, "ProcessPoolExecutor", InPlace)
    assert len(simulate_many(tmp_path, "test", count=1, first_seed=4, preset=stored)) == 1


class InPlace:
    """The part of a process pool that simulate_many uses, without processes."""

    def __init__(self, workers, mp_context=None, initializer=None):
        pass

    def shutdown(self, wait=True, cancel_futures=False):
        pass

    def submit(self, function, *args):
        job = Future()
        job.set_result(function(*args))
        return job


def test_workers_that_an_error_ends_leave_no_process_and_no_thread():
    before = {*threading.enumerate(), *active_children()}
    with pytest.raises(ZeroDivisionError), simulator._workers(1) as pool:
        pool.submit(time.sleep, 60)
        raise ZeroDivisionError
    assert {*threading.enumerate(), *active_children()} <= before


@pytest.mark.parametrize("split, count", [("holdout", 1), ("train", 0)])
def test_wrong_requests_are_refused_before_anything_is_made(tmp_path, split, count):
    with pytest.raises(
        ValueError, match="expected a split of train, val, test, rooms_train, rooms_val, rooms and a count >= 1"
    ):
        simulate_many(tmp_path, split, count)
    assert not list(tmp_path.iterdir())
