"""``complete --video``: hold still what does not move, in a sequence of frames, without lag where something does.

Not in the paper, which completes single frames. Noise in a frame lets stage one's claim and the painted depth flicker
although nothing moves. So each pixel keeps a running mean of stage one's probability and of what was painted, for as
long as its neighbourhood looks the same; where colour or readings change by more than noise does, it begins anew.
A claim is held until the mean has left the threshold by :data:`BAND`. The wider that band, the less comes and goes and
the longer a claim stays behind what moves too slowly to be noticed, so :data:`STEP` is small. Noise is far smaller once
a neighbourhood is averaged; a camera's exposure, which changes all colours by one factor, is taken out first.
"""

from copy import copy
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from ..config import RefineConfig
from ..pipeline import Completion, Ditr, compose
from ..units import check_inputs
from ..windows import Claim

LONGEST = 30  # frames that a running mean reaches back
AROUND = 9  # pixels of a neighbourhood that is compared, at 256 pixels of width
STEP = 4.0  # grey levels of 255 by which a neighbourhood's mean may differ and still be the same
DEPTH_STEP = 0.03  # share of the depth by which readings may differ, likewise
BAND = 0.15  # of probability: a claim is made this much above the threshold, and dropped this much below
GRID = 8  # every how many pixels a frame's brightness is compared


class Steady:
    """The system for frames that follow each other: called like :class:`pipeline.Ditr`, it remembers.

    Args:
        ditr: the system.
    """

    def __init__(self, ditr: Ditr):
        self.ditr = copy(ditr)  # the same networks: all else is done as of a single frame
        self.ditr.claim = self._claim
        self.seen: tuple[np.ndarray, np.ndarray] | None = None  # running means of smoothed colour and of depth
        self.same: np.ndarray | None = None  # (H, W) bool, where the frame looks as before
        self.count: np.ndarray | None = None  # (H, W) frames in the running means
        self.classes: np.ndarray | None = None  # (classes, h, w) probabilities at the working size, as what was claimed
        self.claimed: np.ndarray | None = None
        self.told: np.ndarray | None = None  # (h, w) frames in the probabilities
        self.region: np.ndarray | None = None
        self.painted: np.ndarray | None = None  # (H, W) metres
        self.drawn: np.ndarray | None = None  # (H, W) frames in what was painted

    def __call__(
        self,
        rgb: np.ndarray,
        depth: np.ndarray,
        region: np.ndarray | None = None,
        adjust: bool = False,
        **how: Any,
    ) -> Completion:
        """Complete the next frame; arguments and result are those of :class:`pipeline.Ditr`.

        ``how`` are its ``steps``, ``samples`` and ``seed``. A frame that fails leaves the memory as it was.
        """
        rgb, depth, region = check_inputs(rgb, depth, region, samples=1)  # how many, the system checks
        before = vars(self).copy()  # arrays are replaced, never written into
        try:
            return self._next(rgb, depth, region, adjust, how)
        except BaseException:
            vars(self).update(before)
            raise

    def _next(
        self, rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None, adjust: bool, how: dict[str, Any]
    ) -> Completion:
        """Complete the next frame and take it into the memory; as :meth:`__call__`."""
        same = self.same = self._compare(rgb, depth)
        if region is not None:
            self.classes = self.claimed = None  # stage one is not asked, so what it said is of an earlier frame
        out = self.ditr(rgb, depth, region, adjust=adjust, **how)
        region = out.region
        fresh = np.where(region, out.optical, out.geometric)
        if self.region is not None:
            same = same & (self.region == region)  # what another branch painted is not averaged with
        self.drawn = np.where(same, np.minimum(self.drawn + 1, LONGEST), 1).astype(np.float32)
        self.painted, self.region = _mean(self.painted, fresh, same, self.drawn), region
        kept = np.zeros_like(depth) if adjust else depth
        return replace(out, depth=compose(kept, self.painted, self.painted, region))

    def _compare(self, rgb: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return (H, W) bool, where the frame looks as before, and take it into the memory."""
        side = max(3, AROUND * rgb.shape[1] // 256)
        colour = cv2.blur(rgb.astype(np.float32), (side, side))
        if self.seen is None or self.seen[0].shape != colour.shape:
            self.seen, self.count = (colour, depth.copy()), np.ones(depth.shape, np.float32)
            self.classes = self.claimed = self.region = self.painted = None
            self.drawn = np.zeros(depth.shape, np.float32)
            return np.zeros(depth.shape, bool)
        before, read = self.seen
        before = before * _gain(before, colour)
        step = STEP * max(1, AROUND / side)  # fewer pixels average their noise less
        moved = np.abs(colour - before).max(axis=2) > step
        both = (depth > 0) & (read > 0)
        farther = (np.abs(depth - read) > DEPTH_STEP * depth) & both
        around = cv2.blur(both.astype(np.float32), (side, side))
        share = cv2.blur(farther.astype(np.float32), (side, side)) / np.maximum(around, 1e-6)
        moved |= share > 0.5  # most readings around are elsewhere: single ones are noise
        moved = cv2.dilate(moved.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        self.count = np.where(moved, 1, np.minimum(self.count + 1, LONGEST)).astype(np.float32)
        weight = 1 / self.count
        mean = before + weight[..., None] * (colour - before)
        readings = np.where(both & ~moved, read + weight * (depth - read), np.where(depth > 0, depth, read))
        self.seen = mean, np.where(moved, depth, readings).astype(np.float32)
        return ~moved

    def _claim(
        self, rgb: np.ndarray, depth: np.ndarray, threshold: float | None = None, refine: RefineConfig | None = None
    ) -> Claim:
        """Return what stage one says of a frame, held where that looks as before; as :meth:`pipeline.Ditr.claim`."""
        frame, classes = self.ditr.classify(rgb, depth)
        still = frame.into(self.same.astype(np.uint8)) > 0
        told = 0 if self.classes is None else self.told
        self.told = np.where(still, np.minimum(told + 1, LONGEST), 1).astype(np.float32)
        self.classes = _mean(self.classes, classes, still, self.told)
        now = 1 - self.classes[0]
        threshold = self.ditr.config.refine.threshold if threshold is None else threshold
        claimed = now > threshold
        if self.claimed is not None:
            dropped = now < max(threshold - BAND, 0.01)
            made = now > min(threshold + BAND, 0.99)
            claimed = np.where(still, np.where(self.claimed, ~dropped, made), claimed)
        self.claimed = claimed
        return self.ditr.claim_of(frame, self.classes, claimed, refine)


def _gain(before: np.ndarray, colour: np.ndarray) -> float:
    """Return by which factor the exposure changed between two pictures, (H, W, 3) float32 grey levels: the median."""
    before, colour = (c[::GRID, ::GRID].mean(axis=2) for c in (before, colour))
    return float(np.median((colour + 1) / (before + 1)))


def _mean(before: np.ndarray | None, now: np.ndarray, same: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the running mean over ``count`` frames where a frame looks as before, and what is now elsewhere."""
    if before is None:
        return now.astype(np.float32)
    return np.where(same, before + (now - before) / count, now).astype(np.float32)
