"""Score DITR, its learned peers, its ablation and its oracles on both test splits and, if given, on real frames.

python tools/peer_study.py [--split test rooms] [--limit N] [--peers outputs/peers] [--real FRAMES.py] [--json FILE]

The arms must have been trained: `python tools/train_peers.py`. What was scored is kept in `scores` in the folder of the
arms; a stopped or repeated run computes only what is missing or depends on weights that have changed. Changed code it
does not notice: delete `scores` then.
"""

import argparse
from pathlib import Path

import ditr_lite as dl
from ditr_lite.evaluation import results
from ditr_lite.peers import compare
from ditr_lite.store import read_card
from ditr_lite.studies import peer_tables


def main() -> None:
    """Parse the arguments, score, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", nargs="+", default=["test", "rooms"])
    parser.add_argument("--limit", type=int, help="only the first frames of each split")
    parser.add_argument("--peers", type=Path, default=Path("outputs/peers"))
    parser.add_argument("--real", type=Path, help="a Python file whose frames() yields real frames")
    parser.add_argument("--json", type=Path, default=peer_tables.RESULTS)
    parser.add_argument("--pictures", type=Path, default=peer_tables.PICTURES, help="for each peer's worst completion")
    args = parser.parse_args()
    ditr = dl.Ditr.from_pretrained()
    rows = compare.methods(ditr, args.peers)
    splits = {}
    for split in args.split:
        names = dl.list_samples(split)[: args.limit]
        frames = compare.frames_of(ditr, map(dl.load_sample, names), len(names))
        scores = compare.score_rows(rows, frames, args.peers / "scores" / split, compare.score_rendered)
        splits[split] = {**peer_tables.summarise_peers(scores), "rmse_m": scores}
        if split == args.split[0]:
            failures = peer_tables.failure_frames(splits[split])
            compare.paint_failures(rows, frames, failures, args.pictures)
    report = {"settings": read_card(args.peers)["config"], "trained": compare.trained_notes(args.peers)}
    report |= {"splits": splits, "failures": failures}
    if args.real:
        frames = compare.frames_of(ditr, compare.frames_of_file(args.real))
        blind = {name: row for name, row in rows.items() if name not in compare.NEED_TRUTH}
        report["real"] = compare.score_rows(blind, frames, args.peers / "scores" / "real", compare.score_real)
    asked = ["--split", *args.split]  # what decides the figures; where files lie does not
    asked += ["--limit", args.limit] if args.limit else []
    asked += ["--real", args.real.name] if args.real else []
    top = results.head(results.tool_command("peer_study", asked))
    results.write(args.json, top, report)
    print(peer_tables.format_study(report))


if __name__ == "__main__":
    main()
