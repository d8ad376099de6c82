"""Write what light, noise, holes, size, distance and format cost the shipped weights, and which disturbances hurt.

    python tools/robustness.py [--limit 4] [--frames 32] [--splits test rooms] [--json FILE]

Two parts. Curves: every condition of ``studies.robustness`` at every strength, on a few test scenes; notebook 09 draws
them. Disturbances: a room behind the table, stray readings, a turned camera, another distance, sparse readings; on
``--frames`` scenes of each split, as a ratio to the error of the undisturbed frame with its paired interval. About half
a minute a scene on one core.
"""

import argparse
import sys
import time
from pathlib import Path

from ditr_lite.data import list_samples, load_sample
from ditr_lite.evaluation import results
from ditr_lite.pipeline import Ditr
from ditr_lite.studies import robustness

UNIT = "RMSE over the frame's median depth, mean over frames, region found by stage one"


def frames(limit: int, split: str = "test") -> list[str]:
    """Return the names of ``limit`` scenes of a split, evenly spaced."""
    names = list_samples(split)
    return names[:: max(1, len(names) // limit)][:limit]


def disturbances(ditr: Ditr, names: list[str]) -> dict:
    """Return the disturbance table of some scenes, and every scene's errors."""
    samples = [load_sample(name) for name in names]
    rows = robustness.run_disturbances(ditr, [s for s in samples if s.region.any()])
    table = robustness.summarise_disturbances(rows)
    return {"frames": [s.name for s in samples if s.region.any()], "table": table, "rmse_m": rows}


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--limit", type=int, default=4, help="test scenes of the curves (%(default)s)")
    parser.add_argument("--frames", type=int, default=32, help="scenes of each split to disturb (%(default)s)")
    parser.add_argument("--splits", nargs="*", default=["test", "rooms"], help="whose scenes to disturb (%(default)s)")
    parser.add_argument("--weights", type=Path, help="weights folder (the shipped one)")
    parser.add_argument("--json", type=Path, default=results.results_path("robustness"), help="where to write")
    argv = sys.argv[1:] if argv is None else argv
    options = parser.parse_args(argv)
    chosen = {split: frames(options.frames, split) for split in options.splits}  # refuses unknown splits at once
    names, start = frames(options.limit), time.perf_counter()
    ditr = Ditr.from_pretrained(options.weights)
    found = {"curves": robustness.score_conditions(ditr, [load_sample(name) for name in names]), "disturbances": {}}
    for split, some in chosen.items():
        found["disturbances"][split] = disturbances(ditr, some)
        scored = len(found["disturbances"][split]["frames"])
        print(f"\n{split} split, {scored} scenes, RMSE in the region; [95 % interval], paired over scenes")
        print(robustness.format_disturbances(found["disturbances"][split]["table"]))
    command = results.tool_command("robustness", argv)
    results.write(options.json, results.head(command, options.weights, frames=names, unit=UNIT), found)
    print(f"\n{options.json}: {time.perf_counter() - start:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
