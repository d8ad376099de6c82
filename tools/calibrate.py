"""Fit what the shipped system says of itself on validation scenes, and check it on the test splits.

    python tools/calibrate.py [--fit val rooms_val] [--check test rooms] [--enter] [--json FILE]

Fitted, in this order: ``refine.temperature``, so that stage one's probability means what it says; then ``std``: of each
branch the share of the depth and the multiple of the spread that make up the stated error, and of readings that were
kept what they are off, on plain surfaces and on glass that stage one has missed. Prints what to write into
``config.PRESETS["lite"]``; ``--enter`` writes it into the card of the weights, which is what is read.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

import ditr_lite as dl
from ditr_lite.config import Config, StdConfig, to_dict
from ditr_lite.data import Sample
from ditr_lite.evaluation import results, uncertainty
from ditr_lite.evaluation.uncertainty import KEPT
from ditr_lite.files import written_whole
from ditr_lite.pipeline import Ditr
from ditr_lite.stage_two import BRANCHES
from ditr_lite.store import CARD, WEIGHTS, read_card

LEAST = 1e-30  # probabilities below this count as this
DIGITS = 4


def some_samples(splits: list[str], limit: int | None = None) -> list[Sample]:
    """Return the first scenes of each split."""
    return [dl.load_sample(name) for split in splits for name in dl.list_samples(split)[:limit]]


def with_config(ditr: Ditr, **changes) -> Ditr:
    """Return the same networks with other settings of their use."""
    return Ditr(ditr.parts, replace(ditr.config, **changes))


def fitted_temperature(ditr: Ditr, samples: list[Sample]) -> float:
    """Return the temperature that fits stage one's probabilities to the samples' regions best."""
    plain = with_config(ditr, refine=replace(ditr.config.refine, temperature=1.0))
    logs, truths = [], []
    for sample in tqdm(samples, desc="temperature", unit="frame"):
        frame, classes = plain.classify(sample.rgb, sample.depth)
        logs.append(np.log(np.maximum(classes, LEAST))[:, frame.picture])
        truths.append(frame.into(sample.region)[frame.picture])
    return round(uncertainty.fit_temperature(np.concatenate(logs, axis=1), np.concatenate(truths)), DIGITS)


def collect(ditr: Ditr, samples: list[Sample]) -> dict[str, np.ndarray]:
    """Return branch, or "kept" -> (4, N): error, stated error, depth and stage one's probability where truth is known.

    Errors, stated ones and depth are in metres.
    """
    found = {kind: [] for kind in (*BRANCHES, KEPT)}
    for sample in tqdm(samples, desc="completing", unit="frame"):
        out = ditr(sample.rgb, sample.depth)
        known = sample.depth_gt > 0
        for kind, where in uncertainty.pixel_sets(out.region, sample.depth).items():
            at = where & known
            columns = (out.depth - sample.depth_gt, out.std, out.depth, out.probability)
            found[kind].append(np.stack([column[at] for column in columns]))
    return {kind: np.concatenate(parts, axis=1) for kind, parts in found.items()}


def fitted_std(rows: dict[str, np.ndarray]) -> StdConfig:
    """Return the constants that fit :func:`collect`'s rows of a system whose stated error is the spread alone."""
    pairs = [uncertainty.fit_error(*rows[branch][:3]) for branch in BRANCHES]
    base, factor = (tuple(round(v, DIGITS) for v in column) for column in zip(*pairs, strict=True))
    error, _, depth, doubt = rows[KEPT]
    kept, missed = uncertainty.fit_kept(error, depth, doubt)
    return StdConfig(base, factor, round(kept, DIGITS), round(missed, DIGITS))


def checked(ditr: Ditr, samples: list[Sample]) -> dict[str, dict]:
    """Return how the stated error fits, per branch and for readings that were kept."""
    report = {}
    for kind, (error, std, _, _) in collect(ditr, samples).items():
        report[kind] = {
            "pixels": len(error),
            "reliability": uncertainty.coverages(error, std),
            "risk_coverage": uncertainty.risk_coverage(error, std),
            "crps_m": uncertainty.gaussian_crps(error, np.maximum(std, 1e-6)),
        }
    return report


def format_check(report: dict[str, dict], title: str) -> str:
    """Return the coverage of every kind of pixel as text."""
    lines = []
    for kind, row in report.items():
        shares = ", ".join(f"{k:g} std: {seen:.0%} (of {due:.0%})" for k, due, seen in row["reliability"])
        lines.append(f"{title}, {kind}: {shares}; CRPS {1000 * row['crps_m']:.1f} mm")
    return "\n".join(lines)


def enter(config: Config, weights: Path | None) -> None:
    """Write a configuration into the card of the weights."""
    path = Path(weights or WEIGHTS) / CARD
    card = read_card(weights) | {"config": to_dict(config)}
    with written_whole(path) as part:
        part.write_text(json.dumps(card, indent=1) + "\n")


def main(arguments: list[str] | None = None) -> int:
    """Fit, check, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fit", nargs="+", default=["val", "rooms_val"], help="splits to fit on (%(default)s)")
    parser.add_argument("--check", nargs="*", default=["test", "rooms"], help="splits to check on (%(default)s)")
    parser.add_argument("--limit", type=int, help="only the first frames of each split")
    parser.add_argument("--weights", type=Path, help="weights folder (the shipped one)")
    parser.add_argument("--enter", action="store_true", help="write the constants into the card of the weights")
    parser.add_argument("--json", type=Path, default=results.results_path("calibration"))
    words = sys.argv[1:] if arguments is None else arguments
    args = parser.parse_args(words)
    uncertainty.check_fitted_on(args.fit)
    shipped = dl.Ditr.from_pretrained(args.weights)
    samples = some_samples(args.fit, args.limit)
    refine = replace(shipped.config.refine, temperature=fitted_temperature(shipped, samples))
    plain = with_config(shipped, refine=refine, std=StdConfig())
    std = fitted_std(collect(plain, samples))
    calibrated = with_config(plain, std=std)
    print(f'for config.PRESETS["lite"]:\n    refine={refine!r},\n    std={std!r},')
    print(f"in the card:\n    refine={shipped.config.refine!r},\n    std={shipped.config.std!r},")
    report = {"fit": args.fit, "refine": vars(refine), "std": vars(std)}
    for split in args.check:
        frames = some_samples([split], args.limit)
        found = {"frames": len(frames)}
        for kind, system in (("calibrated", calibrated), ("spread alone", plain)):
            found[kind] = checked(system, frames)
            print(format_check(found[kind], f"{split}, {kind}"))
        report |= found if split == "test" else {split: found}
    if args.enter:
        enter(calibrated.config, args.weights)
    results.write(args.json, results.head(results.tool_command("calibrate", words), args.weights), report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
