"""Four cameras: geometry from their data sheets, a matt table read well by all, and the signature of each."""

import numpy as np
import pytest

from ditr_lite.data import OPAQUE, SAMPLES, TRANSPARENT, list_samples, load_sample
from ditr_lite.loss_types import Cause
from ditr_lite.simulator import cameras as sensors
from ditr_lite.simulator import simulate as simulator
from ditr_lite.simulator.scenes import Scene, Thing, look_at
from ditr_lite.simulator.simulate import simulate, simulate_many

MATT = {"type": "matt", "texture": "noise", "texture_seed": 1, "roughness": 0.1, "infrared": 0.6}
MATT["colours"] = np.array([[0.3, 0.3, 0.3], [0.7, 0.7, 0.7]])


@pytest.fixture
def quick(monkeypatch):
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(simulator, "SIZE", (96, 128))
    monkeypatch.setattr(simulator, "RGB_PASSES", 1)
    monkeypatch.setattr(simulator, "RGB_SAMPLES", 1)


def measure(monkeypatch, name, *things):
    """Simulate a hand-made scene seen from 0.6 m, looking down almost vertically."""
    eye = 0.6 * np.array([0, -np.cos(np.deg2rad(85)), np.sin(np.deg2rad(85))])
    light = {"at": np.array([0.3, -0.5, 1.5]), "size": 0.3, "power": np.full(3, 6.0)}
    scene = Scene(0, list(things), MATT, [], look_at(eye, np.zeros(3)), [light], 0.5)
    monkeypatch.setattr(simulator, "random_scene", lambda seed, split: scene)
    return simulate(0, keep_infrared=True, preset=name)


def block(height=0.12, half=0.035):
    pose = np.eye(4)
    pose[2, 3] = height / 2
    return Thing("slab", OPAQUE, np.array([half, half, height / 2]), pose, {**MATT, "texture_seed": 2})


def test_focal_lengths_follow_from_the_data_sheets():
    focal = {name: kind.focal_px(480) for name, kind in sensors.PRESETS.items()}
    assert focal["d435"] == pytest.approx(480 * 16 / 9 / 2 / np.tan(np.deg2rad(43.5)))
    assert 449 < focal["d435"] < 450 < focal["l515"] < 577 < focal["structure"] < 578 < focal["d415"]
    shift = {n: k.focal_px(480) * k.baseline_m for n, k in sensors.PRESETS.items() if k.baseline_m}  # px m of disparity
    assert shift["d435"] < shift["d415"] < shift["structure"]  # noise falls as this grows


@pytest.mark.parametrize("name", sensors.PRESETS)
def test_the_depth_picture_covers_the_colour_view_from_the_nearest_reading_on(name):
    kind = sensors.PRESETS[name]
    camera, stereo = sensors.rig(kind, (192, 256))
    for z in (kind.range_m[0], 1.0, kind.range_m[1]):
        for u in (0, 255):
            for v in (0, 191):
                x, y = (u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy
                for place in (kind.offset_m, kind.offset_m + kind.baseline_m):  # of either infrared camera
                    column = stereo.camera.fx * (x - place) / z + stereo.camera.cx
                    row = stereo.camera.fy * y / z + stereo.camera.cy
                    assert 0 <= column <= stereo.camera.width - 1 and 0 <= row <= stereo.camera.height - 1
    assert stereo.motion()[0, 3] == kind.offset_m and stereo.baseline_m == kind.baseline_m


@pytest.mark.parametrize("name", sensors.PRESETS)
def test_a_matt_table_is_read_well(name, quick, monkeypatch):
    sample = measure(monkeypatch, name)
    both = (sample.depth > 0) & (sample.depth_gt > 0)
    error = (sample.depth - sample.depth_gt)[both]
    assert both.mean() > 0.85 and abs(np.median(error)) < 0.004 and np.median(np.abs(error)) < 0.008
    assert sample.meta["sensor"] == name and "matcher" not in sample.meta
    assert (sample.ir_left is None) == (name == "l515")


@pytest.mark.parametrize("name", ["d435", "structure"])
def test_what_the_sensor_drops_is_missing_and_said_so(name, quick, monkeypatch):
    def lower_half(depth, *_):
        return np.arange(len(depth))[:, None] + np.zeros(depth.shape) >= len(depth) / 2

    monkeypatch.setattr(sensors.sensor, "dropouts", lower_half)
    sample = measure(monkeypatch, name)
    above, below = np.s_[:40], np.s_[56:]
    assert (sample.depth[above] > 0).mean() > 0.7 and not sample.depth[below].any()
    assert (sample.cause[below] == Cause.DROPOUT).mean() > 0.7


def test_only_triangulation_leaves_a_shadow_on_the_projectors_far_side(quick, monkeypatch):
    shadow, hidden = {}, {}
    for name in ("l515", "structure"):
        sample = measure(monkeypatch, name, block(height=0.16))
        v, u = np.nonzero(sample.instances == 1)
        rows, middle = np.s_[v.min() + 4 : v.max() - 4], round(u.mean())
        missing = (sample.depth == 0) & (sample.instances == 0)
        shadow[name] = missing[rows, :middle].sum(1).mean()  # the projector stands on the right
        hidden[name] = (sample.cause == Cause.STEREO_OCCLUSION).sum()
    assert shadow["structure"] > 3 > shadow["l515"] + 1
    assert hidden["structure"] > 10 and hidden["l515"] == 0  # one lens and its lamp see the same


def test_structured_light_comes_in_steps_and_does_not_mind_brightness():
    kind = sensors.PRESETS["structure"]
    pattern = sensors.sensor.dot_pattern(np.random.default_rng(0), share=kind.dots)
    camera = sensors.rig(kind, (96, 128))[1].camera
    seen = sensors.reference(pattern, camera)
    moved = np.roll(seen, 7, axis=1)  # what lies 7 pixels to the right of the reference everywhere
    shade = np.linspace(0.4, 1.0, seen.shape[1])[None]
    disparity = sensors.triangulate([(shade * moved).astype(np.uint8), seen], kind, True)
    inner = disparity[10:-10, 40:-10]
    assert (inner > 0).mean() > 0.9 and np.median(inner[inner > 0]) == pytest.approx(7, abs=0.11)
    steps = disparity[disparity > 0] / kind.step_px
    assert np.allclose(steps, np.rint(steps), atol=1e-3)


def test_levelling_removes_brightness_and_contrast():
    image = np.random.default_rng(1).integers(0, 120, (40, 60)).astype(np.uint8)
    plain, brighter = sensors.levelled(image), sensors.levelled((image + 100).astype(np.uint8))
    assert np.abs(plain.astype(int) - brighter).max() <= 1
    assert np.abs(plain.astype(int) - sensors.levelled(2 * image)).mean() < 4


def test_readings_outside_the_range_are_dropped():
    depth = np.array([[0.1, 0.5, 3.6]], np.float32)
    assert sensors._in_range(depth, sensors.PRESETS["structure"]).tolist() == [[0, 0.5, 0]]


def test_an_unknown_sensor_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(ValueError, match="unknown sensor 'kinect'; choose one of d435, d415, l515, structure"):
        simulate_many(tmp_path, "test", 1, preset="kinect")
    assert not list(tmp_path.iterdir())


def test_shipped_frames_show_the_signatures():
    noise, missing, bias = {}, {}, {}
    frames = {name: [] for name in sensors.PRESETS}
    for name in sensors.PRESETS:
        root = SAMPLES / "sensors" / name
        samples = [load_sample(n, root) for n in list_samples("test", root)]
        frames[name] = samples
        assert len(samples) == 2 and all(s.meta["sensor"] == name for s in samples)
        pixels = [(s.depth, s.depth_gt, s.region, s.material) for s in samples]
        raw, truth, region, material = (np.concatenate([p[k].ravel() for p in pixels]) for k in range(4))
        read = (raw > 0) & (truth > 0)
        error = np.abs(raw - truth)[read & ~region]
        noise[name] = error[error < 0.03].mean()
        missing[name] = (raw == 0)[region].mean()
        bias[name] = (raw - truth)[read & (material == TRANSPARENT)].mean()
    for a, b in zip(frames["d435"], frames["l515"], strict=True):  # one scene, one colour camera
        assert np.array_equal(a.rgb, b.rgb) and np.array_equal(a.depth_gt, b.depth_gt)
    assert noise["d435"] > 1.3 * noise["d415"] > 1.3 * noise["structure"]
    assert missing["l515"] < 0.2 < min(missing["d435"], missing["d415"], missing["structure"])
    assert all(value > 0.01 for value in bias.values())  # glass reads too far under all four
    assert bias["l515"] > max(bias["d435"], bias["d415"])
    size = sum(p.stat().st_size for p in (SAMPLES / "sensors").rglob("*") if p.is_file())
    assert size < 2e6
