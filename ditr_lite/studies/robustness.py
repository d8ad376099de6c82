"""How far a frame may stray from the training scenes: one thing changed at a time, scored at every strength.

Each condition takes a frame that is fine and a strength, and returns the frame as another camera, room or distance
would have given it, truth included. Strengths that change nothing are among them, so that every curve has its own zero.

Disturbances are single ones that a working system must take nearly without harm: each is scored on the pixels that the
undisturbed frame shows as well, so that the ratio of the two errors says what it costs.

Paper: Sec. V-F tests "other unsupervised scenarios" by looking; here they are counted.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from tqdm.auto import tqdm

from .. import metrics
from ..baselines import REGISTRY
from ..data import Sample
from ..evaluation.statistics import bootstrap_mean, format_interval, interval, mean_known, ratio_bootstrap
from ..pipeline import Ditr, compose
from ..units import MAX_DEPTH_M, MIN_DEPTH_M, clean_depth
from ..windows import at_centres

Condition = Callable[[Sample, float], Sample]
BORDER = 0.12  # of the width, beside a room behind, in which nothing is scored
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
        cut = _about_region(sample, round(height / zoom), round(width / zoom))
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
    high, wide = (height, round(height * ratio)) if ratio * height <= width else (round(width / ratio), width)
    cut = _about_region(sample, high, wide)
    return _each(sample, lambda a: np.ascontiguousarray(a[cut]))


def rounded(sample: Sample, count: float) -> Sample:
    """Round depth to ``count`` levels between its least and its largest reading, as an 8-bit picture (256) would."""
    read = sample.depth > 0
    low, high = float(sample.depth[read].min()), float(sample.depth[read].max())
    step = max(high - low, 1e-6) / (count - 1)
    level = low + np.rint((sample.depth - low) / step) * step
    return replace(sample, depth=np.where(read, level, 0).astype(np.float32))


CONDITIONS: dict[str, tuple[Condition, tuple[float, ...], float, str]] = {
    # name: how to make it, strengths, the one that changes (next to) nothing, what the axis says
    "brightness": (brightness, (0.1, 0.25, 0.5, 1.0, 2.0, 4.0), 1.0, "light, times"),
    "colour noise": (colour_noise, (0.0, 5.0, 15.0, 30.0), 0.0, "noise of the picture, grey levels"),
    "depth noise": (depth_noise, (0.0, 0.005, 0.01, 0.02, 0.05), 0.0, "noise of the depth, share of it"),
    "missing": (missing, (0.0, 0.3, 0.4, 0.5, 0.6), 0.0, "share without a reading, at least"),
    "object size": (object_size, (0.4, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0), 1.0, "size in the picture, times"),
    "distance": (distance, (0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0), 0.7, "median depth, m"),
    "aspect": (aspect, (0.5, 0.75, 4 / 3, 2.0, 3.0), 4 / 3, "width over height"),
    "depth levels": (rounded, (16, 32, 64, 128, 256, 65536), 65536, "levels of depth"),
}


def score_conditions(
    ditr: Ditr,
    samples: Sequence[Sample],
    conditions: Mapping[str, tuple] = CONDITIONS,
    progress: bool = True,
) -> dict[str, Any]:
    """Score DITR and one baseline under every condition and strength.

    Args:
        ditr: the system.
        samples: frames with truth and region.
        conditions: as :data:`CONDITIONS`.
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
        scored = [_score(ditr, frame) for frame in frames]
        row: dict[str, Any] = {"strength": strength, "finite": all(s["finite"] for s in scored)}
        for method in ("ditr", BESIDE):
            means = {key: mean_known([s[method][key] for s in scored]) for key in ("optical", "outside")}
            row[method] = {key: None if mean is None else round(mean, 5) for key, mean in means.items()}
        out[name]["rows"].append(row)
    return out


def _score(ditr: Ditr, frame: Sample) -> dict[str, Any]:
    result = ditr(frame.rgb, frame.depth)
    filled = REGISTRY[BESIDE](frame.rgb, frame.depth, result.region)
    plain = compose(frame.depth, filled, filled, result.region)
    typical = float(np.median(frame.depth_gt[frame.depth_gt > 0]))
    out: dict[str, Any] = {"finite": bool(np.isfinite(result.depth).all() and (result.depth > 0).all())}
    for name, depth in (("ditr", result.depth), (BESIDE, plain)):
        scores = metrics.evaluate(depth, frame.depth_gt, frame.region, frame.depth)
        out[name] = {key: scores[key] and scores[key]["rmse"] / typical for key in ("optical", "outside")}
    return out


@dataclass(frozen=True)
class Disturbed:
    """A frame as another camera, mounting or room would have given it, beside the one that it was made from.

    Attributes:
        frame: with truth, and with the region in which it is scored.
        counterpart: (H, W) bool, the pixels of the undisturbed frame that show what the region of ``frame`` shows.
        scale: by how much everything is farther away; errors are divided by it.
    """

    frame: Sample
    counterpart: np.ndarray
    scale: float = 1.0


def room_behind(sample: Sample, metres: float, share: float = 0.15) -> Disturbed:
    """Put the left ``share`` of the picture ``metres`` away; the region counts from :data:`BORDER` farther right on."""
    column = np.arange(sample.depth.shape[1]) / sample.depth.shape[1]
    behind = np.broadcast_to(column < share, sample.depth.shape)
    depth = np.where(behind & (sample.depth > 0), np.float32(metres), sample.depth)
    truth = np.where(behind, np.float32(metres), sample.depth_gt)
    region = sample.region & (column > share + BORDER)
    return Disturbed(replace(sample, depth=depth, depth_gt=truth, region=region, material=None), region)


def far_strays(sample: Sample, count: int) -> Disturbed:
    """Let ``count`` readings outside the region be anything from 5 to 40 m."""
    return _strays(sample, count, lambda rng: rng.uniform(5, 40, count))


def near_strays(sample: Sample, count: int) -> Disturbed:
    """Let ``count`` readings outside the region be at 5 to 50 % of the frame's median."""
    typical = float(np.median(sample.depth[sample.depth > 0]))
    return _strays(sample, count, lambda rng: typical * rng.uniform(0.05, 0.5, count))


def _strays(sample: Sample, count: int, draw: Callable[[np.random.Generator], np.ndarray]) -> Disturbed:
    rng = _rng(sample, 5)
    places = np.argwhere((sample.depth > 0) & ~sample.region)
    rows, columns = rng.permutation(places)[:count].T
    depth = sample.depth.copy()
    depth[rows, columns] = draw(rng)[: len(rows)]
    return Disturbed(replace(sample, depth=depth), sample.region)


def quarter_turns(sample: Sample, quarters: int) -> Disturbed:
    """Turn everything by quarters of a full turn, as a camera mounted on its side or upside down does."""
    return Disturbed(_each(sample, lambda a: np.ascontiguousarray(np.rot90(a, quarters))), sample.region)


def farther(sample: Sample, factor: float) -> Disturbed:
    """Put everything, larger in proportion, ``factor`` times as far away: the picture stays as it is."""
    depth, truth = sample.depth * np.float32(factor), sample.depth_gt * np.float32(factor)
    return Disturbed(replace(sample, depth=depth, depth_gt=truth), sample.region, factor)


def few_readings(sample: Sample, count: int) -> Disturbed:
    """Keep ``count`` readings outside the region, in a picture of :data:`WIDE` columns."""
    large = _enlarged(sample)
    places = np.argwhere((large.depth > 0) & ~large.region)
    rows, columns = _rng(sample, 6).permutation(places)[:count].T
    depth = np.zeros_like(large.depth)
    depth[rows, columns] = large.depth[rows, columns]
    return Disturbed(replace(large, depth=depth), sample.region)


def scan_lines(sample: Sample, count: int) -> Disturbed:
    """Keep ``count`` exact rows outside the region, as a scanner gives them, in a picture of :data:`WIDE` columns."""
    large = _enlarged(sample)
    height = large.depth.shape[0]
    rows = np.arange(count) * (height // count) + 2
    depth = np.zeros_like(large.depth)
    depth[rows] = large.depth_gt[rows]
    return Disturbed(replace(large, depth=np.where(large.region, np.float32(0), depth)), sample.region)


def _enlarged(sample: Sample) -> Sample:
    """Return the frame with :data:`WIDE` columns: depth and masks by repetition, colour smoothly."""
    size = (round(WIDE * sample.depth.shape[0] / sample.depth.shape[1]), WIDE)
    large = _each(sample, lambda a: a if a.ndim == 3 else _resize(a, size))
    return replace(large, rgb=cv2.resize(sample.rgb, size[::-1], interpolation=cv2.INTER_CUBIC))


WIDE = 1024  # columns of a picture with sparse readings
SPARSE = ("300 readings", "16 scan lines")
DISTURBANCES: dict[str, Callable[[Sample], Disturbed]] = {
    **{f"room at {metres} m": partial(room_behind, metres=metres) for metres in (2, 4, 10)},
    **{f"{count} far strays": partial(far_strays, count=count) for count in (10, 50, 250)},
    "50 near strays": partial(near_strays, count=50),
    **{f"turned by {90 * k}": partial(quarter_turns, quarters=k) for k in (1, 2, 3)},
    **{f"distance x {factor}": partial(farther, factor=factor) for factor in (0.1, 3)},
    "300 readings": partial(few_readings, count=300),
    "16 scan lines": partial(scan_lines, count=16),
}
REGIONS = ("found", "given")  # by stage one, or the true one


def run_disturbances(
    ditr: Ditr,
    samples: Sequence[Sample],
    disturbances: Mapping[str, Callable[[Sample], Disturbed]] = DISTURBANCES,
    progress: bool = True,
) -> dict[str, Any]:
    """Score the system on frames as they are and disturbed, with the region found by stage one and given.

    Args:
        ditr: the system.
        samples: frames with truth and region.
        disturbances: as :data:`DISTURBANCES`.
        progress: show a bar.

    Returns:
        disturbance -> "found" and "given" -> the RMSE in metres inside the region, divided by the scale:
        ``disturbed_m``, ``undisturbed_m`` and, where readings are sparse, ``linear_m`` of linear interpolation, each
        one value a frame, None where nothing can be scored or no camera could give such depth.
    """
    rows = {name: {region: _empty_row(name) for region in REGIONS} for name in disturbances}
    for sample in tqdm(samples, desc="disturbances", unit="frame", **({} if progress else {"disable": True})):
        plain = {region: _completed(ditr, sample, region) for region in REGIONS}
        for name, disturb in disturbances.items():
            made = disturb(sample)
            for region in REGIONS:
                row = rows[name][region]
                seen = _can_be(made.frame)
                disturbed = _error(_completed(ditr, made.frame, region), made.frame, made.scale) if seen else None
                row["disturbed_m"].append(disturbed)
                row["undisturbed_m"].append(_error(plain[region], replace(sample, region=made.counterpart)))
                if "linear_m" in row:
                    row["linear_m"].append(_error(linear(made.frame), made.frame))
    return rows


def _can_be(frame: Sample) -> bool:
    """Return whether a camera could give this depth: a tenth of 8 cm is refused as a wrong unit."""
    return MIN_DEPTH_M <= np.median(frame.depth[frame.depth > 0]) < MAX_DEPTH_M


def _empty_row(name: str) -> dict[str, list]:
    return {key: [] for key in ("disturbed_m", "undisturbed_m", *["linear_m"] * (name in SPARSE))}


def _completed(ditr: Ditr, frame: Sample, region: str) -> np.ndarray:
    return ditr(frame.rgb, frame.depth, frame.region if region == "given" else None).depth


def _error(depth: np.ndarray, frame: Sample, scale: float = 1.0) -> float | None:
    """Return the RMSE in the frame's region, divided by the scale; None where it holds no truth."""
    scored = frame.region & (frame.depth_gt > 0)
    if not scored.any():
        return None
    return round(metrics.rmse(depth[scored], frame.depth_gt[scored]) / scale, 6)


def linear(frame: Sample) -> np.ndarray:
    """Return depth (H, W) that is interpolated linearly, inside the region, between the readings outside of it.

    Between the corners of a Delaunay triangulation; beyond its border, and in holes outside the region, the nearest
    reading counts. The result is dense.
    """
    places = np.argwhere((frame.depth > 0) & ~frame.region)
    readings = frame.depth[tuple(places.T)].astype(np.float64)
    wanted = np.argwhere(frame.region)
    found = LinearNDInterpolator(places, readings)(wanted)
    beyond = np.isnan(found)
    found[beyond] = NearestNDInterpolator(places, readings)(wanted[beyond])
    depth = REGISTRY["nearest"](frame.rgb, frame.depth, frame.region)
    depth[frame.region] = found
    return depth


def summarise_disturbances(rows: Mapping[str, Any]) -> dict[str, Any]:
    """Return disturbance -> region -> ``ratio`` of the errors and ``rmse_m``, both [mean, low, high], 95 %.

    Intervals are over frames and paired. Where readings are sparse also ``of_linear``, the error over that of linear
    interpolation, and ``linear_m``.
    """
    table: dict[str, Any] = {}
    for name, regions in rows.items():
        table[name] = {}
        for region, row in regions.items():
            disturbed = row["disturbed_m"]
            entry = {
                "ratio": interval(ratio_bootstrap, disturbed, row["undisturbed_m"], digits=4),
                "rmse_m": interval(bootstrap_mean, disturbed, digits=6),
            }
            if "linear_m" in row:
                entry["of_linear"] = interval(ratio_bootstrap, disturbed, row["linear_m"], digits=4)
                entry["linear_m"] = interval(bootstrap_mean, row["linear_m"], digits=6)
            table[name][region] = entry
    return table


def format_disturbances(table: Mapping[str, Any]) -> str:
    """Return :func:`summarise_disturbances`' table as text."""
    beside = "  over linear interpolation"
    width = max(len(name) for name in (*table, beside))
    lines = [" " * width + "".join(f"{f'region {r}: mm':>20}{'ratio to undisturbed':>24}" for r in REGIONS)]
    for name, regions in table.items():
        line = name.ljust(width)
        for region in REGIONS:
            entry = regions[region]
            level = "-" if entry["rmse_m"] is None else f"{1000 * entry['rmse_m'][0]:.1f}"
            line += level.rjust(20) + format_interval(entry["ratio"], style=".2f").rjust(24)
        lines.append(line)
        if "of_linear" in regions["found"]:
            line = beside.ljust(width)
            for region in REGIONS:
                entry = regions[region]
                level = "-" if entry["linear_m"] is None else f"{1000 * entry['linear_m'][0]:.1f}"
                line += level.rjust(20) + format_interval(entry["of_linear"], style=".2f").rjust(24)
            lines.append(line)
    return "\n".join(lines)


def _rng(sample: Sample, stream: int) -> np.random.Generator:
    """Return a generator that depends on the frame's content alone, so that a run can be repeated."""
    return np.random.default_rng([stream, int(sample.rgb.sum()), int((sample.depth > 0).sum())])


def _about_region(sample: Sample, high: int, wide: int) -> tuple[slice, slice]:
    """Return where to cut (high, wide) pixels out of the picture: about its region, as far as the border lets them."""
    height, width = sample.depth.shape
    v, u = _centre(sample)
    top = int(np.clip(v - high / 2, 0, height - high))
    left = int(np.clip(u - wide / 2, 0, width - wide))
    return np.s_[top : top + high, left : left + wide]


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
    if array.ndim == 2:
        return at_centres(array, size)
    how = cv2.INTER_AREA if array.shape[0] > size[0] else cv2.INTER_LINEAR
    return cv2.resize(array, size[::-1], interpolation=how)
