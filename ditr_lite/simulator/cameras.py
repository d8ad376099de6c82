"""Four depth cameras as data: active stereo (D435, D415), time of flight (L515), structured light (Structure Sensor).

What comes from data sheets: principle, baseline, field of view, range. What was chosen so that a frame looks like one
of that camera: pattern density, matching window, thresholds. All four look through the same colour camera at the same
scene, so that their raw depth can be laid side by side.

Paper: Sec. V-F, which calls DITR stable on these four cameras and does not say how they differ.
"""

import math
from dataclasses import dataclass, field

import cv2
import numpy as np

from ..camera import Camera, Stereo
from . import stereo as sensor
from . import tof
from .render import PROJECTOR_DEG, build_scene, render, truth
from .scenes import Scene
from .stereo import Matcher

Seen = list[tuple[np.ndarray, ...]]


@dataclass(frozen=True)
class Preset:
    """One depth camera.

    Attributes:
        title: the camera that it is modelled after.
        principle: ``stereo``, ``structured`` (light) or ``tof`` (time of flight).
        fov_deg: horizontal field of view of the depth camera.
        aspect: width over height of the picture that this field of view belongs to.
        baseline_m: between the two infrared cameras, or between camera and projector; 0 for time of flight.
        offset_m: where the (left) infrared camera is, seen from the colour camera; to the right is positive. The D400
            cameras have both infrared ones on the right; of the others the side is our choice.
        range_m: nearest and farthest reading.
        matcher: of the two triangulating principles.
        dots: share of the pattern's pixels that are dots.
        step_px: disparities come in multiples of this; 0 for none.
        clock: settings of a time-of-flight camera.
        signature: what to look for in its frames.
    """

    title: str
    principle: str
    fov_deg: float
    aspect: float
    baseline_m: float
    offset_m: float
    range_m: tuple[float, float]
    signature: str
    matcher: Matcher = field(default_factory=Matcher)
    dots: float = 0.04
    step_px: float = 0.0
    clock: tof.TimeOfFlight = field(default_factory=tof.TimeOfFlight)

    def focal_px(self, height: int) -> float:
        """Return the focal length in pixels of the depth camera when its picture has ``height`` rows."""
        return height * self.aspect / 2 / math.tan(math.radians(self.fov_deg) / 2)


COLOUR_FOV_DEG, COLOUR_ASPECT = 69.0, 16 / 9  # the colour camera of the D400 series; its middle 4:3 is used
PRESETS = {
    "d435": Preset(
        title="Intel RealSense D435",
        principle="stereo",
        fov_deg=87.0,
        aspect=16 / 9,
        baseline_m=0.050,
        offset_m=0.015,
        range_m=(0.17, 4.0),
        matcher=Matcher(block=9, uniqueness=10, speckle=150, texture=6.0, edge=1, holes=0.02, noise=2.5),
        dots=0.03,
        signature="a wide view and a short baseline: few pixels of disparity, so the noisiest of the four",
    ),
    "d415": Preset(
        title="Intel RealSense D415",
        principle="stereo",
        fov_deg=65.0,
        aspect=16 / 9,
        baseline_m=0.055,
        offset_m=0.015,
        range_m=(0.30, 4.0),
        matcher=Matcher(block=11, uniqueness=10, speckle=200, texture=6.0, edge=1, holes=0.02, noise=2.0),
        dots=0.05,
        signature="a narrow view and a longer baseline: smoother than the D435, with the same shadows",
    ),
    "l515": Preset(
        title="Intel RealSense L515",
        principle="tof",
        fov_deg=70.0,
        aspect=4 / 3,
        baseline_m=0.0,
        offset_m=-0.014,
        range_m=(0.25, 9.0),
        signature="no stereo shadow; glass reads as what is behind it and a little farther; points fly at edges",
    ),
    "structure": Preset(
        title="Structure Sensor",
        principle="structured",
        fov_deg=58.0,
        aspect=4 / 3,
        baseline_m=0.075,
        offset_m=-0.030,
        range_m=(0.40, 3.5),
        matcher=Matcher(block=9, uniqueness=8, speckle=300, texture=8.0, edge=1, holes=0.01, noise=2.0),
        dots=0.06,
        step_px=0.05,  # of table tops: an eighth of a pixel of the full picture, 577 px of focal length
        signature="a shadow on the side that the projector cannot reach, depth in steps, nothing nearer than 0.4 m",
    ),
}


def camera_preset(name: str) -> Preset:
    """Return a camera by its name.

    Raises:
        ValueError: for an unknown one.
    """
    if name not in PRESETS:
        raise ValueError(f"unknown sensor {name!r}; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]


def rig(kind: Preset, size: tuple[int, int]) -> tuple[Camera, Stereo]:
    """Return the colour camera of ``size`` (height, width) and the depth camera beside it.

    The depth picture is as large as it must be to cover the colour view from where it stands, at its own pixels per
    degree; a matcher gets room for its search on top.
    """
    height, width = size
    focal = height * COLOUR_ASPECT / 2 / math.tan(math.radians(COLOUR_FOV_DEG) / 2)
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    own = kind.focal_px(height)
    apart = (abs(kind.offset_m) + kind.baseline_m) / kind.range_m[0]  # how far the views lie apart, at the nearest
    margin = apart if kind.offset_m > 0 else apart / 2  # all on one side, or half on either
    wide = 2 * round(own * (width / focal / 2 + margin)) + 16
    high = 2 * round(own * height / focal / 2) + 16
    depth_camera = Camera(own, own, (wide - 1) / 2, (high - 1) / 2, wide, high)
    motion = np.eye(4)
    motion[0, 3] = kind.offset_m
    return camera, Stereo(depth_camera, kind.baseline_m, tuple(map(tuple, motion.tolist())))


def measure(
    kind: Preset,
    scene: Scene,
    points: np.ndarray,
    camera: Camera,
    stereo: Stereo,
    paths: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray, Seen, list[np.ndarray | None]]:
    """Let one camera look at a scene.

    Args:
        kind: the camera.
        scene: what it looks at.
        points: (H, W, 3) world, what the colour camera sees.
        camera: the colour camera.
        stereo: of :func:`rig`.
        paths: of the renderer, per pixel.
        seed: of everything random.

    Returns:
        (H, W) float32 metres in the colour view, 0 = missing; (H, W) bool, pixels that the sensor dropped; what the
        left and the right side see, as of :func:`sensor.visible_from`; the infrared pair, None where there is none.
    """
    left_pose = scene.camera_pose @ stereo.motion()
    if kind.principle == "tof":
        depth, dropped, own = tof.measure_flight(scene, stereo.camera, left_pose, kind.clock, paths, seed)
        seen = [sensor.visible_from(points, own, stereo.camera, left_pose)] * 2
        depth, dropped = sensor.carry_over(_in_range(depth, kind), dropped, stereo, camera)
        return depth, dropped, seen, [None, None]
    rng = np.random.default_rng([seed, 13])
    shift = np.eye(4)
    shift[0, 3] = stereo.baseline_m
    right_pose = left_pose @ shift
    pattern = sensor.dot_pattern(rng, share=kind.dots)
    structured = kind.principle == "structured"
    middle = np.eye(4)
    middle[0, 3] = stereo.baseline_m / 2
    lit = build_scene(scene, right_pose if structured else left_pose @ middle, rng, slide=pattern)
    pair, seen = [], []
    for pose in (left_pose, right_pose):
        own = truth(lit, stereo.camera, pose, seed)[1]
        seen.append(sensor.visible_from(points, own, stereo.camera, pose))
        if structured and pose is right_pose:
            pair.append(reference(pattern, stereo.camera))
        else:
            radiance = render(lit, stereo.camera, pose, paths, seed).mean(axis=2)
            pair.append(sensor.expose(radiance, kind.matcher, rng))
    disparity = triangulate(pair, kind, structured)
    depth = np.zeros_like(disparity)
    valid = disparity > 0
    depth[valid] = stereo.camera.fx * stereo.baseline_m / disparity[valid]
    depth = _in_range(depth, kind)
    drop = sensor.dropouts(depth, kind.matcher, rng)
    depth, dropped = sensor.carry_over(depth, drop, stereo, camera)
    return depth, dropped, seen, pair


def triangulate(pair: list[np.ndarray], kind: Preset, structured: bool) -> np.ndarray:
    """Return (h, w) float32 disparity in pixels, 0 where there is none, in the steps that the camera has."""
    if structured:  # the reference holds the pattern without the scene's brightness: compare contrast only
        mean = cv2.blur(pair[0].astype(np.float32), (kind.matcher.block,) * 2)
        spread = np.sqrt(np.maximum(cv2.blur(pair[0].astype(np.float32) ** 2, (kind.matcher.block,) * 2) - mean**2, 0))
        disparity = sensor.match(levelled(pair[0]), levelled(pair[1]), kind.matcher)
        disparity = np.where(spread > kind.matcher.texture, disparity, 0)
    else:
        disparity = sensor.match(*pair, kind.matcher)
    if kind.step_px:
        disparity = np.where(disparity > 0, np.maximum(np.rint(disparity / kind.step_px), 1) * kind.step_px, 0)
    return disparity.astype(np.float32)


def reference(pattern: np.ndarray, camera: Camera) -> np.ndarray:
    """Return (h, w) uint8: the projected pattern as a camera in the projector's place would see it on any surface."""
    v, u = np.mgrid[: camera.height, : camera.width]
    half = math.tan(math.radians(PROJECTOR_DEG) / 2)
    x, y = ((a - c) / f / half for a, c, f in ((u, camera.cx, camera.fx), (v, camera.cy, camera.fy)))
    at = [((a + 1) / 2 * pattern.shape[0] - 0.5).astype(np.float32) for a in (x, y)]
    seen = cv2.remap(pattern.astype(np.float32), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.clip(cv2.GaussianBlur(seen, (0, 0), 0.8) * 200, 0, 255).astype(np.uint8)


def levelled(image: np.ndarray) -> np.ndarray:
    """Return (h, w) uint8 with the local mean taken away and the local contrast made alike."""
    image = image.astype(np.float32)
    mean = cv2.GaussianBlur(image, (0, 0), 5)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur(image**2, (0, 0), 5) - mean**2, 0))
    return np.clip(128 + 45 * (image - mean) / (spread + 4), 0, 255).astype(np.uint8)


def _in_range(depth: np.ndarray, kind: Preset) -> np.ndarray:
    near, far = kind.range_m
    return np.where((depth >= near) & (depth <= far), depth, 0).astype(np.float32)
