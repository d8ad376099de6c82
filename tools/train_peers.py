"""Train DITR, its learned peers and the arms of its ablation at equal training time.

python tools/train_peers.py [ARM ...] --minutes 4 [--data FOLDER ...] [--out outputs/peers] [--limit N]

Without an arm: all of them, then DITR, BB, +DP and the best two peers (on validation scenes) with a second seed.
Minutes are processor time of one thread. A stopped run goes on where it was: give the same command again.
"""

import argparse
from pathlib import Path

import torch

import ditr_lite as dl
from ditr_lite.peers.train import ARMS, train_all
from ditr_lite.store import WEIGHTS, read_card

SHOWN = 16  # validation scenes of each split by which the best two peers are chosen


def held_out() -> list[dl.Sample]:
    """Return some validation scenes of both kinds."""
    return [dl.load_sample(name) for split in ("val", "rooms_val") for name in dl.list_samples(split)[:SHOWN]]


def main() -> None:
    """Parse the arguments and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arms", nargs="*", metavar="ARM", help=f"of {', '.join(ARMS)} (default: all, some twice)")
    parser.add_argument("--minutes", type=float, default=4.0, help="of processor time an arm (%(default)s)")
    homes = [Path("outputs/scenes") / split for split in ("train", "rooms_train")]
    parser.add_argument("--data", type=Path, nargs="+", default=homes, help="folders of rendered scenes")
    parser.add_argument("--out", type=Path, default=Path("outputs/peers"))
    parser.add_argument("--work", type=Path, help="for checkpoints (default: checkpoints in --out)")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="of autoencoder and encoder (default: shipped)")
    parser.add_argument("--limit", type=int, help="use only the first scenes of each folder")
    args = parser.parse_args()
    if unknown := [arm for arm in args.arms if arm not in ARMS]:
        parser.error(f"unknown arm {unknown[0]!r}; choose of {', '.join(ARMS)}")
    torch.set_num_threads(1)
    chosen = held_out if not args.arms else None
    work = args.work or args.out / "checkpoints"
    arms = args.arms or tuple(ARMS)
    train_all(args.minutes, args.data, args.out, work, arms, chosen, args.limit, weights=args.weights)
    for name, part in read_card(args.out)["parts"].items():
        if "arm" in part:
            print(f"{name:28} {part['steps']:5} steps, {part['cpu_seconds']:.0f} s of processor time")


if __name__ == "__main__":
    main()
