"""How somebody else's code scores: on which pixels, at what size, after cleaning its input in what way.

The figures of other systems in Tables I to III come from such code, so ours are also given as it would give them.
Paper: Sec. V-B, which does not say which code it used.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ditr_lite import metrics
from ditr_lite.data import Sample


@dataclass(frozen=True)
class Protocol:
    """How somebody else's code scores: on the region, at its own size, after cleaning the input its own way.

    The paper's tables take their figures of other systems from such code. ``prepare`` is applied to the raw depth
    before completion; prediction and truth are then brought to ``size`` by nearest neighbour. ClearGrasp's code
    completes at that size; at a working size of 192 x 256 a 16:9 frame comes to the same 144 x 256 pixels.
    """

    name: str
    size: tuple[int, int]  # height, width
    near_m: float  # readings before this are dropped
    far_m: float  # readings beyond this are set to it

    def prepare(self, depth: np.ndarray) -> np.ndarray:
        """Return raw depth (H, W) metres as that code would feed it."""
        return np.where(depth < self.near_m, 0, np.minimum(depth, self.far_m)).astype(np.float32)

    def score(self, pred: np.ndarray, sample: Sample) -> dict[str, metrics.Scores | None]:
        """Score a prediction (H, W) metres; the set that counts is ``optical``."""
        height, width = self.size
        arrays = [pred, sample.depth_gt] + ([] if sample.region is None else [sample.region.astype(np.uint8)])
        small = [cv2.resize(a, (width, height), interpolation=cv2.INTER_NEAREST) for a in arrays]
        return metrics.evaluate(small[0], small[1], small[2] > 0 if len(small) == 3 else None)


CLEARGRASP = Protocol("ClearGrasp", (144, 256), 0.1, 1.5)
