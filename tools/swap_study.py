"""Ask what the shipped weights lean on: guides, branches, evidence, detail and region exchanged one at a time.

    python tools/swap_study.py [--limit 112] [--json ditr_lite/weights/results_swaps.json]

Nothing is trained and nothing is chosen by it. The first frames of the test split are completed under every swap of
``studies.swaps``, one draw a frame, all from the same noise, in some twenty minutes on one core; differences are
paired over frames. The breakdown beside the paper's Table V is the default's.
"""

import argparse
import sys
from pathlib import Path

import ditr_lite as dl
from ditr_lite.evaluation import results
from ditr_lite.studies import swaps


def main(arguments: list[str] | None = None) -> int:
    """Run the study and write its figures."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--split", default="test", help="scenes to complete (%(default)s)")
    parser.add_argument("--limit", type=int, default=112, help="only the first of them (%(default)s)")
    parser.add_argument("--draws", type=int, default=1, help="samples a frame (%(default)s)")
    parser.add_argument("--weights", type=Path, help="weights folder (the shipped one)")
    parser.add_argument("--json", type=Path, default=results.results_path("swaps"), help="file to write")
    args = parser.parse_args(arguments)
    ditr = dl.Ditr.from_pretrained(args.weights)
    samples = [dl.load_sample(name) for name in dl.list_samples(args.split)[: args.limit]]
    rows = swaps.score_swaps(ditr, samples, draws=args.draws)
    frames = {
        sample.name: {
            name: {key: scores[k][key] and round(scores[k][key]["rmse"], 5) for key in swaps.SCORED}
            for name, scores in rows.items()
        }
        for k, sample in enumerate(samples)
    }
    report, breakdown = swaps.summarise_swaps(rows), swaps.breakdown(rows["default"])
    notes = {"split": args.split, "images": len(samples), "draws": args.draws}
    begin = results.head(results.tool_command("swap_study", arguments), args.weights, **notes)
    results.write(args.json, begin, {"summary": report, "breakdown": breakdown, "rmse_m": frames})
    print(f"{len(samples)} frames of the {args.split} split, RMSE")
    print(swaps.format_swaps(report, swaps.SCORED))
    print(swaps.beside_table_v(breakdown))
    return 0


if __name__ == "__main__":
    sys.exit(main())
