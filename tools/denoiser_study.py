"""Train variants of the denoiser for the same processor time each, and score them on validation scenes.

python tools/denoiser_study.py --minutes 1.5 [--data FOLDER ...] [--work outputs/denoisers] [--json FILE]

A stopped run goes on where it was. With --only NAME ... few variants are trained, the default always among them; with
another --seed give another --work and --json.
"""

import argparse
from pathlib import Path

import torch
from tqdm.auto import tqdm

from ditr_lite.data import SAMPLES
from ditr_lite.evaluation import results
from ditr_lite.peers import system
from ditr_lite.peers.train import peer_config
from ditr_lite.store import WEIGHTS
from ditr_lite.studies import denoisers
from ditr_lite.training.scenes import Pool, described, load_scenes


def main() -> None:
    """Parse the arguments, train, score, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1.5, help="of processor time a variant (%(default)s)")
    homes = [Path("outputs/scenes") / split for split in ("train", "rooms_train")]
    parser.add_argument("--data", type=Path, nargs="+", default=homes, help="folders of rendered scenes")
    parser.add_argument("--work", type=Path, default=Path("outputs/denoisers"), help="for checkpoints")
    parser.add_argument("--limit", type=int, help="use only the first scenes of each folder")
    parser.add_argument("--only", nargs="+", choices=denoisers.DENOISERS, metavar="NAME", help="of variants")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (%(default)s)")
    parser.add_argument("--json", type=Path, default=results.results_path("denoiser"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    config = peer_config()
    given, pool = system.given(WEIGHTS, config), Pool([load_scenes(folder, args.limit) for folder in args.data])
    held_out, errors, trained = load_scenes(SAMPLES / "val"), {}, {}
    names = [name for name in denoisers.DENOISERS if not args.only or name in ("default", *args.only)]
    for name in tqdm(names, desc="variants", unit="variant"):
        made = denoisers.train_denoiser(name, args.minutes, pool, given, config, args.work, args.seed)
        painter, own, trained[name] = made
        errors[name] = {
            denoisers.way_of(*asked): denoisers.denoiser_errors(painter, own, held_out, *asked).tolist()
            for asked in denoisers.ASKED
        }
    report = {"minutes": args.minutes, "scenes": len(pool), "trained": trained, "errors": errors}
    report["summary"] = denoisers.summarise_denoisers(errors)
    print(denoisers.format_denoisers(report))
    asked = ["--minutes", args.minutes]  # where files lie decides nothing
    asked += ["--only", *args.only] if args.only else []
    asked += ["--limit", args.limit] if args.limit else []
    asked += ["--seed", args.seed] if args.seed else []
    command = results.tool_command("denoiser_study", asked)
    begin = results.head(command, parts=["autoencoder", "encoder"], learnt_from=described(*pool.groups))
    results.write(args.json, begin, report)


if __name__ == "__main__":
    main()
