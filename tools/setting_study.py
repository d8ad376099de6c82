"""Train the tiny system with one setting of stage two changed at a time, and score it on the validation scenes.

python tools/setting_study.py [--data outputs/scenes/train] [--limit 200] [--seeds 0 1]

About a minute and a half a setting and seed. Without ``--data`` it learns from the 24 shipped scenes alone. A stopped
run trains nothing twice.
"""

import argparse
import sys
from pathlib import Path

from ditr_lite.evaluation import results
from ditr_lite.studies import trials
from ditr_lite.studies.experiment import QUICK
from ditr_lite.training.scenes import described, load_scenes


def main() -> None:
    """Parse the arguments, train, score, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of rendered scenes to train on besides the shipped ones")
    parser.add_argument("--limit", type=int, help="train on the first scenes only")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--folder", type=Path, default=Path("outputs/weights"))
    parser.add_argument("--json", type=Path, default=results.results_path("settings"))
    args = parser.parse_args()
    begin = {  # no shipped weights: everything is trained here
        "command": results.tool_command("setting_study", sys.argv[1:]),
        "versions": results.versions(),
        "split": "val",
        "steps": {part: recipe.steps for part, recipe in QUICK.items()},
        "learnt_from": described(*(load_scenes(folder, args.limit) for folder in [args.data] if folder)),
    }
    rows = trials.try_settings(
        seeds=args.seeds,
        save=lambda rows: results.write(args.json, begin, {"rows": rows}),
        data=args.data,
        folder=args.folder,
        limit=args.limit,
    )
    for name in rows:
        gain = trials.against_default(rows, name)
        print(f"{name:38}{1000 * gain.mean:+7.1f} mm [{1000 * gain.low:+.1f}, {1000 * gain.high:+.1f}]")


if __name__ == "__main__":
    main()
