"""The RealSense path, with a stand-in for the library: no camera is needed, and none is asked for."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from ditr_lite.camera import Camera
from ditr_lite.datasets import live

UNITS = np.array([[400, 0, 65535], [800, 1200, 2000]], np.uint16)
METRES = np.array([[0.1, 0, 0], [0.2, 0.3, 0.5]])  # 65535 is no reading, as in a file


class Frame:
    def __init__(self, array):
        self.array, self.profile = array, self

    def get_data(self):
        return self.array

    def as_video_stream_profile(self):
        return self

    def format(self):
        return "format.bgr8" if Pipeline.blue_first else "format.rgb8"

    def get_intrinsics(self):
        return SimpleNamespace(fx=600.0, fy=601.0, ppx=1.5, ppy=0.5, width=3, height=2)


class Pipeline:
    stopped = 0
    blue_first = False
    left = 0  # frames of a recording
    real_time = True

    def start(self, config):
        sensor = SimpleNamespace(get_depth_scale=lambda: 0.00025)
        playback = SimpleNamespace(set_real_time=lambda real: setattr(Pipeline, "real_time", real))
        device = SimpleNamespace(first_depth_sensor=lambda: sensor, as_playback=lambda: playback)
        return SimpleNamespace(get_device=lambda: device)

    def wait_for_frames(self):
        return "unaligned"

    def try_wait_for_frames(self):
        Pipeline.left -= 1
        return Pipeline.left >= 0, "unaligned"

    def stop(self):
        Pipeline.stopped += 1


class Config:
    file = None

    def enable_stream(self, *_):
        pass

    def enable_device_from_file(self, path, repeat_playback):
        assert not repeat_playback
        Config.file = path


def library(devices):
    def process(frames):
        assert frames == "unaligned"
        colour = Frame(np.full((2, 3, 3), (7, 8, 9), np.uint8))
        return SimpleNamespace(get_depth_frame=lambda: Frame(UNITS), get_color_frame=lambda: colour)

    return SimpleNamespace(
        __spec__=SimpleNamespace(name="pyrealsense2"),
        context=lambda: SimpleNamespace(devices=devices),
        pipeline=Pipeline,
        config=Config,
        stream=SimpleNamespace(depth=1, color=2),
        format=SimpleNamespace(z16=1, rgb8=2),
        align=lambda stream: SimpleNamespace(process=process) if stream == 2 else None,
    )


def test_without_library_or_camera_the_reason_is_given(monkeypatch):
    monkeypatch.setattr(live, "find_spec", lambda name: None)
    assert "not installed (pip install" in live.available()
    monkeypatch.setattr(live, "find_spec", lambda name: object())
    monkeypatch.setitem(sys.modules, "pyrealsense2", library([]))
    assert live.available() == "no RealSense camera is plugged in"
    with pytest.raises(ValueError, match="cannot grab a frame: no RealSense camera"):
        live.grab()


def test_a_frame_comes_aligned_in_metres_with_its_own_scale_and_camera(monkeypatch):
    monkeypatch.setattr(live, "find_spec", lambda name: object())
    monkeypatch.setitem(sys.modules, "pyrealsense2", library(["L515"]))
    before = Pipeline.stopped
    sample = live.grab(3, 2, warm_up=0)
    np.testing.assert_allclose(sample.depth, METRES, rtol=1e-6)
    assert sample.depth.dtype == np.float32 and sample.rgb.shape == (2, 3, 3)
    assert sample.camera == Camera(600.0, 601.0, 1.5, 0.5, 3, 2) and Pipeline.stopped == before + 1


@pytest.mark.parametrize("blue_first", [False, True])
def test_a_recording_gives_its_frames_in_order_without_dropping_any(monkeypatch, tmp_path, blue_first):
    monkeypatch.setattr(live, "find_spec", lambda name: object())
    monkeypatch.setitem(sys.modules, "pyrealsense2", library([]))
    monkeypatch.setattr(Pipeline, "blue_first", blue_first)
    monkeypatch.setattr(Pipeline, "left", 5)
    monkeypatch.setattr(Pipeline, "real_time", True)
    bag = tmp_path / "desk.bag"
    bag.touch()
    before = Pipeline.stopped
    samples = list(live.recorded(bag, every=2))
    assert [s.name for s in samples] == ["desk_00000", "desk_00002", "desk_00004"]
    assert Config.file == str(bag) and not Pipeline.real_time and Pipeline.stopped == before + 1
    np.testing.assert_allclose(samples[0].depth, METRES, rtol=1e-6)
    assert samples[0].rgb[0, 0].tolist() == ([9, 8, 7] if blue_first else [7, 8, 9])


def test_a_recording_that_cannot_be_read_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(live, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match="no recording"):
        next(live.recorded(tmp_path / "none.bag"))
    (tmp_path / "a.bag").touch()
    with pytest.raises(ValueError, match="not installed"):
        next(live.recorded(tmp_path / "a.bag"))
    with pytest.raises(ValueError, match="at least 1"):
        next(live.recorded(tmp_path / "a.bag", every=0))
