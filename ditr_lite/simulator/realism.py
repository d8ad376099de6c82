"""How raw depth fails, in numbers: the same statistics of a frame whether it was rendered or recorded.

They decide whether the simulator may be trusted: every real frame should lie inside the spread of the simulated ones.
"""

import numpy as np

from ..data import Sample

STATISTICS = {
    "missing_outside": "share of pixels without a reading, outside the region",
    "missing_inside": "share of pixels without a reading, inside the region",
    "bias_inside_m": "mean of raw - truth where a reading survives inside the region, metres",
    "bias_inside_median_m": "median of the same, metres",
    "rmse_inside_m": "root mean square of raw - truth there, metres",
    "mae_outside_m": "mean |raw - truth| outside the region, metres",
    "noise_outside": "median |raw - truth| / truth^2 outside the region, 1/m (stereo noise grows with z squared)",
    "beyond_twice_median": "share of the readings that are beyond twice the median reading: far walls, and strays",
    "region_share": "share of the image that is transparent or reflective",
    "distance_m": "median true depth, metres",
}


def frame_statistics(sample: Sample) -> dict[str, float]:
    """Return the :data:`STATISTICS` of one frame; NaN where the frame has no such pixels.

    Raises:
        ValueError: for a sample without ground truth or region.
    """
    if sample.depth_gt is None or sample.region is None:
        raise ValueError(f"sample {sample.name!r} needs ground truth and a region for its statistics")
    raw, gt, region = sample.depth, sample.depth_gt, sample.region
    read = raw[raw > 0]
    both = (raw > 0) & (gt > 0)
    inside, outside = (raw - gt)[both & region], (raw - gt)[both & ~region]
    return {
        "missing_outside": _mean(raw[~region] == 0),
        "missing_inside": _mean(raw[region] == 0),
        "bias_inside_m": _mean(inside),
        "bias_inside_median_m": _median(inside),
        "rmse_inside_m": _mean(inside**2) ** 0.5,
        "mae_outside_m": _mean(np.abs(outside)),
        "noise_outside": _median(np.abs(outside) / gt[both & ~region] ** 2),
        "beyond_twice_median": _mean(read > 2 * _median(read)),
        "region_share": float(region.mean()),
        "distance_m": _median(gt[gt > 0]),
    }


def compare_with_real(simulated: list[Sample], real: list[Sample]) -> str:
    """Return a table: percentiles of the simulated frames, each real frame, and whether it lies between the outer two.

    Args:
        simulated: frames whose 5th, 50th and 95th percentiles are shown.
        real: frames to hold against them; may be empty.
    """
    rows = [frame_statistics(s) for s in simulated]
    frames = [frame_statistics(s) for s in real]
    names = "".join(f"{s.name[-12:]:>14}" for s in real)
    width = max(map(len, STATISTICS)) + 1
    lines = [f"{'statistic':<{width}}{'5 %':>9}{'50 %':>9}{'95 %':>9}{names}   inside"]
    for key in STATISTICS:
        low, middle, high = np.nanpercentile([r[key] for r in rows], [5, 50, 95])
        values = [f[key] for f in frames]
        verdict = " ".join("yes" if low <= v <= high else "NO" for v in values)
        line = f"{key:<{width}}{low:>9.4f}{middle:>9.4f}{high:>9.4f}" + "".join(f"{v:>14.4f}" for v in values)
        lines.append(f"{line}   {verdict}".rstrip())
    return "\n".join(lines)


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if values.size else float("nan")
