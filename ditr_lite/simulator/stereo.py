"""The active-stereo depth sensor: from an infrared pair under a dot pattern to raw depth in the RGB view.

The four sources of depth loss of the paper's Fig. 3 and 4 all come from here: block matching that reads *through*
glass and *into* mirrors, pixels that only one infrared camera sees, surfaces without a usable pattern, and the parallax
between the infrared and the RGB camera.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ..camera import Camera, Stereo, reproject
from ..data import REFLECTIVE, TRANSPARENT
from ..loss_types import Cause, LossType


@dataclass(frozen=True)
class Matcher:
    """Settings of one sensor's block matching and of its dropouts; drawn per scene by :func:`random_matcher`."""

    block: int = 9  # matching window, in pixels of the doubled infrared images
    uniqueness: int = 8  # per cent by which the best match must beat the second best
    speckle: int = 200  # smallest blob of consistent disparity that is kept, in doubled pixels
    texture: float = 8.0  # lowest local standard deviation (grey levels) with a usable pattern
    edge: int = 1  # pixels dropped on either side of a depth jump
    holes: float = 0.02  # share of pixels lost to random speckle holes
    noise: float = 2.0  # read noise of the infrared images, grey levels
    gain: float = 1.0  # exposure of the infrared images


def random_matcher(rng: np.random.Generator) -> Matcher:
    """Draw sensor settings wide enough to hold the real frames (see the data card's statistics table)."""
    return Matcher(
        block=int(rng.choice([9, 11, 13, 15])),
        uniqueness=int(rng.integers(4, 22)),
        speckle=int(rng.integers(100, 500)),
        texture=float(rng.uniform(4.0, 16.0)),
        edge=int(rng.choice([0, 1, 2, 3, 4])),
        holes=float(rng.uniform(0, 0.05) if rng.random() < 0.6 else rng.uniform(0.05, 0.35)),
        noise=float(rng.uniform(0.5, 6.0)),
        gain=float(rng.uniform(0.6, 2.0)),
    )


def random_room_matcher(rng: np.random.Generator) -> Matcher:
    """Draw sensor settings for room scenes, whose far walls and dark things lose readings by themselves."""
    holes = rng.choice(3, p=[0.6, 0.3, 0.1])
    return Matcher(
        block=int(rng.choice([9, 11, 13, 15])),
        uniqueness=int(rng.integers(1, 14)),
        speckle=int(rng.integers(40, 400)),
        texture=float(np.exp(rng.uniform(np.log(1.0), np.log(9.0)))),
        edge=int(rng.choice([0, 1, 2, 3, 4])),
        holes=float(rng.uniform(*((0, 0.03), (0.03, 0.12), (0.12, 0.35))[holes])),
        noise=float(rng.uniform(0.5, 4.0)),
        gain=float(rng.uniform(0.7, 1.6)),
    )


def dot_pattern(rng: np.random.Generator, size: int = 420, share: float = 0.04) -> np.ndarray:
    """Return a (size, size) float32 image in [0, 1] of random dots, ``share`` of its pixels being dot centres."""
    dots = (rng.random((size, size)) < share).astype(np.float32)
    return np.clip(cv2.GaussianBlur(dots, (0, 0), 0.9) * 5, 0, 1)


def expose(
    radiance: np.ndarray, matcher: Matcher, rng: np.random.Generator, white: float = 97.0, gamma: float = 1.0
) -> np.ndarray:
    """Return an 8-bit infrared image of (h, w) linear radiance: gain, shot noise, read noise, saturation.

    ``white`` is the percentile of the radiance that a gain of 1 puts at grey level 200; a ``gamma`` below 1
    lifts what is dark, as the gain control of a camera in a deep room does.
    """
    radiance = cv2.GaussianBlur(radiance, (0, 0), 0.8)  # the lens
    white = max(float(np.percentile(radiance, white)), 1e-6)
    signal = (radiance / white) ** gamma * 200 * matcher.gain
    noisy = signal + rng.normal(0, 1, signal.shape) * np.sqrt(matcher.noise**2 + 0.1 * np.maximum(signal, 0))
    return np.clip(noisy, 0, 255).astype(np.uint8)


def match(left: np.ndarray, right: np.ndarray, matcher: Matcher, disparities: int = 64) -> np.ndarray:
    """Return (h, w) float32 disparity of the left image in pixels, 0 where no reliable match exists.

    Semi-global matching with a left-right check, then two sub-pixel steps; weakly textured windows are dropped, as
    sensors do.

    Args:
        left: (h, w) uint8, rectified.
        right: (h, w) uint8; a point at column u of ``left`` lies at column u - disparity of ``right``.
        matcher: settings of the sensor.
        disparities: search range, in pixels.
    """
    height, width = left.shape
    wide = []
    for image in (left, right):
        double = cv2.resize(image, (2 * width, 2 * height), interpolation=cv2.INTER_CUBIC)
        # without the strip the leftmost columns, as many as there are disparities, would never be matched
        wide.append(np.pad(double, ((0, 0), (2 * disparities, 0)), mode="edge"))
    area = matcher.block**2
    sgbm = cv2.StereoSGBM_create(
        minDisparity=0,
        numDisparities=2 * disparities,
        blockSize=matcher.block,
        P1=4 * area,
        P2=16 * area,
        disp12MaxDiff=2,
        uniquenessRatio=matcher.uniqueness,
        speckleWindowSize=matcher.speckle,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM,
    )
    disparity = sgbm.compute(*wide)[::2, 2 * disparities :: 2].astype(np.float32) / 32.0
    window = (matcher.block // 2 | 1,) * 2
    for _ in range(2):
        disparity = _subpixel(left.astype(np.float32), right.astype(np.float32), disparity, (matcher.block,) * 2)
    mean = cv2.blur(left.astype(np.float32), window)
    spread = cv2.blur(left.astype(np.float32) ** 2, window) - mean**2
    visible = np.arange(width, dtype=np.float32)[None] - disparity >= 0  # the match lies inside the right image
    good = (disparity > 0) & (spread > matcher.texture**2) & visible
    # The sensor's own smoothing: edge-preserving, and blind to what is missing, which lies far away in disparity.
    return np.where(good, cv2.bilateralFilter(np.where(good, disparity, -100), 9, 0.6, 2.5), 0).astype(np.float32)


def _subpixel(left: np.ndarray, right: np.ndarray, disparity: np.ndarray, window: tuple[int, int]) -> np.ndarray:
    """Move each disparity by one Gauss-Newton step on the windowed squared difference (Lucas and Kanade, 1981).

    A parabola through matching costs, all that SGBM has, pulls disparities towards whole pixels.
    """
    v, u = np.mgrid[: left.shape[0], : left.shape[1]].astype(np.float32)
    warped = cv2.remap(right, u - disparity, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    slope = cv2.Sobel(warped, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    step = cv2.blur(slope * (warped - left), window) / (cv2.blur(slope**2, window) + 1.0)
    return np.where(disparity > 0, np.maximum(disparity + np.clip(step, -0.3, 0.3), 0.01), 0).astype(np.float32)


def depth_jumps(depth: np.ndarray, reach: int) -> np.ndarray:
    """Return (h, w) bool, True within ``reach`` pixels of a depth jump, however much a plane slants.

    Marked is only what has readings ``reach`` pixels away on both sides: beside a hole, none. Inverse depth
    is linear over the picture of a plane: its second difference tells jumps from slopes.
    """
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-3), np.nan)
    limit = (0.04 + 0.02 * depth) * inverse
    jump = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        before, after = np.roll(inverse, reach, axis), np.roll(inverse, -reach, axis)
        bend = np.abs(before + after - 2 * inverse) > limit
        inner = [slice(None), slice(None)]
        inner[axis] = slice(reach, -reach)
        jump[tuple(inner)] |= bend[tuple(inner)]
    return jump


def dropouts(depth: np.ndarray, matcher: Matcher, rng: np.random.Generator, slanted: bool = False) -> np.ndarray:
    """Return (h, w) bool, True where the sensor's own filters would drop a reading: at depth jumps and in speckles.

    ``slanted`` tells jumps from steep planes, see :func:`depth_jumps`.
    """
    shape = depth.shape
    drop = np.zeros(shape, bool)
    if matcher.edge and slanted:
        drop |= depth_jumps(depth, matcher.edge)
    elif matcher.edge:
        kernel = np.ones((2 * matcher.edge + 1,) * 2, np.uint8)
        near = np.where(depth > 0, depth, 1e3).astype(np.float32)
        jump = cv2.dilate(depth.astype(np.float32), kernel) - cv2.erode(near, kernel) > 0.04 * np.maximum(depth, 0.2)
        drop |= jump & (depth > 0) & (cv2.erode(near, kernel) < 1e3)
    if matcher.holes:
        field = cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), rng.uniform(1.0, 2.5))
        patchy = cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), 40)
        score = field / field.std() + 1.5 * patchy / patchy.std()  # holes gather in patches, as on the real walls
        drop |= score > np.quantile(score, 1 - matcher.holes)
    return drop


def raw_depth(
    left: np.ndarray,
    right: np.ndarray,
    stereo: Stereo,
    camera: Camera,
    matcher: Matcher,
    rng: np.random.Generator,
    far_m: float = 4.0,
    disparities: int = 64,
    slanted: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Return raw depth in the RGB view and the (H, W) bool map of pixels lost to the sensor's own dropouts.

    Depth of the left view is z = f B / d (f in pixels, B in metres, d in pixels).

    Args:
        left: (h, w) uint8 infrared image.
        right: the same of the right camera.
        stereo: geometry of the pair.
        camera: of the RGB view.
        matcher: settings of the sensor.
        rng: draws the dropouts.
        far_m: the farthest reading that such a camera reports.
        disparities: search range of the matching, in pixels.
        slanted: as in :func:`dropouts`.

    Returns:
        (H, W) float32 metres, 0 = missing; (H, W) bool.
    """
    disparity = match(left, right, matcher, disparities)
    depth = np.zeros_like(disparity)
    valid = disparity > 0
    depth[valid] = stereo.camera.fx * stereo.baseline_m / disparity[valid]
    depth[depth > far_m] = 0
    return carry_over(depth, dropouts(depth, matcher, rng, slanted), stereo, camera)


def carry_over(depth: np.ndarray, drop: np.ndarray, stereo: Stereo, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return what a depth camera's map (h, w) becomes in the RGB view, and which pixels were lost to ``drop``.

    Args:
        depth: (h, w) float32 metres in the depth camera's view, 0 = missing.
        drop: (h, w) bool, readings that the sensor throws away.
        stereo: where the depth camera stands.
        camera: of the RGB view.

    Returns:
        (H, W) float32 metres, 0 = missing; (H, W) bool.
    """
    motion = stereo.motion()
    before = reproject(depth, stereo.camera, camera, motion)
    after = reproject(np.where(drop, 0, depth).astype(np.float32), stereo.camera, camera, motion)
    return after, (before > 0) & (after == 0)


def visible_from(
    points: np.ndarray, view_depth: np.ndarray, camera: Camera, pose: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Say which world points a camera sees, by comparing with the camera's own depth map.

    Args:
        points: (H, W, 3) world coordinates in metres.
        view_depth: (h, w) true depth of that camera.
        camera: its intrinsics.
        pose: (4, 4) world from camera.

    Returns:
        (H, W) bool: the point projects into the image; (H, W) bool: nothing stands before it.
    """
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    z = np.maximum(local[..., 2], 1e-6)
    u = np.rint(camera.fx * local[..., 0] / z + camera.cx).astype(int)
    v = np.rint(camera.fy * local[..., 1] / z + camera.cy).astype(int)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height) & (local[..., 2] > 0)
    u, v = np.clip(u, 0, camera.width - 1), np.clip(v, 0, camera.height - 1)
    far = cv2.dilate(view_depth.astype(np.float32), np.ones((3, 3), np.uint8))  # forgive one pixel of rounding
    return inside, far[v, u] > z - 0.008


def causes(
    loss: np.ndarray,
    material: np.ndarray,
    dropped: np.ndarray,
    left: tuple[np.ndarray, ...],
    right: tuple[np.ndarray, ...],
) -> np.ndarray:
    """Return (H, W) uint8 ``Cause`` codes: why each pixel is wrong or missing.

    Args:
        loss: (H, W) ``LossType`` codes.
        material: (H, W) opaque, transparent or reflective.
        dropped: (H, W) bool, pixels lost to dropouts.
        left: what :func:`visible_from` returned for the left infrared camera.
        right: the same for the right one.
    """
    missing = np.isin(loss, (LossType.OUTSIDE_MISSING, LossType.INSIDE_MISSING))
    wrong = np.isin(loss, (LossType.OUTSIDE_WRONG, LossType.INSIDE_WRONG))
    out = np.full(loss.shape, Cause.NONE, np.uint8)
    out[missing] = Cause.NO_MATCH
    out[missing & ~right[1]] = Cause.STEREO_OCCLUSION
    out[missing & ~left[1]] = Cause.PARALLAX
    out[missing & ~(left[0] & right[0])] = Cause.OUT_OF_VIEW
    out[missing & dropped] = Cause.DROPOUT
    out[wrong] = Cause.MISMATCH
    lossy = missing | wrong
    out[lossy & (material == TRANSPARENT)] = Cause.TRANSMISSION
    out[lossy & (material == REFLECTIVE)] = Cause.REFLECTION
    return out


@dataclass(frozen=True)
class Strays:
    """Readings that have nothing to do with the scene; drawn per scene by :func:`random_strays`."""

    share: float = 0.0  # of the pixels
    blob: float = 0.0  # radius of a blob in pixels; 0 is a single pixel
    near: float = 0.5  # share of strays that are too near rather than too far
    garbage: float = 0.0  # share of the picture, its nearest part, in which the matching breaks down altogether


def random_strays(rng: np.random.Generator) -> Strays:
    """Draw stray readings: none in half of the scenes, else up to half a per cent; now and then a broken foreground."""
    share = float(np.exp(rng.uniform(np.log(2e-5), np.log(5e-3)))) if rng.random() < 0.5 else 0.0
    blob = float(rng.uniform(0.6, 4)) if rng.random() < 0.5 else 0.0
    garbage = float(rng.uniform(0.08, 0.3)) if rng.random() < 0.04 else 0.0
    return Strays(share, blob, float(rng.choice([0.0, 0.2, 0.5, 1.0], p=[0.3, 0.35, 0.2, 0.15])), garbage)


def stray(depth: np.ndarray, strays: Strays, rng: np.random.Generator) -> np.ndarray:
    """Return raw depth (H, W) with stray readings: 0.05 to 0.3 or 1.5 to 15 times the median, at most 65 m."""
    out = depth.copy()
    valid = depth > 0
    if not valid.any():
        return out
    middle = float(np.median(depth[valid]))
    if strays.garbage:
        broken = valid & (depth < np.quantile(depth[valid], strays.garbage))
        draw = cv2.GaussianBlur(rng.random(depth.shape).astype(np.float32), (0, 0), 1.5)
        rank = np.argsort(np.argsort(draw.ravel())).reshape(depth.shape) / draw.size
        out[broken & (rank < 0.5)] = 0
        wrong = broken & (rank > 0.7)
        noise = cv2.resize(rng.normal(0, 1, (depth.shape[0] // 3, depth.shape[1] // 3)), depth.shape[::-1])
        out[wrong] = (depth * np.exp(0.9 * noise + 0.5))[wrong]
    wanted = round(strays.share * depth.size)
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    while wanted > 0:
        y, x = rng.integers(depth.shape[0]), rng.integers(depth.shape[1])
        radius = strays.blob * rng.uniform(0.5, 1.2)
        spot = (v - y) ** 2 + (u - x) ** 2 <= radius**2
        low, high = (0.05, 0.3) if rng.random() < strays.near else (1.5, 15.0)
        value = middle * np.exp(rng.uniform(np.log(low), np.log(high)))
        out[spot] = value * (1 + rng.normal(0, 0.01, int(spot.sum())))
        wanted -= int(spot.sum())
    return np.minimum(out, 65.0).astype(np.float32)
