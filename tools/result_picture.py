"""Draw the README's picture by a rule, so that nobody picked it.

python tools/result_picture.py [--json ditr_lite/weights/results_test.json] [--out data_samples/result.png]

Of the test scenes whose transparent and reflective things cover at least a twentieth of the image, those at a quarter,
a half and three quarters of the ranking by DITR's optical error; each is cut to these things and a margin.
"""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import ditr_lite as dl
from ditr_lite import metrics, viz
from ditr_lite.data import Sample
from ditr_lite.files import written_whole
from ditr_lite.viz.panels import WIDTH_IN, add_bar

LEAST = 0.05  # share of the image
AT = (0.25, 0.5, 0.75)  # of the ranking
ERROR_MM = 80.0


def chosen(rmse_m: Mapping[str, Mapping[str, Mapping[str, float | None]]], share: Mapping[str, float]) -> list[str]:
    """Return the names of the scenes to show, from every scene's optical RMSE and the share that its region covers."""
    ranked = sorted((row["ditr"]["optical"], name) for name, row in rmse_m.items() if share[name] >= LEAST)
    return [ranked[round(at * (len(ranked) - 1))][1] for at in AT]


def cut(region: np.ndarray) -> tuple[slice, slice]:
    """Return rows and columns of the region's bounding box, widened to four by three and a margin."""
    rows, cols = np.nonzero(region)
    height, width = (int(1.4 * (np.ptp(along) + 1)) for along in (rows, cols))
    height = min(max(height, width * 3 // 4, 60), region.shape[0])
    width = min(max(width, height * 4 // 3), region.shape[1])
    centres = (np.ptp(rows) // 2 + rows.min(), np.ptp(cols) // 2 + cols.min())
    starts = (
        int(np.clip(c - n // 2, 0, full - n)) for c, n, full in zip(centres, (height, width), region.shape, strict=True)
    )
    return tuple(slice(start, start + n) for start, n in zip(starts, (height, width), strict=True))


def off_mm(depth: np.ndarray, truth: np.ndarray, region: np.ndarray) -> float:
    """Return the root mean square error in the region, where there is depth."""
    read = region & (depth > 0)
    return 1000 * metrics.rmse(np.where(read, depth, 1), truth, read) if (truth[read] > 0).any() else np.nan


def draw(samples: list[Sample], depths: list[np.ndarray]) -> viz.Picture:
    """Draw a row a scene: colour, raw, completed and true depth, and the error of the completed one."""
    picture = viz.Picture(WIDTH_IN, 2.0 * len(samples))
    axes = picture.subplots(len(samples), 5, squeeze=False)
    for row, sample, depth in zip(axes, samples, depths, strict=True):
        at = cut(sample.region)
        truth, raw, completed, region = (m[at] for m in (sample.depth_gt, sample.depth, depth, sample.region))
        limits = viz.depth_limits(truth)
        viz.rgb(row[0], sample.rgb[at], region, sample.name)
        viz.depth(row[1], raw, limits, f"raw: where read, {off_mm(raw, truth, region):.0f} mm off in glass", bar=False)
        viz.depth(row[2], completed, limits, f"DITR: {off_mm(completed, truth, region):.0f} mm off in glass", bar=False)
        viz.depth(row[3], truth, limits, "truth", bar=False)
        image = viz.error(row[4], completed, truth, ERROR_MM, "DITR's error", bar=False)
        add_bar(picture, image, row[4], "error")
    return picture


def main() -> None:
    """Choose, complete, draw and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, default=Path("ditr_lite/weights/results_test.json"))
    parser.add_argument("--out", type=Path, default=Path("data_samples/result.png"))
    args = parser.parse_args()
    rmse_m = json.loads(args.json.read_text(encoding="utf-8"))["rmse_m"]
    names = chosen(rmse_m, {name: float(dl.load_sample(name).region.mean()) for name in rmse_m})
    samples, ditr = [dl.load_sample(name) for name in names], dl.Ditr.from_pretrained()
    picture = draw(samples, [ditr(s.rgb, s.depth).depth for s in samples])
    with written_whole(args.out) as part:
        Path(part).write_bytes(picture.png())
    print(f"{args.out}: {', '.join(names)}")


if __name__ == "__main__":
    main()
