"""Score one to a thousand denoising steps, and single samples beside their mean, on validation scenes.

python tools/step_study.py [--json ditr_lite/weights/results_steps.json]

About a quarter of an hour on one core. The region is found by stage one; the default number of steps was chosen here.
"""

import argparse
import sys
from pathlib import Path

import ditr_lite as dl
from ditr_lite.evaluation import results
from ditr_lite.studies import steps as steps_study


def main() -> None:
    """Parse the arguments, draw, score, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, default=results.results_path("steps"))
    args = parser.parse_args()
    ditr = dl.Ditr.from_pretrained()
    frames = max(n for n, _ in steps_study.PLAN.values())
    samples = [dl.load_sample(name) for name in dl.list_samples("val")[:frames]]
    default = {"steps": ditr.config.sampler.steps, "samples": ditr.config.sampler.samples}
    begin = results.head(results.tool_command("step_study", sys.argv[1:]), split="val", default=default)

    def draw(sample, steps: int, seed: int):
        return ditr(sample.rgb, sample.depth, steps=steps, samples=1, seed=seed).depth

    def save(rows: dict) -> None:
        results.write(args.json, begin, {"rows": rows})
        print(list(rows)[-1], "steps done", flush=True)

    rows = steps_study.run_plan(draw, samples, save=save)
    for key in steps_study.SETS:
        print(steps_study.format_steps(rows, key), end="\n\n")
    print(steps_study.format_flying(rows), steps_study.verdicts(rows), sep="\n\n")


if __name__ == "__main__":
    main()
