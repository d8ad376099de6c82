"""A RealSense camera on the desk, or a recording of one: aligned frames as Samples. Needs the extra ``live``."""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..camera import Camera
from ..data import Sample
from ..files import NO_READING
from ..units import clean_depth

if TYPE_CHECKING:
    import pyrealsense2

EXTRA = "pip install 'pyrealsense2>=2.50'"


def available() -> str:
    """Return why no frame can be grabbed here, or an empty string when one can."""
    if reason := _no_library():
        return reason
    import pyrealsense2 as rs

    return "" if len(rs.context().devices) else "no RealSense camera is plugged in"


def _no_library() -> str:
    return "" if find_spec("pyrealsense2") else f"the camera's library is not installed ({EXTRA})"


def grab(width: int = 640, height: int = 480, fps: int = 30, warm_up: int = 30) -> Sample:
    """Return one frame of the first RealSense camera, depth aligned to colour, in metres.

    Args:
        width: of both pictures.
        height: of both pictures.
        fps: frames a second.
        warm_up: frames thrown away first, while exposure and white balance settle.

    Raises:
        ValueError: when there is no library or no camera, saying which.
    """
    if reason := available():
        raise ValueError(f"cannot grab a frame: {reason}")
    import pyrealsense2 as rs

    pipeline, config = rs.pipeline(), rs.config()
    config.enable_stream(rs.stream.depth, width, height, rs.format.z16, fps)
    config.enable_stream(rs.stream.color, width, height, rs.format.rgb8, fps)
    profile = pipeline.start(config)
    try:
        align = rs.align(rs.stream.color)  # depth is moved into the colour picture, not the other way round
        for _ in range(warm_up + 1):
            frames = pipeline.wait_for_frames()
        return _sample("live", align.process(frames), _scale(profile))
    finally:
        pipeline.stop()


def recorded(path: Path | str, every: int = 1) -> Iterator[Sample]:
    """Yield the frames of a recording, a ``.bag`` file of the RealSense Viewer, aligned and in metres, in order.

    Args:
        path: the file; it needs a depth and a colour stream.
        every: yield every so manieth frame only.

    Raises:
        ValueError: without the library or the file, or for ``every`` below 1.
    """
    path = Path(path)
    if every < 1:
        raise ValueError(f"every: expected at least 1, got {every}")
    if not path.is_file():
        raise ValueError(f"no recording {path}: expected a .bag file of the RealSense Viewer")
    if reason := _no_library():
        raise ValueError(f"cannot read {path}: {reason}")
    import pyrealsense2 as rs

    pipeline, config = rs.pipeline(), rs.config()
    config.enable_device_from_file(str(path), repeat_playback=False)
    profile = pipeline.start(config)
    profile.get_device().as_playback().set_real_time(False)  # wait for us: a recording need not drop frames
    align, number = rs.align(rs.stream.color), 0
    try:
        while True:
            there, frames = pipeline.try_wait_for_frames()
            if not there:  # the end of the file
                return
            if number % every == 0:
                yield _sample(f"{path.stem}_{number:05d}", align.process(frames), _scale(profile))
            number += 1
    finally:
        pipeline.stop()


def _scale(profile: "pyrealsense2.pipeline_profile") -> float:
    """Return metres per unit: 0.001, or 0.00025 of an L515."""
    return profile.get_device().first_depth_sensor().get_depth_scale()


def _sample(name: str, frames: "pyrealsense2.composite_frame", scale: float) -> Sample:
    """Return aligned frames as a sample, with copies of their pixels: the library uses its memory again."""
    depth, colour = frames.get_depth_frame(), frames.get_color_frame()
    units = np.asanyarray(depth.get_data())
    k = colour.profile.as_video_stream_profile().get_intrinsics()
    rgb = np.array(colour.get_data())
    if str(colour.profile.format()).endswith("bgr8"):
        rgb = np.ascontiguousarray(rgb[..., ::-1])
    return Sample(
        name=name,
        rgb=rgb,
        depth=clean_depth(np.where(units == NO_READING, 0, units * np.float64(scale))),
        camera=Camera(k.fx, k.fy, k.ppx, k.ppy, k.width, k.height),
        meta={"depth_scale": scale},
    )
