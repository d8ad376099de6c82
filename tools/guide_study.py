"""Ask which boundary map helps which branch: denoisers trained with the guide drawn at random, then read with each.

python tools/guide_study.py [--steps 600] [--limit 500] [--json ditr_lite/weights/results_guides.json]

One denoiser per branch, smaller than the shipped ones, with the shipped autoencoder. In training every frame is given
no guide, M_RGB, M_DA (both of the classical backend, as for the shipped denoisers) or the exact outlines, a quarter
each. The trained denoiser then paints every test frame with each of them, and with the learned backend's maps, in one
step from the same noise; the true region is given. So what differs between two columns is the guide alone. A stopped
run goes on where it was.
"""

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F
from tqdm.auto import tqdm

from ditr_lite import diffusion
from ditr_lite.autoencoder import VQAutoencoder
from ditr_lite.boundary import ExactBoundary, boundary_maps, get_backend
from ditr_lite.conditioning import CHANNELS, fill
from ditr_lite.config import Config, from_dict
from ditr_lite.data import SAMPLES, read_sample
from ditr_lite.evaluation.statistics import bootstrap_mean, paired_bootstrap
from ditr_lite.files import write_json
from ditr_lite.schedule import make_schedule
from ditr_lite.store import WEIGHTS, load_part, read_card, sha256
from ditr_lite.training.batches import Batch, Scenes, checksum, draw, load_scenes
from ditr_lite.training.loop import Recipe, fit
from ditr_lite.training.recipes import batches, branch_inputs
from ditr_lite.unet import DenoisingUNet

TRAINED = ("none", "m_rgb", "m_da", "exact")
READ = (*TRAINED, "learned_m_rgb", "learned_m_da")
BRANCHES = ("optical", "geometric")


def guides(folder: Path, names: list[str], learned: Path | str | None = None, only: tuple = READ) -> np.ndarray:
    """Return the maps of each type, (len(only), N, H, W) uint8."""
    backends = {"": get_backend("classical")}
    if any(kind.startswith("learned") for kind in only):
        backends["learned_"] = get_backend("learned", learned)
    maps = []
    for name in tqdm(names, desc="boundary maps", unit="scene"):
        sample = read_sample(folder / name)
        known = {"none": np.zeros(sample.depth.shape, bool)}
        known["exact"] = ExactBoundary(sample.instances, sample.depth_gt).colour
        for prefix, backend in backends.items():
            known[f"{prefix}m_rgb"], _, known[f"{prefix}m_da"] = boundary_maps(sample.rgb, sample.depth, backend)
        maps.append([known[kind] for kind in only])
    return np.array(maps, np.uint8).swapaxes(0, 1)


def with_guide(batch: Batch, maps: np.ndarray) -> Batch:
    """Return the batch with ``maps`` (B, H, W) as the guide of either branch."""
    guide = torch.from_numpy(maps).float()[:, None]
    return replace(batch, guide_rgb=guide, guide_da=guide)


@torch.no_grad()
def prepare(autoencoder: VQAutoencoder, scenes: Scenes) -> tuple[torch.Tensor, torch.Tensor]:
    """Return Enc(truth) and Enc(known depth) of all scenes, (N, C, h, w): nothing is augmented, so once is enough."""
    pairs = []
    for batch in batches(scenes, 1, colour=False):
        region = (batch.material > 0)[:, None].float()
        both = [(batch.gt_n, batch.gt_known), (batch.depth_n, batch.valid * (1 - region))]
        pairs.append(autoencoder.encode(torch.cat([fill(depth, known) for depth, known in both])))
    targets, masked = torch.stack(pairs, dim=1)
    return targets, masked


def train_branch(
    branch: str,
    net: DenoisingUNet,
    scenes: Scenes,
    maps: np.ndarray,
    latents: tuple,
    config: Config,
    recipe: Recipe,
    work: Path,
) -> dict:
    """Train one denoiser as ``recipes.branch_step`` does, but with the type of guide drawn for every frame."""
    schedule, (targets, masked_all) = make_schedule(config.schedule), latents

    def step_loss(step: int) -> dict[str, torch.Tensor]:
        rng = np.random.default_rng([7, step])
        index = rng.integers(0, len(scenes), recipe.batch)
        kinds = rng.integers(0, len(TRAINED), recipe.batch)
        batch = with_guide(draw(scenes, index, rng, augment=False), maps[kinds, index])
        (image, _, known), paint = branch_inputs(branch, batch, config)
        x0 = targets[index]
        t = torch.randint(0, schedule.timesteps, (len(x0),))
        t[: len(x0) // 2] = schedule.timesteps - 1  # it is read in one step from pure noise
        eps = torch.randn_like(x0)
        out = net(diffusion.q_sample(x0, t, eps, schedule), t, net.features(image), masked_all[index], known)
        mask = F.avg_pool2d(paint * batch.gt_known, 4) + 0.05
        return {"total": diffusion.loss(out, x0, eps, t, schedule, config.sampler.prediction, mask=mask)}

    return fit(f"guide-{branch}", net, step_loss, recipe, work, every=100, key=checksum(scenes))


@torch.no_grad()
def read(
    branch: str, net: DenoisingUNet, autoencoder: VQAutoencoder, scenes: Scenes, maps: np.ndarray, config: Config
) -> dict[str, list[float | None]]:
    """Return per type of guide the RMSE in metres of each frame where the branch must paint; None where it need not."""
    schedule, errors = make_schedule(config.schedule), {kind: [] for kind in READ}
    t, masked = torch.full((len(READ),), schedule.timesteps - 1), prepare(autoencoder, scenes)[1]
    for i, plain in enumerate(tqdm(batches(scenes, 1, colour=False), total=len(scenes), desc=f"reading {branch}")):
        given = []
        for k in range(len(READ)):
            (image, _, known), paint = branch_inputs(branch, with_guide(plain, maps[k, [i]]), config)
            given.append(image)
        noise = torch.randn(masked[[i]].shape, generator=torch.Generator().manual_seed(i)).expand(len(READ), -1, -1, -1)
        same = [x.expand(len(READ), -1, -1, -1) for x in (masked[[i]], known)]
        out = net(noise, t, net.features(torch.cat(given)), *same)
        decoded = autoencoder.decode(diffusion.to_x0(out, noise, t, schedule, config.sampler.prediction))
        where = (paint * plain.gt_known)[0] > 0
        for kind, depth in zip(READ, decoded, strict=True):
            square = ((depth - plain.gt_n[0]) * plain.scale_m[0])[where].square()
            errors[kind].append(round(float(square.mean().sqrt()), 6) if where.any() else None)
    return errors


def main(arguments: list[str] | None = None) -> int:
    """Run the study and write its figures."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("outputs/scenes/train"), help="scenes to train on")
    parser.add_argument("--limit", type=int, default=500, help="training scenes used (%(default)s)")
    parser.add_argument("--test", type=Path, default=SAMPLES / "test", help="scenes to read on")
    parser.add_argument("--test-limit", type=int, help="test scenes used (default: all)")
    parser.add_argument("--steps", type=int, default=600, help="training steps of each denoiser (%(default)s)")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--width", type=int, default=16, help="of the denoisers; the shipped ones are twice as wide")
    parser.add_argument(
        "--weights", type=Path, help="weights folder of autoencoder and learned backend (the shipped one)"
    )
    parser.add_argument("--work", type=Path, default=Path("outputs/training/guides"), help="checkpoints")
    parser.add_argument("--json", type=Path, default=Path("ditr_lite/weights/results_guides.json"))
    args = parser.parse_args(arguments)
    config = from_dict(read_card(args.weights)["config"])
    config = replace(config, unet=replace(config.unet, width=args.width, cond_channels=args.width))
    autoencoder = VQAutoencoder(config.autoencoder).eval().requires_grad_(False)
    autoencoder.load_state_dict(load_part("autoencoder", args.weights))
    scenes, test = load_scenes(args.data, args.limit), load_scenes(args.test, args.test_limit)
    maps = guides(args.data, scenes.names, only=TRAINED)
    latents = prepare(autoencoder, scenes)
    nets, notes, recipe = {}, {}, Recipe(steps=args.steps, batch=args.batch, lr=2e-3, warmup=20, decay=0.98)
    for branch in BRANCHES:
        torch.manual_seed(0)
        nets[branch] = DenoisingUNet(config.unet, config.autoencoder.latent_channels, len(CHANNELS))
        notes[branch] = train_branch(branch, nets[branch], scenes, maps, latents, config, recipe, args.work)
    test_maps, branches = guides(args.test, test.names, args.weights), {}
    for branch, net in nets.items():
        errors = read(branch, net.eval(), autoencoder, test, test_maps, config)
        rows = {kind: {"rmse_m": _interval(bootstrap_mean, values)} for kind, values in errors.items()}
        for kind in READ[1:]:
            rows[kind]["minus_none_m"] = _interval(paired_bootstrap, errors[kind], errors["none"])
        branches[branch] = {"seconds": notes[branch]["seconds"], "rows": rows, "frames": errors}
    line = shlex.join(["python", "tools/guide_study.py", *arguments])
    about = {"command": line, "steps": args.steps, "batch": args.batch, "width": args.width, "scenes": len(scenes)}
    folder = Path(args.weights or WEIGHTS)
    about["weights_sha256"] = {p: sha256(folder / f"{p}.safetensors") for p in ("autoencoder", "boundary")}
    write_json(args.json, {**about, "test_scenes": len(test), "branches": branches})
    print(f"{args.json}: {len(test)} scenes")
    return 0


def _interval(estimate, *columns: list) -> list[float]:
    return [round(value, 6) for value in estimate(*columns)]


if __name__ == "__main__":
    sys.exit(main())
