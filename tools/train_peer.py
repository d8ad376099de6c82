"""Train one of DITR's learned peers, or an arm of its ablation, for a given time.

python tools/train_peer.py regression --minutes 12 [--seed 0] [--data FOLDER ...] [--limit 600]

On one core (set OMP_NUM_THREADS=1) two arms can be trained side by side. A stopped run goes on where it was.
"""

import argparse
from pathlib import Path

from ditr_lite.peers.train import ARMS, train_peers


def main() -> None:
    """Parse the arguments and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arm", choices=ARMS)
    parser.add_argument("--minutes", type=float, default=12.0)
    parser.add_argument("--seed", type=int, default=0)
    homes = [Path("outputs/scenes") / split for split in ("train", "rooms_train")]
    parser.add_argument("--data", type=Path, nargs="+", default=homes, help="folders of rendered scenes")
    parser.add_argument("--out", type=Path, default=Path("outputs/peers"))
    parser.add_argument("--work", type=Path, default=Path("outputs/training/peers"))
    parser.add_argument("--limit", type=int, default=600, help="use only the first scenes of each folder")
    args = parser.parse_args()
    trained = train_peers(args.arm, args.minutes, args.seed, args.data, args.out, args.work, args.limit)
    for name, notes in trained.items():
        print(f"{args.out / name}-{args.seed}: {notes['steps']} steps in {notes['seconds']:.0f} s")


if __name__ == "__main__":
    main()
