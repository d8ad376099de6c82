"""Ask which boundary map helps which branch: denoisers trained with the guide drawn at random, then read with each.

python tools/guide_study.py [--steps 600] [--limit 500] [--json ditr_lite/weights/results_guides.json]

One denoiser per branch, smaller than the shipped ones, with the shipped autoencoder. In training every frame is given
no guide, M_RGB, M_DA (both of the classical backend, as for the shipped denoisers) or the exact outlines, a quarter
each. The trained denoiser then paints every test frame with each of them, and with the learned backend's maps, in one
step from the same noise; the true region is given. So what differs between two columns is the guide alone. Both
branches look at whole frames here, nothing is augmented, and the pretrained encoder is that of the shipped weights. A
stopped run goes on where it was.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F
from tqdm.auto import tqdm

from ditr_lite import diffusion
from ditr_lite.boundary import ExactBoundary, boundary_maps, get_backend
from ditr_lite.conditioning import CHANNELS, fill
from ditr_lite.config import Config, from_dict
from ditr_lite.data import SAMPLES
from ditr_lite.evaluation import results
from ditr_lite.evaluation.statistics import bootstrap_mean, interval, paired_bootstrap
from ditr_lite.pipeline import build
from ditr_lite.schedule import make_schedule
from ditr_lite.stage_two import BRANCHES, Painter, encode_picture
from ditr_lite.store import load_part, read_card
from ditr_lite.training.batches import Batch, batch_of, frames_in_order
from ditr_lite.training.loop import Recipe, fit
from ditr_lite.training.recipes import branch_inputs
from ditr_lite.training.scenes import Scenes, checkpoint_key, described, load_scenes, shrink
from ditr_lite.training.views import frame_view
from ditr_lite.unet import DenoisingUNet

TRAINED = ("none", "m_rgb", "m_da", "exact")
READ = (*TRAINED, "learned_m_rgb", "learned_m_da")


def guides(scenes: Scenes, learned: Path | str | None = None, only: tuple = READ) -> np.ndarray:
    """Return the maps of each type, (len(only), N, H, W) uint8."""
    backends = {"": get_backend("classical")}
    if any(kind.startswith("learned") for kind in only):
        backends["learned_"] = get_backend("learned", learned)
    maps = []
    for i in tqdm(range(len(scenes)), desc="boundary maps", unit="scene"):
        rgb, depth = scenes.rgb[i], scenes.depth[i].astype(np.float32) / 1000
        known = {"none": np.zeros(depth.shape, bool)}
        known["exact"] = ExactBoundary(scenes.instances[i], scenes.depth_gt[i].astype(np.float32) / 1000).colour
        for prefix, backend in backends.items():
            known[f"{prefix}m_rgb"], _, known[f"{prefix}m_da"] = boundary_maps(rgb, depth, backend)
        maps.append([known[kind] for kind in only])
    return np.array(maps, np.uint8).swapaxes(0, 1)


def with_guide(batch: Batch, maps: np.ndarray) -> Batch:
    """Return the batch with ``maps`` (B, H, W) as the guide of either branch."""
    guide = torch.from_numpy(maps).float()[:, None]
    return replace(batch, guide_rgb=guide, guide_da=guide)


@torch.no_grad()
def prepare(painter: Painter, scenes: Scenes, config: Config) -> tuple[torch.Tensor, torch.Tensor]:
    """Return Enc(truth) and Enc(known depth) of all scenes, (N, C, h, w): nothing is augmented, so once is enough."""
    pairs = []
    for batch in frames_in_order(scenes, config.size, 1):
        both = [(batch.gt_n, batch.gt_known), (batch.depth_n, batch.valid * (1 - batch.region))]
        pairs.append(painter.autoencoder.encode(torch.cat([fill(depth, known) for depth, known in both])))
    targets, masked = torch.stack(pairs, dim=1)
    return targets, masked


def painters(config: Config, weights: Path | None) -> dict[str, Painter]:
    """Return an untrained denoiser of each branch, beside the frozen autoencoder and encoder of ``weights``."""
    torch.manual_seed(0)
    parts = build(config).eval()
    for name in ("autoencoder", "encoder"):
        if name in parts:
            parts[name].load_state_dict(load_part(name, weights))
            parts[name].requires_grad_(False)
    encoder = parts["encoder"] if "encoder" in parts else None
    found = {}
    for branch in BRANCHES:
        torch.manual_seed(0)
        net = DenoisingUNet(config.unet, config.autoencoder.latent_channels, len(CHANNELS))
        found[branch] = Painter(net, parts["autoencoder"], encoder, None, config.evidence and branch == "optical")
    return found


def train_branch(
    branch: str, painter: Painter, scenes: Scenes, maps: np.ndarray, config: Config, recipe: Recipe, work: Path
) -> dict:
    """Train one denoiser as ``recipes.branch_step`` does, but on whole frames with the type of guide drawn for each."""
    schedule = make_schedule(config.schedule)
    targets, masked = prepare(painter, scenes, config)

    def step_loss(step: int) -> dict[str, torch.Tensor]:
        rng = np.random.default_rng([7, step])
        index = rng.integers(0, len(scenes), recipe.batch)
        kinds = rng.integers(0, len(TRAINED), recipe.batch)
        plain = batch_of([frame_view(scenes, int(i), config.size, None) for i in index])
        batch = with_guide(plain, maps[kinds, index])
        (image, _, known), paint = branch_inputs(branch, batch, config)
        x0 = targets[index]
        t = torch.randint(0, schedule.timesteps, (len(x0),))
        t[: len(x0) // 2] = schedule.timesteps - 1  # it is read in one step from pure noise
        eps = torch.randn_like(x0)
        features = encode_picture(painter, image, batch.rgb)
        out = painter.net(diffusion.q_sample(x0, t, eps, schedule), t, features, masked[index], known)
        mask = F.avg_pool2d(paint * batch.gt_known, 4) + 0.05
        return {"total": diffusion.loss(out, x0, eps, t, schedule, config.sampler.prediction, mask=mask)}

    given = {"autoencoder": painter.autoencoder} | ({} if painter.encoder is None else {"encoder": painter.encoder})
    key = checkpoint_key(config, [scenes], given)
    return fit(f"guide-{branch}", painter.net, step_loss, recipe, work, every=100, key=key)


@torch.no_grad()
def read(
    branch: str, painter: Painter, scenes: Scenes, maps: np.ndarray, config: Config
) -> dict[str, list[float | None]]:
    """Return per type of guide the RMSE in metres of each frame where the branch must paint; None where it need not."""
    schedule, errors = make_schedule(config.schedule), {kind: [] for kind in READ}
    count = len(READ)
    t, masked = torch.full((count,), schedule.timesteps - 1), prepare(painter, scenes, config)[1]
    frames = frames_in_order(scenes, config.size, 1)
    for i, plain in enumerate(tqdm(frames, total=len(scenes), desc=f"reading {branch}")):
        given = []
        for k in range(count):
            (image, _, known), paint = branch_inputs(branch, with_guide(plain, maps[k, [i]]), config)
            given.append(image)
        noise = torch.randn(masked[[i]].shape, generator=torch.Generator().manual_seed(i)).expand(count, -1, -1, -1)
        same = [x.expand(count, -1, -1, -1) for x in (masked[[i]], known)]
        features = encode_picture(painter, torch.cat(given), plain.rgb.expand(count, -1, -1, -1))
        out = painter.net(noise, t, features, *same)
        decoded = painter.autoencoder.decode(diffusion.to_x0(out, noise, t, schedule, config.sampler.prediction))
        off = plain.bounds.denormalise(decoded) - plain.bounds.denormalise(plain.gt_n)  # (6, 1, H, W) metres
        where = (paint * plain.gt_known)[0] > 0
        for kind, error in zip(READ, off, strict=True):
            errors[kind].append(round(float(error[where].square().mean().sqrt()), 6) if where.any() else None)
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
    parser.add_argument("--json", type=Path, default=results.results_path("guides"))
    args = parser.parse_args(arguments)
    config = from_dict(read_card(args.weights)["config"])
    config = replace(config, window=0, unet=replace(config.unet, width=args.width, cond_channels=args.width))
    rendered = load_scenes(args.data, args.limit)
    scenes = shrink(rendered, config.size)
    test = shrink(load_scenes(args.test, args.test_limit), config.size)
    maps, test_maps = guides(scenes, only=TRAINED), guides(test, args.weights)
    recipe = Recipe(steps=args.steps, batch=args.batch, lr=2e-3, warmup=20, decay=0.98)
    branches = {}
    for branch, painter in painters(config, args.weights).items():
        notes = train_branch(branch, painter, scenes, maps, config, recipe, args.work)
        painter.net.eval()
        errors = read(branch, painter, test, test_maps, config)
        rows = {kind: {"rmse_m": interval(bootstrap_mean, values, digits=6)} for kind, values in errors.items()}
        for kind in READ[1:]:
            rows[kind]["minus_none_m"] = interval(paired_bootstrap, errors[kind], errors["none"], digits=6)
        branches[branch] = {"seconds": notes["seconds"], "rows": rows, "frames": errors}
    used = ["autoencoder", "boundary"] + ["encoder"] * bool(config.unet.colour_channels)
    about = {"steps": args.steps, "batch": args.batch, "width": args.width, "learnt_from": described(rendered)}
    begin = results.head(results.tool_command("guide_study", arguments), args.weights, used, **about)
    results.write(args.json, begin, {"test_scenes": len(test), "branches": branches})
    print(f"{args.json}: {len(test)} scenes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
