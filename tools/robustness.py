"""Write the degradation curves of the shipped weights: what light, noise, holes, size, distance and format cost.

    python tools/robustness.py [--limit 4] [--json ditr_lite/weights/results_robustness.json]

A few minutes on one core. Frames: every (128 / limit)-th of the test split. ``notebooks/09_your_own_camera`` draws the
file and computes one of its points again.
"""

import argparse
import shlex
import sys
import time
from pathlib import Path

from ditr_lite.data import list_samples, load_sample
from ditr_lite.files import write_json
from ditr_lite.pipeline import Ditr
from ditr_lite.store import read_card
from ditr_lite.studies.robustness import run

ROOT = Path(__file__).resolve().parents[1]
DEFAULT = ROOT / "ditr_lite" / "weights" / "results_robustness.json"


def frames(limit: int) -> list[str]:
    """Return the names of ``limit`` test scenes, evenly spaced."""
    names = list_samples("test")
    return names[:: max(1, len(names) // limit)][:limit]


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--limit", type=int, default=4, help="test scenes (%(default)s)")
    parser.add_argument("--json", type=Path, default=DEFAULT, help="where to write")
    argv = sys.argv[1:] if argv is None else argv
    options = parser.parse_args(argv)
    names, start = frames(options.limit), time.perf_counter()
    curves = run(Ditr.from_pretrained(), [load_sample(name) for name in names])
    checksums = {name: part["sha256"] for name, part in read_card(None)["parts"].items()}
    head = {"command": shlex.join(["python", "tools/robustness.py", *argv]), "weights_sha256": checksums}
    unit = "RMSE over the frame's median depth, mean over frames, region found by stage one"
    write_json(options.json, {**head, "frames": names, "unit": unit, "curves": curves})
    print(f"{options.json}: {len(names)} scenes, {time.perf_counter() - start:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
