"""A RealSense camera on the desk: one aligned frame as a Sample. Needs the optional extra ``live``, and the device."""

from importlib.util import find_spec

import numpy as np

from ..camera import Camera
from ..data import Sample
from ..units import clean_depth

EXTRA = "pip install 'pyrealsense2>=2.50'"


def available() -> str:
    """Return why no frame can be grabbed here, or an empty string when one can."""
    if find_spec("pyrealsense2") is None:
        return f"the camera's library is not installed ({EXTRA})"
    import pyrealsense2 as rs

    return "" if len(rs.context().devices) else "no RealSense camera is plugged in"


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
        scale = profile.get_device().first_depth_sensor().get_depth_scale()  # metres per unit: 0.001, or 0.00025 (L515)
        align = rs.align(rs.stream.color)  # depth is moved into the colour picture, not the other way round
        for _ in range(warm_up + 1):
            frames = pipeline.wait_for_frames()
        frames = align.process(frames)
        depth, colour = frames.get_depth_frame(), frames.get_color_frame()
        k = colour.profile.as_video_stream_profile().get_intrinsics()
        return Sample(
            name="live",
            rgb=np.asanyarray(colour.get_data()).copy(),
            depth=clean_depth(np.asanyarray(depth.get_data()).astype(np.float64) * scale),
            camera=Camera(k.fx, k.fy, k.ppx, k.ppy, k.width, k.height),
            meta={"depth_scale": scale},
        )
    finally:
        pipeline.stop()
