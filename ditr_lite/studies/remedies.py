"""From symptom to knob: what turning one knob does to frames that show the symptom, on pixels where it shows.

The frames are of the second simulator (rooms), whose pictures are nearest to those of a camera on a desk. Each has its
truth, so a remedy is not recommended because it sounds right: it is scored beside doing nothing.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt
from tqdm.auto import tqdm

from .. import metrics
from ..baselines import nearest
from ..boundary import boundary_maps
from ..config import RefineConfig
from ..data import Sample
from ..evaluation.statistics import format_interval, interval, mean_known, paired_bootstrap
from ..pipeline import Ditr
from ..units import without_strays
from ..windows import box_around, largest_piece
from .robustness import depth_noise, far_strays

SHIFT = 0.04  # of the width: by how much depth is misaligned
NOISE = 0.02  # of the depth: raw noise that is kept
NEAR = 2  # pixels within which a depth edge agrees with a colour edge
STRAYS = 50


def edge_agreement(m_rgb: np.ndarray, m_d: np.ndarray, shifts: Sequence[int]) -> np.ndarray:
    """Return, for each shift of depth to the right, the share of depth edges within two pixels of a colour edge.

    It needs no truth: where it peaks, depth and colour are aligned.

    Args:
        m_rgb: (H, W) bool, boundaries of the colour picture.
        m_d: (H, W) bool, those of the depth map.
        shifts: in pixels; negative is to the left.

    Returns:
        (N,) shares, 0 where there is no depth edge.
    """
    if not m_d.any() or not m_rgb.any():
        return np.zeros(len(shifts))
    away = distance_transform_edt(~m_rgb)
    return np.array([(away[moved_sideways(m_d, shift)] <= NEAR).sum() for shift in shifts]) / m_d.sum()


def aligned_by_edges(ditr: Ditr, rgb: np.ndarray, depth: np.ndarray, reach: int) -> np.ndarray:
    """Return depth moved sideways, by at most ``reach`` pixels, to where its edges agree best with those of colour."""
    m_rgb, m_d, _ = boundary_maps(rgb, depth, ditr.backend)
    shifts = np.arange(-reach, reach + 1)
    best = int(shifts[edge_agreement(m_rgb, m_d, shifts).argmax()])
    return moved_sideways(depth, best)


def moved_sideways(image: np.ndarray, by: int) -> np.ndarray:
    """Return an image (H, W) moved ``by`` pixels to the right; 0 comes in, and what leaves is lost."""
    moved = np.zeros_like(image)
    width = image.shape[1]
    moved[:, max(by, 0) : width + min(by, 0)] = image[:, max(-by, 0) : width - max(by, 0)]
    return moved


def completed_as_crop(ditr: Ditr, sample: Sample) -> np.ndarray:
    """Return the completion of a frame whose largest piece of the true region was completed apart, in a crop."""
    whole = ditr(sample.rgb, sample.depth).depth
    box = box_around(largest_piece(sample.region))
    whole[box] = ditr(np.ascontiguousarray(sample.rgb[box]), np.ascontiguousarray(sample.depth[box])).depth
    return whole


def _shifted(sample: Sample) -> np.ndarray:
    return moved_sideways(sample.depth, round(SHIFT * sample.depth.shape[1]))


def _aligned(ditr: Ditr, sample: Sample) -> np.ndarray:
    return aligned_by_edges(ditr, sample.rgb, _shifted(sample), 2 * round(SHIFT * sample.depth.shape[1]))


def _with(ditr: Ditr, sample: Sample, **how) -> np.ndarray:
    return ditr(sample.rgb, sample.depth, **how).depth


def _noisy(ditr: Ditr, sample: Sample, adjust: bool) -> np.ndarray:
    return ditr(sample.rgb, depth_noise(sample, NOISE).depth, adjust=adjust).depth


def _blind(sample: Sample) -> np.ndarray:
    return np.where(sample.region, np.float32(0), sample.depth)


# name -> completed depth (H, W) of a sample; a run is made once a frame, however many remedies compare it
RUNS: Mapping[str, Callable[[Ditr, Sample], np.ndarray]] = {
    "as it is": _with,
    "wrong unit": lambda ditr, s: ditr(s.rgb, s.depth / 4).depth,
    "misaligned": lambda ditr, s: ditr(s.rgb, _shifted(s)).depth,
    "aligned by edges": lambda ditr, s: ditr(s.rgb, _aligned(ditr, s)).depth,
    "holes filled before": lambda ditr, s: ditr(s.rgb, nearest(s.rgb, s.depth)).depth,
    "threshold 0.2": partial(_with, threshold=0.2),
    "threshold 0.8": partial(_with, threshold=0.8),
    "unrefined": partial(_with, refine=RefineConfig(median=0, dilate=0, iterations=0)),
    "paper's kernels": partial(_with, refine=RefineConfig(median=7, dilate=5, iterations=3)),
    "region given": lambda ditr, s: ditr(s.rgb, s.depth, s.region).depth,
    "region given, its readings removed": lambda ditr, s: ditr(s.rgb, _blind(s), s.region).depth,
    "noisy": partial(_noisy, adjust=False),
    "noisy, adjusted": partial(_noisy, adjust=True),
    "cropped": completed_as_crop,
    "10 steps, 4 samples": partial(_with, steps=10, samples=4),
    "with strays": lambda ditr, s: ditr(s.rgb, far_strays(s, STRAYS).frame.depth).depth,
    "strays removed": lambda ditr, s: ditr(s.rgb, without_strays(far_strays(s, STRAYS).frame.depth)).depth,
}
# name -> the pixels on which a remedy is scored
PIXELS: Mapping[str, Callable[[Sample], np.ndarray]] = {
    "everywhere": lambda s: np.ones(s.depth.shape, bool),
    "in the region": lambda s: s.region,
    "outside it": lambda s: ~s.region,
    "holes outside it": lambda s: ~s.region & (s.depth == 0),
    "at the strays": lambda s: far_strays(s, STRAYS).frame.depth != s.depth,
}


@dataclass(frozen=True)
class Remedy:
    """What is seen, what to turn, and which two runs are compared where."""

    symptom: str
    knob: str
    before: str
    after: str
    where: str


REMEDIES = (
    Remedy("all distances off by one factor", "`--depth-scale`", "wrong unit", "as it is", "everywhere"),
    Remedy("ghosts beside objects", "align depth to colour", "misaligned", "aligned by edges", "everywhere"),
    Remedy(
        "flat patches that never change",
        "switch hole filters off",
        "holes filled before",
        "as it is",
        "holes outside it",
    ),
    Remedy("glass keeps its wrong depth", "`threshold=0.2`", "as it is", "threshold 0.2", "in the region"),
    Remedy("the price of that", "`threshold=0.2`", "as it is", "threshold 0.2", "outside it"),
    Remedy("glass keeps its wrong depth", "larger kernels, `refine=`", "as it is", "paper's kernels", "in the region"),
    Remedy("the price of that", "larger kernels, `refine=`", "as it is", "paper's kernels", "outside it"),
    Remedy("glass keeps its wrong depth", "draw it, `region=`", "as it is", "region given", "in the region"),
    Remedy("opaque things were repainted", "`threshold=0.8`", "as it is", "threshold 0.8", "outside it"),
    Remedy("opaque things were repainted", "no kernels, `refine=`", "as it is", "unrefined", "outside it"),
    Remedy("opaque things were repainted", "draw it, `region=`", "as it is", "region given", "outside it"),
    Remedy(
        "region right, body too far",
        "set its readings to 0",
        "region given",
        "region given, its readings removed",
        "in the region",
    ),
    Remedy("speckles outside the region", "`adjust=True`", "noisy", "noisy, adjusted", "outside it"),
    Remedy("single points in the air", "`units.without_strays`", "with strays", "strays removed", "at the strays"),
    Remedy("glass painted coarsely", "crop around it", "as it is", "cropped", "in the region"),
    Remedy("steps in filled holes", "crop around them", "as it is", "cropped", "holes outside it"),
    Remedy("glass painted wrongly", "`steps=10, samples=4`", "as it is", "10 steps, 4 samples", "in the region"),
)


def remedy_errors(ditr: Ditr, sample: Sample, remedies: Sequence[Remedy] = REMEDIES) -> list[dict[str, float | None]]:
    """Return, for each remedy, the RMSE in metres ``before_m`` and ``after_m`` on one frame; None without such pixels.

    Args:
        ditr: the system.
        sample: with truth and region.
        remedies: which.
    """
    done: dict[str, np.ndarray] = {}
    rows = []
    for remedy in remedies:
        pixels = PIXELS[remedy.where](sample) & (sample.depth_gt > 0)
        row: dict[str, float | None] = {"before_m": None, "after_m": None}
        if pixels.any():
            for key, name in (("before_m", remedy.before), ("after_m", remedy.after)):
                if name not in done:
                    done[name] = RUNS[name](ditr, sample)
                row[key] = round(metrics.rmse(done[name], sample.depth_gt, pixels), 5)
        rows.append(row)
    return rows


def score_remedies(ditr: Ditr, samples: Sequence[Sample]) -> list[dict[str, Any]]:
    """Score every remedy on every frame.

    Args:
        ditr: the system.
        samples: with truth and region.

    Returns:
        for each of :data:`REMEDIES` its texts, the errors ``before_m`` and ``after_m``, one a frame, and ``minus_m``,
        the mean of after - before with its paired 95 % interval; None where no frame has such pixels.
    """
    scored = [remedy_errors(ditr, sample) for sample in tqdm(samples, desc="frames", unit="frame")]
    rows = []
    for k, remedy in enumerate(REMEDIES):
        before, after = ([frame[k][key] for frame in scored] for key in ("before_m", "after_m"))
        minus = interval(paired_bootstrap, after, before, digits=5)
        texts = {key: getattr(remedy, key) for key in ("symptom", "knob", "where")}
        rows.append({**texts, "before_m": before, "after_m": after, "minus_m": minus})
    return rows


def effect(minus_m: Sequence[float] | None) -> str:
    """Return in one word or two what an interval of after - before says of a remedy."""
    if minus_m is None:
        return "not measured"
    _, low, high = minus_m
    return "helps" if high < 0 else "costs" if low > 0 else "not clear"


def remedy_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows of :func:`score_remedies` as a Markdown table, millimetres."""
    lines = ["| symptom | knob | scored | before, mm | after, mm | difference, mm [95 %] | verdict |"]
    lines.append("|---|---|---|---:|---:|---:|---|")
    for row in rows:
        before, after = (mean_known(row[key]) for key in ("before_m", "after_m"))
        numbers = ["-" if mean is None else f"{1000 * mean:.1f}" for mean in (before, after)]
        cells = [row["symptom"], row["knob"], row["where"], *numbers, format_interval(row["minus_m"], 1000)]
        lines.append(f"| {' | '.join(cells)} | {effect(row['minus_m'])} |")
    return "\n".join(lines)
