"""The RealSense path, with a stand-in for the library: no camera is needed, and none is asked for."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from ditr_lite.camera import Camera
from ditr_lite.datasets import live

UNITS = np.array([[400, 0, 65535], [800, 1200, 2000]], np.uint16)


class Frame:
    def __init__(self, array):
        self.array, self.profile = array, self

    def get_data(self):
        return self.array

    def as_video_stream_profile(self):
        return self

    def get_intrinsics(self):
        return SimpleNamespace(fx=600.0, fy=601.0, ppx=1.5, ppy=0.5, width=3, height=2)


class Pipeline:
    stopped = 0

    def start(self, config):
        device = SimpleNamespace(first_depth_sensor=lambda: SimpleNamespace(get_depth_scale=lambda: 0.00025))
        return SimpleNamespace(get_device=lambda: device)

    def wait_for_frames(self):
        return "unaligned"

    def stop(self):
        Pipeline.stopped += 1


def library(devices):
    def process(frames):
        assert frames == "unaligned"
        colour = Frame(np.full((2, 3, 3), 7, np.uint8))
        return SimpleNamespace(get_depth_frame=lambda: Frame(UNITS), get_color_frame=lambda: colour)

    return SimpleNamespace(
        __spec__=SimpleNamespace(name="pyrealsense2"),
        context=lambda: SimpleNamespace(devices=devices),
        pipeline=Pipeline,
        config=lambda: SimpleNamespace(enable_stream=lambda *a: None),
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
    sample = live.grab(3, 2, warm_up=0)
    np.testing.assert_allclose(sample.depth, UNITS * 0.00025, rtol=1e-6)
    assert sample.depth.dtype == np.float32 and sample.rgb.shape == (2, 3, 3)
    assert sample.camera == Camera(600.0, 601.0, 1.5, 0.5, 3, 2) and Pipeline.stopped == 1
