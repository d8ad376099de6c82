"""Fit the stated error of the shipped system on the validation split, and check it on the test split.

python tools/calibrate.py [--json ditr_lite/weights/results_calibration.json]

Prints ``StdConfig`` constants for the ``lite`` preset (config.py) and the weights' card, and writes how well the
constants that are in the card now cover the test split. So: run, enter the constants, run again.
"""

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

import ditr_lite as dl
from ditr_lite.config import StdConfig
from ditr_lite.evaluation import uncertainty
from ditr_lite.files import write_json
from ditr_lite.pipeline import Ditr
from ditr_lite.store import read_card

BRANCHES = ("optical", "geometric")


def collect(ditr: Ditr, split: str, limit: int | None = None) -> dict[str, np.ndarray]:
    """Return branch -> (3, N): error, stated error and depth, metres, of all painted pixels whose truth is known."""
    found = {branch: [] for branch in BRANCHES}
    for name in tqdm(dl.list_samples(split)[:limit], desc=split, unit="frame"):
        sample = dl.load_sample(name)
        out = ditr(sample.rgb, sample.depth)
        known = sample.depth_gt > 0
        for branch, where in zip(BRANCHES, (out.region, ~out.region & (sample.depth == 0)), strict=True):
            at = where & known
            found[branch].append(np.stack([(out.depth - sample.depth_gt)[at], out.std[at], out.depth[at]]))
    return {branch: np.concatenate(parts, axis=1) for branch, parts in found.items()}


def main() -> None:
    """Fit, check, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--limit", type=int, help="only the first frames of each split")
    parser.add_argument("--json", type=Path, default=Path("ditr_lite/weights/results_calibration.json"))
    args = parser.parse_args()
    ditr = dl.Ditr.from_pretrained()
    plain = Ditr(ditr.parts, replace(ditr.config, std=StdConfig()))
    fitted = {b: uncertainty.fit_error(*rows) for b, rows in collect(plain, "val", args.limit).items()}
    print("fitted on validation:", {b: tuple(round(v, 4) for v in pair) for b, pair in fitted.items()})
    print("in the card:         ", ditr.config.std)
    report = {"frames": len(dl.list_samples("test")[: args.limit]), "std": vars(ditr.config.std), "fitted": fitted}
    for kind, system in (("calibrated", ditr), ("spread alone", plain)):
        report[kind] = {}
        for branch, (error, std, _) in collect(system, "test", args.limit).items():
            row = {
                "pixels": len(error),
                "reliability": uncertainty.reliability(error, std),
                "risk_coverage": uncertainty.risk_coverage(error, std),
                "crps_m": uncertainty.gaussian_crps(error, np.maximum(std, 1e-6)),
            }
            report[kind][branch] = row
            shares = ", ".join(f"{k:g} std: {seen:.0%} (of {due:.0%})" for k, due, seen in row["reliability"])
            print(f"test, {kind}, {branch}: {shares}; CRPS {1000 * row['crps_m']:.1f} mm")
    checksums = {name: part["sha256"] for name, part in read_card()["parts"].items()}
    write_json(args.json, {"command": shlex.join(["python", *sys.argv]), "weights_sha256": checksums, **report})


if __name__ == "__main__":
    main()
