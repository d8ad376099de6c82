"""Score DITR, its learned peers, its ablation and its oracles on one split, in one run.

python tools/peer_study.py [--split test] [--limit N] [--peers outputs/peers] [--workers 2] [--json FILE]

The peers and arms must have been trained: `for arm in regression single_latent_diffusion ... dp ditr; do
python tools/train_peer.py $arm --minutes M; done`, BB (single_latent_diffusion) and dp also with `--seed 1`.
"""

import argparse
import multiprocessing
import sys
from pathlib import Path

import torch
from tqdm.auto import tqdm

import ditr_lite as dl
from ditr_lite.evaluation import results
from ditr_lite.peers import compare
from ditr_lite.store import read_card

STUDY = {}  # of a worker: the system and the methods, built once


def begin(peers: Path, threads: int) -> None:
    """Build what a worker scores frames with."""
    torch.set_num_threads(threads)
    ditr = dl.Ditr.from_pretrained()
    STUDY.update(ditr=ditr, rows=compare.methods(ditr, peers))


def score(name: str) -> dict:
    """Score all methods on one frame."""
    return compare.score_methods([dl.load_sample(name)], **STUDY)


def main() -> None:
    """Parse the arguments, score, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", default="test")
    parser.add_argument("--limit", type=int)
    parser.add_argument("--peers", type=Path, default=Path("outputs/peers"))
    parser.add_argument("--workers", type=int, default=2, help="frames at a time (%(default)s)")
    parser.add_argument("--json", type=Path, default=compare.RESULTS)
    args = parser.parse_args()
    compare.methods(dl.Ditr.from_pretrained(), args.peers)  # a worker without weights would be restarted for ever
    names, scores = dl.list_samples(args.split)[: args.limit], {}
    threads = max(1, torch.get_num_threads() // args.workers)
    with multiprocessing.get_context("spawn").Pool(args.workers, begin, (args.peers, threads)) as pool:
        for found in tqdm(pool.imap(score, names), total=len(names), desc="frames", unit="frame"):
            scores |= found
    report = compare.summarise_peers(scores)
    card = read_card(args.peers)["parts"]
    report["trained"] = {
        name: {k: part[k] for k in ("arm", "minutes", "seed", "steps", "scenes", "sha256")}
        for name, part in card.items()
    }
    for table in (compare.format_peers, compare.format_ablation, compare.format_oracles):
        print(table(report), end="\n\n")
    notes = {"split": args.split, "frames": len(scores)}
    top = results.head(results.tool_command("peer_study", sys.argv[1:]), **notes)
    results.write(args.json, top, {**report, "rmse_m": scores})


if __name__ == "__main__":
    main()
