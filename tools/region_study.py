"""What stage one's errors cost, what its refinement buys, and what fine-tuning through stage two changes.

    python tools/region_study.py [--data outputs/scenes/train] [--steps 150] [--json FILE]

One run makes the whole file, in half an hour to an hour on one core: the validation scenes are completed with the true
region shrunk and grown, then with the found region refined in several ways, then with stage one fine-tuned (Paper: Sec.
IV-B and V-B) in four ways: with the segmentation loss alone (the control), and with the final RMSE added, softly or
straight through, at two weights.
"""

import argparse
import copy
import sys
from pathlib import Path

import numpy as np
from torch import nn
from tqdm.auto import tqdm

import ditr_lite as dl
from ditr_lite.config import RefineConfig
from ditr_lite.evaluation import results, stage_one
from ditr_lite.evaluation.statistics import bootstrap_mean, format_interval, interval, paired_bootstrap
from ditr_lite.studies import regions
from ditr_lite.training import finetune
from ditr_lite.training.scenes import described, load_scenes

ROOT = Path(__file__).resolve().parents[1]
OFFSETS = (-4, -2, -1, 0, 1, 2, 4)
SETTINGS = tuple(RefineConfig(*k) for k in ((0, 0, 0), (3, 3, 1), (3, 3, 3), (7, 5, 1), (7, 5, 3)))
VARIANTS = {  # name -> weight of the RMSE per metre, straight through
    "segmentation loss alone": (0.0, False),
    "with RMSE, weight 1, soft": (1.0, False),
    "with RMSE, weight 20, soft": (20.0, False),
    "with RMSE, weight 20, straight through": (20.0, True),
}
MEASURED = ("optical_m", "whole_m", "miss_rate", "area_ratio", "iou")


def study_errors(ditr, samples) -> dict:
    """Return the cost of a region that is off, per offset: mean and 95 % interval over scenes, and every scene."""
    rows = {s.name: regions.region_costs(ditr, s, OFFSETS) for s in tqdm(samples, desc="regions that are off")}
    return _table(rows, [str(k) for k in OFFSETS], ("optical_m", "whole_m", "missed_m", "discarded_m"))


def study_refinement(ditr, samples) -> dict:
    """Return what each setting of the refinement leads to, with the region that stage one finds."""
    rows = {s.name: regions.refinement_costs(ditr, s, SETTINGS) for s in tqdm(samples, desc="refinements")}
    names = [f"{r.median}/{r.dilate}/{r.iterations}" for r in SETTINGS]
    return _table(rows, names, ("miss_rate", "area_ratio", "optical_m", "whole_m"))


def study_finetuning(ditr, samples, data: Path, limit: int, steps: int, batch: int, seed: int) -> dict:
    """Return the measures of the validation scenes before and after each variant, and the paired differences."""
    scenes = load_scenes(data, limit)
    paints = finetune.whole_frames(finetune.frame_painters(ditr.parts, ditr.config), ditr.config, seed)
    before = measure(ditr, samples)
    out = {
        "learnt_from": described(scenes),
        "scenes": len(scenes),
        "steps": steps,
        "batch": batch,
        "rate": finetune.RATE,
        "seed": seed,
        "before": before,
    }
    for name, (weight, straight_through) in VARIANTS.items():
        model = copy.deepcopy(ditr.parts["region"])
        how = {"batch": batch, "seed": seed}
        curve = finetune.finetune_region(model, scenes, paints, ditr.config, steps, weight, straight_through, **how)
        model.eval().requires_grad_(False)
        tuned = dl.Ditr(nn.ModuleDict({**ditr.parts, "region": model}), ditr.config)
        after = measure(tuned, samples)
        first, last = (
            np.mean([r["rmse_m"] for r in part]) for part in (curve[: steps // 4 or 1], curve[-steps // 4 :])
        )
        changes = {k: interval(paired_bootstrap, after[k], before[k], digits=5) for k in MEASURED}
        out[name] = {"rmse_weight": weight, "straight_through": straight_through, "after": after, "change": changes}
        out[name]["training_rmse_m"] = [round(float(first), 5), round(float(last), 5)]
    return out


def measure(ditr, samples) -> dict[str, list]:
    """Return every scene's final error and stage one's figures, one draw a scene."""
    values = {k: [] for k in MEASURED}
    for s in tqdm(samples, desc="validation scenes", leave=False):
        out = ditr(s.rgb, s.depth, samples=1)
        scores = dl.metrics.evaluate(out.depth, s.depth_gt, s.region, s.depth)
        row = {f"{k}_m": scores[k] and scores[k]["rmse"] for k in ("optical", "whole")}
        row |= stage_one.mask_errors(out.region, s.region)
        row["iou"] = dl.metrics.iou(out.probability > ditr.config.refine.threshold, s.region)
        for key, value in row.items():
            values[key].append(_round(value))
    return values


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=ROOT / "outputs/scenes/train", help="scenes to fine-tune on")
    parser.add_argument("--limit", type=int, default=200, help="use only the first of them (%(default)s)")
    parser.add_argument("--val", type=int, default=48, help="how many validation scenes to measure (%(default)s)")
    parser.add_argument("--steps", type=int, default=150, help="of fine-tuning, per variant (%(default)s)")
    parser.add_argument("--batch", type=int, default=4, help="scenes a step; the paper's is 16 (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, default=results.results_path("region"), help="file to write")
    args = parser.parse_args(arguments)
    ditr = dl.Ditr.from_pretrained()
    samples = [dl.load_sample(name) for name in dl.list_samples("val")[: args.val]]
    samples = [s for s in samples if s.region.any()]
    words = sys.argv[1:] if arguments is None else arguments
    shipped = "/".join(str(getattr(ditr.config.refine, k)) for k in ("median", "dilate", "iterations"))
    begin = results.head(results.tool_command("region_study", words), shipped=shipped, names=[s.name for s in samples])
    found = {
        "errors": study_errors(ditr, samples),
        "refinement": study_refinement(ditr, samples),
        "finetuning": study_finetuning(ditr, samples, args.data, args.limit, args.steps, args.batch, args.seed),
    }
    results.write(args.json, begin, found)
    print(report(begin | found))
    return 0


def report(result: dict) -> str:
    """Return the figures as text: metres and shares, mean and 95 % interval over scenes."""
    lines = [f"{len(result['names'])} validation scenes; metres and shares, mean [95 % interval]"]
    for part in ("errors", "refinement"):
        for name, row in result[part].items():
            cells = (f"{k} {format_interval(v['mean'], 1, '.3f')}" for k, v in row.items())
            lines.append(f"{part} {name:8} " + ", ".join(cells))
    for name in VARIANTS:
        change = result["finetuning"][name]["change"]
        lines.append(f"{name}: " + ", ".join(f"{k} {format_interval(v, 1, '+.3f')}" for k, v in change.items()))
    return "\n".join(lines)


def _table(rows: dict, names: list[str], keys: tuple[str, ...]) -> dict:
    table = {}
    for k, name in enumerate(names):
        each = {key: [_round(row[k][key]) for row in rows.values()] for key in keys}
        table[name] = {
            key: {"mean": interval(bootstrap_mean, values, digits=5), "scenes": values} for key, values in each.items()
        }
    return table


def _round(value: float | None) -> float | None:
    return value if value is None else round(value, 5)


if __name__ == "__main__":
    sys.exit(main())
