"""No condition crashes or gives a value that is not finite; each changes what it says and nothing else."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ditr_lite import store
from ditr_lite.data import Sample, list_samples, load_sample
from ditr_lite.studies import robustness
from ditr_lite.studies.robustness import CONDITIONS

RESULT = store.WEIGHTS / "results_robustness.json"
SCENE = load_sample(list_samples("val")[1])


@pytest.mark.parametrize("name", [n for n in CONDITIONS if n not in ("distance", "aspect")])
def test_the_neutral_strength_changes_nothing(name):
    frame = CONDITIONS[name][0](SCENE, CONDITIONS[name][2])
    assert np.array_equal(frame.rgb, SCENE.rgb) and np.allclose(frame.depth, SCENE.depth, atol=1e-4)
    assert np.array_equal(frame.region, SCENE.region) and CONDITIONS[name][2] in CONDITIONS[name][1]


@settings(max_examples=20, deadline=None)
@given(share=st.floats(0.3, 0.95))
def test_missing_reaches_its_share_and_moves_no_reading(share):
    frame = robustness.missing(SCENE, share)
    already = (SCENE.depth == 0).mean()
    assert (frame.depth == 0).mean() == pytest.approx(max(share, already), abs=1e-4)
    kept = frame.depth > 0
    assert np.array_equal(frame.depth[kept], SCENE.depth[kept])


def test_light_goes_by_its_power_and_saturates():
    halved = robustness.brightness(SCENE, 0.5)
    bright = SCENE.rgb[SCENE.rgb > 100].astype(float)
    ratio = halved.rgb[SCENE.rgb > 100] / bright
    assert np.allclose(ratio, 0.5 ** (1 / 2.2), atol=0.01) and robustness.brightness(SCENE, 100).rgb.max() == 255


@pytest.mark.parametrize("metres", [0.3, 1.0, 3.0])
def test_distance_scales_truth_and_lets_stereo_noise_grow_with_its_square(metres):
    frame = robustness.distance(SCENE, metres)
    assert np.median(frame.depth_gt[frame.depth_gt > 0]) == pytest.approx(metres, rel=1e-3)
    assert np.array_equal(frame.rgb, SCENE.rgb) and np.array_equal(frame.depth == 0, SCENE.depth == 0)
    scale = metres / np.median(SCENE.depth_gt[SCENE.depth_gt > 0])
    added = (frame.depth - SCENE.depth * np.float32(scale))[SCENE.depth > 0]
    if scale <= 1:
        assert np.abs(added).max() < 1e-6
    else:
        expected = robustness.STEREO_NOISE * scale * np.sqrt(scale**2 - 1) * (SCENE.depth[SCENE.depth > 0] ** 2)
        assert added.std() == pytest.approx(np.sqrt((expected**2).mean()), rel=0.05)


def test_noise_and_levels_are_as_strong_as_asked():
    read = SCENE.depth > 0
    relative = (robustness.depth_noise(SCENE, 0.02).depth / np.where(read, SCENE.depth, 1) - 1)[read]
    assert relative.std() == pytest.approx(0.02, rel=0.05)
    noisy = robustness.colour_noise(SCENE, 15).rgb.astype(int) - SCENE.rgb
    middle = (SCENE.rgb > 60) & (SCENE.rgb < 190)
    assert noisy[middle].std() == pytest.approx(15, rel=0.05)
    coarse = robustness.rounded(SCENE, 16).depth
    assert len(np.unique(coarse[read])) <= 16 and not coarse[~read].any()
    step = (SCENE.depth[read].max() - SCENE.depth[read].min()) / 15
    assert np.abs(coarse - SCENE.depth)[read].max() <= step / 2 + 1e-6


@pytest.mark.parametrize("zoom", [0.4, 0.6, 2.0])
def test_object_size_changes_the_share_of_the_region_and_no_depth(zoom):
    frame = robustness.object_size(SCENE, zoom)
    assert frame.depth.shape == SCENE.depth.shape
    assert set(np.unique(frame.depth_gt)) <= set(np.unique(SCENE.depth_gt))
    if zoom > 1:
        assert frame.region.mean() > 1.3 * SCENE.region.mean()


@pytest.mark.parametrize("ratio", [0.5, 0.75, 3.0])
def test_aspect_cuts_the_picture_only(ratio):
    frame = robustness.aspect(SCENE, ratio)
    height, width = frame.depth.shape
    assert width / height == pytest.approx(ratio, rel=0.02) and height <= 192 and width <= 256


def test_run_reports_every_strength_and_repeats_itself(tiny):
    few = {
        name: (*CONDITIONS[name][:1], CONDITIONS[name][1][:2], *CONDITIONS[name][2:]) for name in ("missing", "aspect")
    }
    first = robustness.score_conditions(tiny, [SCENE], few, progress=False)
    assert first == robustness.score_conditions(tiny, [SCENE], few, progress=False)
    rows = first["missing"]["rows"]
    assert [row["strength"] for row in rows] == [0.0, 0.3] and all(row["finite"] for row in rows)
    assert rows[0]["ditr"]["optical"] > 0 and set(rows[0]) == {"strength", "finite", "ditr", "keep_and_fill"}


# --- disturbances ---


@pytest.fixture(scope="module")
def disturbed():
    return {name: make(SCENE) for name, make in robustness.DISTURBANCES.items()}


def test_no_disturbance_crashes_and_each_says_what_it_is_compared_with(disturbed, tiny):
    for name, made in disturbed.items():
        frame = made.frame
        assert frame.rgb.dtype == np.uint8 and frame.rgb.shape == (*frame.depth.shape, 3), name
        assert frame.depth.dtype == frame.depth_gt.dtype == np.float32 and frame.region.dtype == bool, name
        assert np.isfinite(frame.depth).all() and (frame.depth >= 0).all(), name
        assert made.counterpart.shape == SCENE.depth.shape and not (made.counterpart & ~SCENE.region).any(), name
        here = np.sort(frame.depth_gt[frame.region]) / made.scale  # the same surfaces, pixel by pixel
        there = np.sort(SCENE.depth_gt[made.counterpart])
        times = len(here) // len(there)
        np.testing.assert_allclose(here, np.repeat(there, times), rtol=1e-6, err_msg=name)


def test_a_room_is_behind_and_the_glass_before_it_does_not_count(disturbed):
    made = disturbed["room at 4 m"]
    moved = (made.frame.depth != SCENE.depth).any(axis=0)
    width = SCENE.depth.shape[1]
    assert 0.14 < moved.mean() < 0.16 and set(np.unique(made.frame.depth[:, 0])) <= {0, 4}
    assert not made.frame.region[:, : int(0.27 * width)].any() and made.frame.region.any()
    assert np.array_equal(made.frame.depth == 0, SCENE.depth == 0)
    everywhere = replace(SCENE, region=np.ones_like(SCENE.region))
    counted = robustness.room_behind(everywhere, 4).frame.region
    assert counted.any(axis=0).mean() == pytest.approx(0.73, abs=0.01) and counted[:, -1].all()


@pytest.mark.parametrize(
    ("name", "count", "low", "high"),
    [("10 far strays", 10, 5, 40), ("250 far strays", 250, 5, 40), ("50 near strays", 50, 0, 0.6)],
)
def test_strays_are_as_many_and_as_far_as_they_say_and_outside_the_region(disturbed, name, count, low, high):
    frame = disturbed[name].frame
    moved = frame.depth != SCENE.depth
    assert moved.sum() == count and not moved[SCENE.region].any() and (SCENE.depth[moved] > 0).all()
    assert low < frame.depth[moved].min() and frame.depth[moved].max() < high


def test_turning_four_times_gives_the_frame_back():
    frame = SCENE
    for _ in range(4):
        frame = robustness.quarter_turns(frame, 1).frame
    assert np.array_equal(frame.depth, SCENE.depth) and np.array_equal(frame.rgb, SCENE.rgb)
    assert robustness.quarter_turns(SCENE, 1).frame.depth.shape == SCENE.depth.shape[::-1]


def test_sparse_frames_hold_few_true_readings(disturbed):
    few, lines = disturbed["300 readings"].frame, disturbed["16 scan lines"].frame
    assert few.depth.shape == (768, 1024) and (few.depth > 0).sum() == 300 and not few.depth[few.region].any()
    rows = np.flatnonzero((lines.depth > 0).any(axis=1))
    assert len(rows) == 16 and set(np.diff(rows)) == {48}
    read = lines.depth > 0
    assert np.array_equal(lines.depth[read], lines.depth_gt[read]) and not read[lines.region].any()
    for frame in (few, lines):
        depth = robustness.linear(frame)
        assert np.isfinite(depth).all() and (depth > 0).all()
        kept = (frame.depth > 0) & ~frame.region
        assert np.array_equal(depth[kept], frame.depth[kept])


def test_linear_interpolation_continues_a_plane_through_the_region():
    v, u = np.mgrid[:40, :60]
    plane = (0.5 + 0.002 * u + 0.001 * v).astype(np.float32)
    region = (np.abs(u - 30) < 8) & (np.abs(v - 20) < 6)
    frame = Sample("plane", np.zeros((40, 60, 3), np.uint8), np.where(region, np.float32(9), plane), plane, region)
    np.testing.assert_allclose(robustness.linear(frame), plane, atol=1e-6)


def test_linear_interpolation_can_be_scored_where_readings_are_few():
    v, u = np.mgrid[:40, :60]
    plane = (0.5 + 0.002 * u + 0.001 * v).astype(np.float32)
    region = (np.abs(u - 30) < 8) & (np.abs(v - 20) < 6)
    read = (u % 7 == 0) & (v % 5 == 0) & ~region
    frame = Sample("plane", np.zeros((40, 60, 3), np.uint8), np.where(read, plane, np.float32(0)), plane, region)
    depth = robustness.linear(frame)
    assert (depth > 0).all() and (depth[read] == plane[read]).all()
    np.testing.assert_allclose(depth[region], plane[region], atol=1e-6)


def test_the_table_pairs_frames_with_themselves():
    plain, worse = [0.01, 0.10, None], [0.02, 0.20, 0.3]
    rows = {"x": {r: {"disturbed_m": worse, "undisturbed_m": plain} for r in robustness.REGIONS}}
    rows["300 readings"] = {r: rows["x"][r] | {"linear_m": [0.04, 0.40, 0.6]} for r in robustness.REGIONS}
    table = robustness.summarise_disturbances(rows)
    assert table["x"]["found"]["ratio"] == [2.0, 2.0, 2.0] and "of_linear" not in table["x"]["found"]
    assert table["300 readings"]["given"]["of_linear"] == [0.5, 0.5, 0.5]
    text = robustness.format_disturbances(table)
    assert text.count("2.00 [2.00, 2.00]") == 4 and text.count("0.50 [0.50, 0.50]") == 2 and "173.3" in text
    assert len({len(line) for line in text.splitlines()}) == 1 and "undisturbed  " in text.splitlines()[0]


def test_disturbances_are_run_with_the_region_found_and_given(tiny):
    some = {name: robustness.DISTURBANCES[name] for name in ("turned by 90", "300 readings", "distance x 3")}
    rows = robustness.run_disturbances(tiny, [SCENE], some, progress=False)
    assert rows == robustness.run_disturbances(tiny, [SCENE], some, progress=False)
    for name, regions in rows.items():
        for region in robustness.REGIONS:
            row = regions[region]
            assert ("linear_m" in row) == (name in robustness.SPARSE)
            assert all(0 < value < 5 for values in row.values() for value in values), name
    assert rows["distance x 3"]["given"]["disturbed_m"] == pytest.approx(
        rows["distance x 3"]["given"]["undisturbed_m"], rel=0.02
    )  # distance itself does not matter to the networks


def test_what_no_camera_could_read_is_not_scored(tiny):
    near = replace(SCENE, depth=SCENE.depth * np.float32(0.1), depth_gt=SCENE.depth_gt * np.float32(0.1))
    some = {"distance x 0.1": robustness.DISTURBANCES["distance x 0.1"]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of the near frame itself
        rows = robustness.run_disturbances(tiny, [near, SCENE], some, progress=False)["distance x 0.1"]
    assert rows["found"]["disturbed_m"][0] is None and rows["found"]["disturbed_m"][1] is not None


def test_the_committed_file_holds_every_condition_and_nothing_that_is_not_finite():
    result = json.loads(RESULT.read_text())
    assert result["command"].startswith("python tools/robustness.py") and len(result["frames"]) >= 3
    assert set(result["curves"]) == set(CONDITIONS)
    for name, curve in result["curves"].items():
        assert [row["strength"] for row in curve["rows"]] == list(CONDITIONS[name][1])
        for row in curve["rows"]:
            assert row["finite"] and all(0 < row[m][k] < 5 for m in ("ditr", "keep_and_fill") for k in row[m])


def test_the_tool_spreads_its_scenes_over_the_rendered_split():
    import robustness as tool  # here: mutants run on a copy without the tools

    names = list_samples("test")
    assert tool.frames(4) == [names[k] for k in (0, 32, 64, 96)]


@pytest.mark.parametrize("name", CONDITIONS)
def test_no_condition_crashes_or_gives_what_is_not_finite(name, tiny):
    condition, strengths, _, _ = CONDITIONS[name]
    for strength in strengths:
        frame, case = condition(SCENE, strength), f"{name} {strength}"
        assert frame.rgb.dtype == np.uint8 and frame.rgb.shape == (*frame.depth.shape, 3), case
        assert frame.depth.dtype == frame.depth_gt.dtype == np.float32 and frame.region.dtype == bool, case
        assert np.isfinite(frame.depth).all() and (frame.depth >= 0).all() and (frame.depth > 0).any(), case
        out = tiny(frame.rgb, frame.depth)
        assert out.depth.shape == frame.depth.shape and np.isfinite(out.depth).all() and (out.depth > 0).all(), case
        keep = (frame.depth > 0) & ~out.region
        assert np.array_equal(out.depth[keep], frame.depth[keep]), case
