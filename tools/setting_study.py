"""Train the tiny system with one setting of stage two changed at a time, and score it on the validation scenes.

python tools/setting_study.py [--data outputs/scenes/train] [--limit 200] [--seeds 0 1]

About a minute and a half a setting and seed. Without ``--data`` it learns from the 24 shipped scenes alone. A stopped
run trains nothing twice.
"""

import argparse
import shlex
import sys
from pathlib import Path

from ditr_lite.files import write_json
from ditr_lite.studies import settings
from ditr_lite.studies.experiment import QUICK


def main() -> None:
    """Parse the arguments, train, score, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of rendered scenes to train on besides the shipped ones")
    parser.add_argument("--limit", type=int, help="train on the first scenes only")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--folder", type=Path, default=Path("outputs/weights"))
    parser.add_argument("--json", type=Path, default=settings.RESULTS)
    args = parser.parse_args()
    notes = {
        "command": shlex.join(["python", *sys.argv]),
        "split": "val",
        "steps": {part: recipe.steps for part, recipe in QUICK.items()},
    }
    rows = settings.run(
        seeds=args.seeds,
        save=lambda rows: write_json(args.json, {**notes, "rows": rows}),
        data=args.data,
        folder=args.folder,
        limit=args.limit,
    )
    for name in rows:
        gain = settings.against_default(rows, name)
        print(f"{name:30}{1000 * gain.mean:+7.1f} mm [{1000 * gain.low:+.1f}, {1000 * gain.high:+.1f}]")


if __name__ == "__main__":
    main()
