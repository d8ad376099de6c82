"""How far a frame may stray from the training scenes: one thing changed at a time, scored at every strength.

Each condition takes a frame that is fine and a strength, and returns the frame as another camera, room or distance
would have given it, truth included. Strengths that change nothing are among them, so that every curve has its own zero.

Paper: Sec. V-F tests "other scenarios" by looking; here they are counted.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from tqdm.auto import tqdm

from .. import metrics
from ..baselines import REGISTRY, compose
from ..data import Sample
from ..pipeline import Ditr
from ..units import clean_depth

Condition = Callable[[Sample, float], Sample]
STEREO_NOISE = 0.004  # per metre: standard deviation of stereo depth is this times z squared, as in our scenes
BESIDE = "keep_and_fill"  # the baseline that is scored on the same frames


def brightness(sample: Sample, factor: float) -> Sample:
    """Multiply the light in the colour picture by ``factor`` (the picture is sRGB, so by a power of it there)."""
    rgb = np.clip(sample.rgb.astype(np.float64) * factor ** (1 / 2.2), 0, 255)
    return replace(sample, rgb=np.rint(rgb).astype(np.uint8))


def colour_noise(sample: Sample, sigma: float) -> Sample:
    """Add Gaussian noise of ``sigma`` grey levels to the colour picture."""
    noise = sigma * _rng(sample, 1).normal(size=sample.rgb.shape)
    return replace(sample, rgb=np.rint(np.clip(sample.rgb + noise, 0, 255)).astype(np.uint8))


def depth_noise(sample: Sample, share: float) -> Sample:
    """Add to every reading Gaussian noise of ``share`` times its depth."""
    noise = share * sample.depth * _rng(sample, 2).normal(size=sample.depth.shape)
    return replace(sample, depth=clean_depth(sample.depth + noise))


def missing(sample: Sample, share: float) -> Sample:
    """Drop readings in patches until ``share`` of the picture is missing (at least what is missing already)."""
    rng = _rng(sample, 3)
    field = cv2.GaussianBlur(rng.normal(size=sample.depth.shape).astype(np.float32), (0, 0), 5)
    gone = sample.depth == 0
    extra = max(0, round(share * gone.size) - int(gone.sum()))
    order = np.argsort(np.where(gone, np.inf, field), axis=None)[:extra]
    depth = sample.depth.copy()
    depth.ravel()[order] = 0
    return replace(sample, depth=depth)


def object_size(sample: Sample, zoom: float) -> Sample:
    """Make everything ``zoom`` times as large in the picture: cut out the middle, or mirror the surroundings in.

    Depth stays: it is the same scene through another lens.
    """
    height, width = sample.depth.shape
    if zoom >= 1:
        v, u = _centre(sample)
        high, wide = round(height / zoom), round(width / zoom)
        top, left = (int(np.clip(c - n / 2, 0, N - n)) for c, n, N in ((v, high, height), (u, wide, width)))
        cut = np.s_[top : top + high, left : left + wide]
        return _each(sample, lambda a: _resize(a[cut], (height, width)))
    down, across = (round(n * (1 / zoom - 1) / 2) for n in (height, width))
    return _each(sample, lambda a: _resize(_mirror(a, down, down, across, across), (height, width)))


def distance(sample: Sample, median_m: float) -> Sample:
    """Put everything, larger in proportion, at a median of ``median_m`` metres, with the stereo noise of that distance.

    The picture stays as it is; what changes are the metres and the noise, which grows with their square.
    """
    scale = median_m / float(np.median(sample.depth_gt[sample.depth_gt > 0]))
    depth = sample.depth * np.float32(scale)
    more = np.sqrt(max(scale**2 - 1, 0))  # the frame has its own noise already, which grew by scale
    noise = STEREO_NOISE * more * scale * sample.depth**2 * _rng(sample, 4).normal(size=depth.shape)
    return replace(sample, depth=clean_depth(depth + noise), depth_gt=sample.depth_gt * np.float32(scale))


def aspect(sample: Sample, ratio: float) -> Sample:
    """Make the picture ``ratio`` times as wide as high, by cutting it; below 1 it is portrait."""
    height, width = sample.depth.shape
    v, u = _centre(sample)
    high, wide = (height, round(height * ratio)) if ratio * height <= width else (round(width / ratio), width)
    top, left = (int(np.clip(c - n / 2, 0, N - n)) for c, n, N in ((v, high, height), (u, wide, width)))
    return _each(sample, lambda a: np.ascontiguousarray(a[top : top + high, left : left + wide]))


def levels(sample: Sample, count: float) -> Sample:
    """Round depth to ``count`` levels between its least and its largest reading, as an 8-bit picture (256) would."""
    read = sample.depth > 0
    low, high = float(sample.depth[read].min()), float(sample.depth[read].max())
    step = max(high - low, 1e-6) / (count - 1)
    rounded = low + np.rint((sample.depth - low) / step) * step
    return replace(sample, depth=np.where(read, rounded, 0).astype(np.float32))


CONDITIONS: dict[str, tuple[Condition, tuple[float, ...], float, str]] = {
    # name: how to make it, strengths, the one that changes (next to) nothing, what the axis says
    "brightness": (brightness, (0.1, 0.25, 0.5, 1.0, 2.0, 4.0), 1.0, "light, times"),
    "colour noise": (colour_noise, (0.0, 5.0, 15.0, 30.0), 0.0, "noise of the picture, grey levels"),
    "depth noise": (depth_noise, (0.0, 0.005, 0.01, 0.02, 0.05), 0.0, "noise of the depth, share of it"),
    "missing": (missing, (0.0, 0.3, 0.4, 0.5, 0.6), 0.0, "share without a reading, at least"),
    "object size": (object_size, (0.4, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0), 1.0, "size in the picture, times"),
    "distance": (distance, (0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0), 0.7, "median depth, m"),
    "aspect": (aspect, (0.5, 0.75, 4 / 3, 2.0, 3.0), 4 / 3, "width over height"),
    "depth levels": (levels, (16, 32, 64, 128, 256, 65536), 65536, "levels of depth"),
}


def run(
    ditr: Ditr,
    samples: Sequence[Sample],
    conditions: Mapping[str, tuple] = CONDITIONS,
    given_region: bool = False,
    progress: bool = True,
) -> dict[str, Any]:
    """Score DITR and one baseline under every condition and strength.

    Args:
        ditr: the system.
        samples: frames with truth and region.
        conditions: as :data:`CONDITIONS`.
        given_region: hand over the true region.
        progress: show a bar.

    Returns:
        condition -> ``{"axis": ..., "neutral": ..., "rows": [{"strength":, "ditr":, "keep_and_fill":}, ...]}`` where a
        method has ``optical`` and ``outside``, each a mean over frames of RMSE over the frame's median depth, and
        ``finite``, whether every value was finite and positive.
    """
    jobs = [(name, strength) for name, (_, strengths, _, _) in conditions.items() for strength in strengths]
    out = {name: {"axis": axis, "neutral": zero, "rows": []} for name, (_, _, zero, axis) in conditions.items()}
    for name, strength in tqdm(jobs, desc="conditions", **({} if progress else {"disable": True})):
        frames = [conditions[name][0](sample, strength) for sample in samples]
        scored = [_score(ditr, frame, given_region) for frame in frames]
        row: dict[str, Any] = {"strength": strength, "finite": all(s["finite"] for s in scored)}
        for method in ("ditr", BESIDE):
            row[method] = {key: _mean([s[method][key] for s in scored]) for key in ("optical", "outside")}
        out[name]["rows"].append(row)
    return out


def _score(ditr: Ditr, frame: Sample, given: bool) -> dict[str, Any]:
    result = ditr(frame.rgb, frame.depth, frame.region if given else None)
    plain = compose(REGISTRY[BESIDE](frame.rgb, frame.depth, result.region), frame.depth, result.region)
    typical = float(np.median(frame.depth_gt[frame.depth_gt > 0]))
    out: dict[str, Any] = {"finite": bool(np.isfinite(result.depth).all() and (result.depth > 0).all())}
    for name, depth in (("ditr", result.depth), (BESIDE, plain)):
        scores = metrics.evaluate(depth, frame.depth_gt, frame.region, frame.depth)
        out[name] = {key: scores[key] and scores[key]["rmse"] / typical for key in ("optical", "outside")}
    return out


def _mean(values: Sequence[float | None]) -> float | None:
    kept = [v for v in values if v is not None]
    return round(float(np.mean(kept)), 5) if kept else None


def _rng(sample: Sample, stream: int) -> np.random.Generator:
    """Return a generator that depends on the frame's content alone, so that a run can be repeated."""
    return np.random.default_rng([stream, int(sample.rgb.sum()), int((sample.depth > 0).sum())])


def _centre(sample: Sample) -> tuple[float, float]:
    """Return row and column around which to cut: the middle of the region, or of the picture without one."""
    region = sample.region
    if region is None or not region.any():
        return sample.depth.shape[0] / 2, sample.depth.shape[1] / 2
    v, u = np.nonzero(region)
    return float(np.median(v)), float(np.median(u))


def _each(sample: Sample, change: Callable[[np.ndarray], np.ndarray]) -> Sample:
    """Return the frame with picture, depth, truth and region changed alike; what else it knew is left out."""
    maps = {"rgb": sample.rgb, "depth": sample.depth, "depth_gt": sample.depth_gt, "region": sample.region}
    return Sample(sample.name, **{k: None if a is None else change(a) for k, a in maps.items()})


def _mirror(array: np.ndarray, top: int, bottom: int, left: int, right: int) -> np.ndarray:
    return np.pad(array, ((top, bottom), (left, right), *[(0, 0)] * (array.ndim - 2)), mode="symmetric")


def _resize(array: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if array.shape[:2] == size:
        return np.ascontiguousarray(array)
    how = cv2.INTER_AREA if array.ndim == 3 and array.shape[0] > size[0] else cv2.INTER_NEAREST
    how = cv2.INTER_LINEAR if array.ndim == 3 and how == cv2.INTER_NEAREST else how
    resized = cv2.resize(array.astype(np.uint8) if array.dtype == bool else array, size[::-1], interpolation=how)
    return resized.astype(array.dtype)
