"""Write what every knob of notebook 09's table from symptom to knob does, on validation scenes of the second simulator.

    python tools/remedy_study.py [--limit 32] [--json ditr_lite/weights/results_remedies.json]

Scored are scenes whose region covers at least one per cent of the picture. About twenty seconds a scene on one core.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ditr_lite.data import list_samples, load_sample
from ditr_lite.evaluation import results
from ditr_lite.pipeline import Ditr
from ditr_lite.studies import remedies

SPLIT = "rooms_val"
LEAST = 0.01  # of the picture: smaller regions are a few pixels, and their errors noise


def frames(limit: int) -> list:
    """Return ``limit`` scenes with a region, evenly spaced over the split."""
    samples = [load_sample(name) for name in list_samples(SPLIT)]
    usable = [sample for sample in samples if sample.region.mean() >= LEAST]
    chosen = np.unique(np.linspace(0, len(usable) - 1, limit).round().astype(int))
    return [usable[k] for k in chosen]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--limit", type=int, default=32, help="scenes (%(default)s)")
    parser.add_argument("--json", type=Path, default=results.results_path("remedies"), help="where to write")
    argv = sys.argv[1:] if argv is None else argv
    options = parser.parse_args(argv)
    samples = frames(options.limit)
    command = results.tool_command("remedy_study", argv)
    begin = results.head(command, split=SPLIT, frames=[sample.name for sample in samples])
    rows = remedies.score_remedies(Ditr.from_pretrained(), samples)
    results.write(options.json, begin, {"rows": rows})
    print(remedies.remedy_table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
