"""Train one small autoencoder for each sampling scale f = 2, 4, 8, and write down what each costs.

Alike in all else but one: f = 8 learns at a quarter of the others' rate, at which it never leaves the mean depth.

The shipped training code, for a few minutes on one core; rate, error at edges and inside, operations. The weights stay
in outputs/, the figures are committed and shown in notebook 03.

    python tools/compare_factors.py [--steps 800] [--limit 150] [--json ditr_lite/weights/results_factors.json]
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from ditr_lite.conditioning import CHANNELS
from ditr_lite.config import Config, override, preset
from ditr_lite.data import list_samples, load_sample
from ditr_lite.evaluation import results
from ditr_lite.evaluation.costs import count_flops
from ditr_lite.studies.floor import load_autoencoder, measure_floor
from ditr_lite.training import parts as fitting
from ditr_lite.training.recipes import RECIPES
from ditr_lite.training.scenes import described, load_scenes
from ditr_lite.unet import STRIDE, DenoisingUNet

MULTIPLIERS = {2: (1,), 4: (1, 2), 8: (1, 2, 4)}
RATES = {8: 5e-4}  # at the recipe's rate the deepest one, which has no normalisation, never leaves the mean depth


def step_flops(config: Config, factor: int) -> int:
    """Return the operations of one denoising step, of one sample and one branch, on latents of this factor.

    F(x) is computed once a frame and not counted; it only has to fit, so it is made of an image of STRIDE latents, and
    without a pretrained encoder's features, which change nothing of a step.
    """
    height, width = (n // factor for n in config.size)
    bare = replace(config.unet, colour_channels=())
    net = DenoisingUNet(bare, config.autoencoder.latent_channels, len(CHANNELS)).eval()
    with torch.no_grad():
        features = net.features(torch.zeros(1, len(CHANNELS), STRIDE * height, STRIDE * width))
    latents = torch.zeros(1, config.autoencoder.latent_channels, height, width)
    return count_flops(net, latents, torch.tensor([0]), features)


def measure(factor: int, args: argparse.Namespace) -> dict[str, Any]:
    """Train the autoencoder of one factor and return its row."""
    multipliers = ",".join(map(str, MULTIPLIERS[factor]))
    config = override(preset(args.preset), **{"autoencoder.multipliers": multipliers})
    recipe = RECIPES["autoencoder"]
    recipe = replace(recipe, steps=args.steps, batch=args.batch, lr=RATES.get(factor, recipe.lr))
    out = args.work / f"f{factor}"
    notes = fitting.train("autoencoder", config, [args.data], [args.val], out, out, recipe, args.limit)
    model = load_autoencoder(out)
    depth = torch.zeros(1, 1, *config.size)
    names = list_samples(args.val.name, args.val.parent)
    row = {
        "factor": factor,
        "multipliers": list(MULTIPLIERS[factor]),
        "parameters": sum(p.numel() for p in model.parameters()),
        "seconds": notes["seconds"],
        "lr": recipe.lr,
        "scenes": notes["scenes"],
        "learnt_from": described(load_scenes(args.data, args.limit)),
        "encode_flop": count_flops(model.encode, depth),
        "decode_flop": count_flops(model.decode, model.encode(depth)),
        "step_flop": step_flops(config, factor),
    }
    frames = (load_sample(name, root=args.val.parent) for name in names)
    return row | {"floor": measure_floor(frames, model, progress=False)}


def main(argv: Sequence[str] | None = None) -> int:
    """Write the comparison and print it."""
    argv = list(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=800, help="of training, for each factor (%(default)s)")
    parser.add_argument("--batch", type=int, default=16, help="crops a step (%(default)s)")
    parser.add_argument("--limit", type=int, default=150, help="only the first training scenes (%(default)s)")
    parser.add_argument("--factors", type=int, nargs="+", choices=MULTIPLIERS, default=list(MULTIPLIERS))
    parser.add_argument("--preset", default="lite", help="sizes of everything else (%(default)s)")
    parser.add_argument("--data", type=Path, default=Path("outputs/scenes/train"))
    parser.add_argument("--val", type=Path, default=Path("data_samples/val"), help="measured here: test stays unseen")
    parser.add_argument("--work", type=Path, default=Path("outputs/factors"), help="weights; delete to start anew")
    parser.add_argument("--json", type=Path, default=results.results_path("factors"))
    args = parser.parse_args(argv)
    rows = []
    for factor in args.factors:
        row = measure(factor, args)
        rows.append(row)
        rmse = {name: f"{1000 * row['floor']['rmse_m'][name][0]:.1f}" for name in ("edge", "interior")}
        print(f"f = {factor}: {row['seconds']:.0f} s, RMSE mm {rmse}, a step {row['step_flop'] / 1e9:.2f} GFLOP")
    begin = {"command": results.tool_command("compare_factors", argv), "versions": results.versions()}  # own weights
    notes = {"steps": args.steps, "batch": args.batch, "split": args.val.name}
    results.write(args.json, begin | notes, {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
