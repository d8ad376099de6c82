"""How the field scores: on which pixels, at what size, after cleaning what, averaged how. One object per public code.

The figures of other systems in Tables I to III come from such code, so ours are also given as it would give them.
Paper: Sec. V-B, which does not say which code it used. Each object holds what can be read in that code; where a size
depends on the dataset, or nothing is said, the frame's own is kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import cv2
import numpy as np

from .. import metrics
from ..data import Sample

PERFECT = {"rmse": 0.0, "mae": 0.0, "rel": 0.0, "d105": 100.0, "d110": 100.0, "d125": 100.0, "n": 0}


@dataclass(frozen=True)
class Protocol:
    """How somebody else's code scores.

    Attributes:
        name: whose code.
        sets: the pixel sets that it reports, names of ``metrics.SETS``; the first is its headline.
        size: (height, width) to which prediction and truth are brought by nearest neighbour; None keeps the frame's.
        foreground: what takes the place of the region: "region", or "instances" for every object, opaque ones too
            (the region where instances are not known).
        near_m: raw readings before this are dropped.
        far_m: raw readings beyond this are dropped, or set to it if ``clip``.
        clip: see ``far_m``.
        truth_m: truth outside these metres is not scored.
        median_rel: REL is the median over pixels instead of the mean.
        pooled: metrics averaged over all pixels of all images instead of per image.
        empty_is_perfect: an image without such pixels counts as free of error, instead of being left out.
        align: prediction is scaled and shifted to fit the truth best (least squares) before it is scored.
    """

    name: str
    sets: tuple[str, ...]
    size: tuple[int, int] | None = None
    foreground: str = "region"
    near_m: float = 0.0
    far_m: float = inf
    clip: bool = False
    truth_m: tuple[float, float] = (0.0, inf)
    median_rel: bool = False
    pooled: tuple[str, ...] = ()
    empty_is_perfect: bool = False
    align: bool = False

    def __post_init__(self):
        """Refuse names that the metrics do not know."""
        unknown = {*self.sets} - {*metrics.SETS} | {*self.pooled} - {*metrics.METRICS}
        if unknown or not self.sets or self.foreground not in ("region", "instances"):
            raise ValueError(
                f"{self.name}: expected sets of {metrics.SETS}, pooled of {metrics.METRICS}, foreground region or "
                f"instances; got {self.sets}, {self.pooled}, {self.foreground!r}"
            )

    def prepare(self, depth: np.ndarray) -> np.ndarray:
        """Return raw depth (H, W) metres as that code would feed it, 0 = missing."""
        far = np.minimum(depth, self.far_m) if self.clip else np.where(depth > self.far_m, 0, depth)
        return np.where(depth < self.near_m, 0, far).astype(np.float32)

    def score(self, pred: np.ndarray, sample: Sample) -> dict[str, metrics.Scores | None]:
        """Score one prediction.

        Args:
            pred: (H, W) metres, positive everywhere.
            sample: the frame, with ground truth.

        Returns:
            As ``metrics.evaluate``, None for the sets that this code does not report.
        """
        mask = sample.region if self.foreground == "region" or sample.instances is None else sample.instances > 0
        arrays = [pred, sample.depth_gt, None if mask is None else mask.astype(np.uint8)]
        if self.size is not None:
            height, width = self.size
            arrays = [
                a if a is None else cv2.resize(a, (width, height), interpolation=cv2.INTER_NEAREST) for a in arrays
            ]
        pred, truth, mask = arrays[0], arrays[1], None if arrays[2] is None else arrays[2] > 0
        truth = np.where((truth > self.truth_m[0]) & (truth < self.truth_m[1]), truth, 0)
        if self.align:
            pred = fitted(pred, truth)
        found = metrics.evaluate(pred, truth, mask)
        scores = {key: found[key] if key in self.sets else None for key in found}
        pixels = metrics.pixel_sets(truth, mask)
        for key in self.sets:
            if scores[key] is None and self.empty_is_perfect and pixels[key] is not None:
                scores[key] = dict(PERFECT)
            elif scores[key] is not None and self.median_rel:
                chosen = pixels[key]
                error = np.abs(pred[chosen].astype(np.float64) - truth[chosen])
                scores[key]["rel"] = float(np.median(error / truth[chosen]))
        return scores

    def average(self, results: Sequence[dict[str, metrics.Scores | None]]) -> dict[str, dict | None]:
        """Return ``metrics.average`` of many :meth:`score` results, with the pooled value where this code pools."""
        means = metrics.average(results)
        return {key: row and row | {m: row["pooled"][m] for m in self.pooled} for key, row in means.items()}

    def label(self, key: str) -> str:
        """Return what this code calls a pixel set."""
        inside, rest = ("region", "rest") if self.foreground == "region" else ("instances", "background")
        return {"optical": inside, "outside": rest}.get(key, key)

    def describe(self) -> str:
        """Return one line: the pixels, the size and what is peculiar."""
        parts = [" and ".join(self.label(key) for key in self.sets)]
        parts.append("own size" if self.size is None else f"{self.size[1]} x {self.size[0]}")
        if self.near_m or self.far_m < inf:
            parts.append(f"input {self.near_m:g} to {self.far_m:g} m{', clipped' if self.clip else ''}")
        if self.truth_m != (0.0, inf):
            low, high = self.truth_m
            parts.append(f"truth {low:g} to {high:g} m" if high < inf else f"truth beyond {low:g} m")
        parts += ["REL is a median"] * self.median_rel + [f"{', '.join(self.pooled)} pooled"] * bool(self.pooled)
        parts += ["empty counts as perfect"] * self.empty_is_perfect + ["scale and shift fitted"] * self.align
        return "; ".join(parts)


def fitted(pred: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return a * pred + b with the least-squares a, b over the pixels with truth; at least 1 mm, to stay a depth.

    What is scored after this is no longer metric: a prediction of the right shape at the wrong distance is perfect.
    """
    known = truth > 0
    if not known.any():
        return pred
    matrix = np.stack([pred[known], np.ones(known.sum())], axis=1).astype(np.float64)  # (N, 2)
    scale, shift = np.linalg.lstsq(matrix, truth[known].astype(np.float64), rcond=None)[0]
    return np.maximum(scale * pred + shift, 1e-3).astype(pred.dtype)


# ClearGrasp's code completes at its size; at a working size of 192 x 256 a 16:9 frame comes to the same pixels.
CLEARGRASP = Protocol("ClearGrasp", ("optical",), (144, 256), near_m=0.1, far_m=1.5, clip=True)
PROTOCOLS = {
    "cleargrasp": CLEARGRASP,
    "lidf": Protocol("LIDF", ("optical",), (144, 256)),
    "transparenet": Protocol(
        "TranspareNet",
        ("optical",),
        (144, 256),
        truth_m=(0.01, inf),
        median_rel=True,
        pooled=("mae", "d105", "d110", "d125"),
    ),
    "dfnet": Protocol(
        "DFNet / TransCG",
        ("optical", "whole"),
        (240, 320),
        near_m=0.3,
        far_m=1.5,
        truth_m=(0.3, 1.5),
        empty_is_perfect=True,
    ),
    "swindrnet": Protocol("SwinDRNet", ("optical", "outside"), (126, 224), foreground="instances"),
    "d3roma": Protocol("D3RoMa", ("whole",), truth_m=(0.2, 2.0)),
    "marigold": Protocol("Marigold", ("whole",), align=True),
}
