"""Loss types without the truth: what depth, region and cameras alone let one guess, and how often that is right.

The simulator knows what each pixel suffered; a camera does not. Whether a reading is *there* and whether it lies in the
region is plain to see. Whether it is false, and why one is missing, must be guessed from three physical facts: glass
reads as what stands behind it, a mirror as something behind that, and what an infrared camera cannot see it cannot
measure.
"""

from collections.abc import Iterable
from enum import IntEnum

import cv2
import numpy as np

from ..baselines import harmonic
from ..camera import FACET_STEP, Camera, Stereo, reproject
from ..loss_types import Cause, LossType
from ..units import check_depth, check_mask

# Chosen on the validation split.
IN_FRONT = 0.05  # a reading this share nearer than what surrounds the region is taken for the object itself
BEHIND = 0.04  # one this share farther lies in a mirror: refraction moves glass's background by less
MIRROR_SHARE = 0.2  # a piece of the region is a mirror when this share of its readings lies behind
JUMP = 0.06  # readings outside the region are doubted where depth changes by this share within 5 x 5 pixels
EDGE_PX = 5  # sensors lose pixels along edges, the occluder's too: its outline is taken to be this much blurred


def estimate_loss(depth: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Guess the loss type of every pixel.

    Missing is what is 0. A reading inside the region counts as fine only when it stands clearly before the surface that
    continues the surroundings; outside it counts as wrong where neighbouring readings disagree.

    Paper: Sec. III ("some of the collected depth information is false"), which the paper does not try to find out.

    Args:
        depth: (H, W) raw metres, 0 = missing.
        region: (H, W) bool, transparent or reflective.

    Returns:
        (H, W) uint8 codes of :class:`LossType`, never UNKNOWN.

    Raises:
        ValueError: when shapes differ, or depth holds no reading outside the region.
    """
    return _loss(*_checked(depth, region))


def _loss(depth: np.ndarray, region: np.ndarray, surroundings: np.ndarray) -> np.ndarray:
    valid = (depth > 0) & ~region
    kernel = np.ones((5, 5), np.uint8)
    high = cv2.dilate(np.where(valid, depth, np.float32(0)), kernel)
    low = cv2.erode(np.where(valid, depth, np.float32(np.inf)), kernel)
    wrong = np.where(region, depth > (1 - IN_FRONT) * surroundings, high - low > JUMP * depth)
    kind = np.where(depth == 0, 2, wrong).astype(np.uint8)
    return kind + np.where(region, LossType.INSIDE_FINE, LossType.OUTSIDE_FINE).astype(np.uint8)


def estimate_cause(depth: np.ndarray, region: np.ndarray, camera: Camera, stereo: Stereo) -> np.ndarray:
    """Guess why each pixel was lost.

    Inside the region a whole connected piece is taken for a mirror or for glass. Outside it a hole is given the depth
    of the farther of its two horizontal neighbours, since a shadow falls on the far surface, and is asked whether a
    known surface hides it from the left infrared camera, the right one, or whether it lies outside their pictures. No
    guess is ``DROPOUT``: a hole without a reason is ``NO_MATCH``.

    Paper: Sec. I, Fig. 1 and 3 name these causes.

    Args:
        depth: (H, W) raw metres, 0 = missing.
        region: (H, W) bool, transparent or reflective.
        camera: of the RGB view.
        stereo: geometry of the infrared pair.

    Returns:
        (H, W) uint8 codes of :class:`Cause`.

    Raises:
        ValueError: when shapes differ, or depth holds no reading outside the region.
    """
    depth, region, surroundings = _checked(depth, region)
    loss = _loss(depth, region, surroundings)
    guess = np.where(depth > 0, depth, _far_neighbour(depth))
    out = np.full(depth.shape, Cause.NONE, np.uint8)
    missing = loss == LossType.OUTSIDE_MISSING
    out[missing] = Cause.NO_MATCH
    right_from_rgb = np.linalg.inv(stereo.motion())
    right_from_rgb[0, 3] -= stereo.baseline_m
    for motion, cause in ((right_from_rgb, Cause.STEREO_OCCLUSION), (np.linalg.inv(stereo.motion()), Cause.PARALLAX)):
        inside, hidden = _hidden(depth, guess, camera, stereo.camera, motion)
        out[missing & hidden] = cause
        out[missing & (guess > 0) & ~inside] = Cause.OUT_OF_VIEW
    out[loss == LossType.OUTSIDE_WRONG] = Cause.MISMATCH
    _, pieces = cv2.connectedComponents(region.astype(np.uint8))
    for k in range(1, pieces.max() + 1):
        read = (pieces == k) & (depth > 0)
        behind = depth[read] > (1 + BEHIND) * surroundings[read]
        mirror = behind.size > 0 and behind.mean() > MIRROR_SHARE
        lost = (pieces == k) & (loss != LossType.INSIDE_FINE)
        out[lost] = Cause.REFLECTION if mirror else Cause.TRANSMISSION
    return out


def confusion(truth: np.ndarray, guess: np.ndarray, codes: Iterable[IntEnum]) -> np.ndarray:
    """Count how often each true code was guessed as each code.

    Args:
        truth: whole-number codes, any shape; pixels whose code is not in ``codes`` are left out.
        guess: the same shape; these must all be in ``codes`` where the truth is.
        codes: the classes, in the order of rows and columns.

    Returns:
        (K, K) int64: row = truth, column = guess.

    Raises:
        ValueError: when shapes differ, or a guess is not one of the classes.
    """
    truth, guess, values = np.asarray(truth), np.asarray(guess), [int(c) for c in codes]
    if truth.shape != guess.shape:
        raise ValueError(f"truth is {truth.shape}, the guess {guess.shape}: they should be maps of the same pixels")
    counted = np.isin(truth, values)
    if not np.isin(guess[counted], values).all():
        raise ValueError(f"the guess holds codes other than {values}: name every class that it can give")
    index = np.full(256, -1)
    index[values] = np.arange(len(values))
    pairs = index[truth[counted]] * len(values) + index[guess[counted]]
    return np.bincount(pairs, minlength=len(values) ** 2).reshape(len(values), -1)


def _checked(depth: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depth, region and the smooth surface that continues the surroundings into the region."""
    depth = check_depth("depth", depth)
    region = check_mask("region", region, depth.shape)
    if not (depth[~region] > 0).any():
        raise ValueError("depth holds no reading outside the region: there is nothing to compare its readings with")
    picture = np.zeros((*depth.shape, 3), np.uint8)  # the membrane does not look at colour
    return depth, region, harmonic(picture, depth, region)


def _far_neighbour(depth: np.ndarray) -> np.ndarray:
    """Return, for each pixel, the farther of the nearest readings to its left and right; 0 in a row without any."""
    rows, columns = np.arange(len(depth))[:, None], np.arange(depth.shape[1])
    left = np.maximum.accumulate(np.where(depth > 0, columns, 0), axis=1)
    last = depth.shape[1] - 1
    right = np.minimum.accumulate(np.where(depth > 0, columns, last)[:, ::-1], axis=1)[:, ::-1]
    return np.maximum(depth[rows, left], depth[rows, right])


def _hidden(depth, guess, camera, other, motion) -> tuple[np.ndarray, np.ndarray]:
    """Return where ``guess`` lies inside the other camera's picture, and where a reading hides it there, (H, W) each.

    Args:
        depth: (H, W) readings, metres, 0 = missing: what can hide.
        guess: (H, W) metres, 0 = none: what may be hidden.
        camera: of both.
        other: the other camera.
        motion: (4, 4) from this camera's coordinates to the other's.
    """
    nearest = reproject(depth, camera, other, motion)
    nearest = cv2.erode(np.where(nearest > 0, nearest, np.float32(np.inf)), np.ones((1, EDGE_PX), np.uint8))
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    x, y, z = np.moveaxis((guess[..., None] * rays) @ motion[:3, :3].T + motion[:3, 3], -1, 0)
    z = np.maximum(z, 1e-6)
    column = np.rint(other.fx * x / z + other.cx).astype(int)
    row = np.rint(other.fy * y / z + other.cy).astype(int)
    inside = (guess > 0) & (column >= 0) & (column < other.width) & (row >= 0) & (row < other.height)
    before = nearest[row.clip(0, other.height - 1), column.clip(0, other.width - 1)]
    return inside, inside & (before < (1 - FACET_STEP) * z)
