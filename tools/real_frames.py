"""Complete real frames, one by one: depth where its truth is known, and what moves where nothing should.

    python tools/real_frames.py FRAMES.py [--json ditr_lite/weights/results_real.json]

FRAMES.py is a file of the reader's own whose ``frames()`` yields real frames, see ``peers.compare.frames_of_file``: the
repository ships none. Baselines are given the region that stage one finds and are composed as DITR is.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

from readme_results import SETS

import ditr_lite as dl
from ditr_lite import metrics
from ditr_lite.baselines import REGISTRY
from ditr_lite.evaluation import results
from ditr_lite.evaluation.statistics import interval, paired_bootstrap
from ditr_lite.peers.compare import frames_of_file, moved_share, score_rendered
from ditr_lite.pipeline import compose

GIVEN = "ditr, true mask"
BASELINES = ("raw", "harmonic", "keep_and_fill", "keep_and_fill_debiased")
AGAINST = ("raw", "keep_and_fill", "keep_and_fill_debiased")


def complete_frame(ditr: dl.Ditr, sample: dl.Sample) -> dict[str, Any]:
    """Return what stage one claims of a frame, the share of readings that moved, and RMSE where the truth is known.

    Args:
        ditr: the system.
        sample: a frame; without ``region`` nothing is said of what is missed, without ``depth_gt`` nothing of errors.

    Returns:
        ``claimed``, share of the picture; ``missed``, of the true region, and ``area``, times the true one, or None;
        ``moved``, see ``peers.compare.moved_share``; ``rmse_m``, method -> pixel set -> metres, or None.
    """
    out = ditr(sample.rgb, sample.depth)
    row = {"claimed": float(out.region.mean()), "missed": None, "area": None, "rmse_m": None}
    if sample.region is not None:
        row["missed"] = metrics.miss_rate(out.region, sample.region)
        row["area"] = metrics.area_ratio(out.region, sample.region)
    row["moved"] = moved_share(out.depth, sample)
    if sample.depth_gt is None or sample.region is None:
        return row
    painted = {"ditr": out.depth, GIVEN: ditr(sample.rgb, sample.depth, region=sample.region).depth}
    for name in BASELINES:
        filled = REGISTRY[name](sample.rgb, sample.depth, out.region)
        painted[name] = compose(sample.depth, filled, filled, out.region)
    row["rmse_m"] = {name: score_rendered(depth, sample, SETS) for name, depth in painted.items()}
    return row


def summarise(frames: dict[str, dict]) -> dict[str, dict[str, list[float] | None]]:
    """Return baseline -> pixel set -> mean of DITR minus baseline in metres with its interval, paired over frames."""
    scored = [row["rmse_m"] for row in frames.values() if row["rmse_m"]]
    return {
        name: {key: interval(paired_bootstrap, *([r[m][key] for r in scored] for m in ("ditr", name))) for key in SETS}
        for name in (AGAINST if scored else ())
    }


def main(arguments: list[str] | None = None) -> int:
    """Complete the frames, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames", type=Path, help="a Python file whose frames() yields real frames")
    parser.add_argument("--weights", type=Path, help="weights folder (the shipped one)")
    parser.add_argument("--json", type=Path, default=results.results_path("real"), help="file to write")
    args = parser.parse_args(arguments)
    ditr, rows = dl.Ditr.from_pretrained(args.weights), {}
    for sample in frames_of_file(args.frames):
        row = rows[sample.name] = complete_frame(ditr, sample)
        errors = {name: row["rmse_m"][name]["optical"] for name in row["rmse_m"] or ()}
        print(sample.name, {k: v for k, v in row.items() if k != "rmse_m"}, errors, flush=True)
    command = results.tool_command("real_frames", [args.frames.name])  # where files lie decides nothing
    results.write(args.json, results.head(command, args.weights), {"frames": rows, "differences": summarise(rows)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
