"""What the system costs: time, operations and memory of each stage, a library's U-Net beside ours, training speed.

Paper: Table VI (latency and GFLOPs per stage at 1280 x 720). Its 206 GFLOPs for stage two do not fit 1,000 steps of
two branches plus two ViT-L passes; so here every stage is counted by running it, sampler and all.
"""

import cProfile
import importlib.util
import os
import pstats
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from .. import baselines
from ..conditioning import CHANNELS, condition
from ..data import SAMPLES, Sample
from ..pipeline import Ditr
from ..stage_two import BRANCHES, Painter, Plan, Views, denoise, encode_picture, sharpen
from ..training import recipes
from ..training.parts import painter_of
from ..training.scenes import Pool, load_scenes
from ..units import clean_depth
from ..windows import at_centres, close_ups, fit_frame
from .costs import count_flops

MIN_RUNS = 5
LARGE = (720, 1280)  # of Table VI
INTERVAL_S = 0.002  # between two looks at the memory
MEGABYTE = 1e6
NARROWER = 0.625  # the library puts more layers on a level: at this width it has as many parameters as ours
KINDS = {  # of work: name -> parts of the names of the functions that do it
    "convolution": ("conv",),
    "matrix product": ("addmm", "matmul", "linear"),
    "minimum": ("amin", "argmin", "'min'"),
    "attention": ("scaled_dot_product",),
    "activation": ("silu", "relu", "sigmoid", "softmax"),
    "normalisation": ("norm",),
    "moving and resizing": ("cat", "shuffle", "upsample", "pool", "pad", "contiguous", "clone", "resize", "stack"),
}
REST = "the rest"  # Python itself, NumPy, arithmetic that is written as an operator


@torch.no_grad()
def time_stages(
    ditr: Ditr, sample: Sample, runs: int = MIN_RUNS, steps: int | None = None, samples: int | None = None
) -> list[dict[str, Any]]:
    """Time each stage on one frame and count its operations.

    Args:
        ditr: the system.
        sample: the frame; stages other than the whole run at the working size.
        runs: whose median is taken, after one that is thrown away.
        steps: denoising steps, the configuration's by default.
        samples: draws, likewise.

    Returns:
        One {"stage", "ms", "gflops"} a stage; gflops counts a multiply-add as 2 and is None where no network runs. The
        whole also holds resizing and composition, so it is more than its parts.

    Raises:
        ValueError: for fewer than MIN_RUNS runs.
    """
    if runs < MIN_RUNS:
        raise ValueError(f"a median of latencies needs at least {MIN_RUNS} runs, got {runs}")
    return [
        {"stage": name, "ms": median_ms(stage, runs), "gflops": count_flops(stage) / 1e9 or None}
        for name, stage in tqdm(stages(ditr, sample, steps, samples).items(), desc="latency", unit="stage")
    ]


def median_ms(fn: Callable[[], object], runs: int) -> float:
    """Return the median time of ``runs`` calls in milliseconds, after one that is thrown away: it warms the caches."""
    fn()
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        fn()
        seconds.append(time.perf_counter() - start)
    return 1000 * float(np.median(seconds))


def machine() -> dict[str, Any]:
    """Return what the times are of: cores, threads, torch's version, and how long a product of matrices takes here.

    ``product_ms`` is that of two float32 matrices 2048 x 2048: times divided by it can be compared between machines.
    """
    a = torch.ones(2048, 2048)
    product = median_ms(lambda: a @ a, MIN_RUNS)
    return {
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "product_ms": product,
    }


def where_time_goes(fn: Callable[[], object], runs: int = 3) -> dict[str, float]:
    """Return kind of work -> milliseconds a call, the largest first; together they are the time of a call.

    Python's own profiler notes every call, which costs time itself: what is called often looks dearer than it is.

    Args:
        fn: what to profile, once more beforehand to warm up.
        runs: calls whose mean is taken.
    """
    fn()
    profiler = cProfile.Profile()
    with profiler:
        for _ in range(runs):
            fn()
    spent = dict.fromkeys([*KINDS, REST], 0.0)
    for (file, _, name), (_, _, own, _, _) in pstats.Stats(profiler).stats.items():
        kinds = (k for k, words in KINDS.items() if any(word in name for word in words))
        spent[next(kinds, REST) if file == "~" else REST] += 1000 * own / runs  # ~: not written in Python
    return dict(sorted(spent.items(), key=lambda item: -item[1]))


def enlarged(sample: Sample, size: tuple[int, int] = LARGE) -> Sample:
    """Return the frame stretched to (height, width), colour smoothly and depth by nearest neighbour: to be timed."""
    rgb = cv2.resize(sample.rgb, size[::-1], interpolation=cv2.INTER_CUBIC)
    return replace(sample, rgb=rgb, depth=at_centres(sample.depth, size))


def stages(
    ditr: Ditr, sample: Sample, steps: int | None = None, samples: int | None = None
) -> dict[str, Callable[[], Any]]:
    """Return every stage as a call without arguments, fed with what the stages before it made."""
    steps = ditr.config.sampler.steps if steps is None else steps
    samples = ditr.config.sampler.samples if samples is None else samples
    rgb, depth = sample.rgb, clean_depth(sample.depth)

    def find() -> np.ndarray:
        return ditr.find_region(rgb, depth)[1]

    region = find()

    def look() -> dict[str, Views]:
        ditr.boundaries(rgb, depth)  # of the whole frame, to be shown
        return views_of(ditr, rgb, depth, region)

    views = look()
    painters = {branch: ditr.painter(branch) for branch in views}

    def draw(branch: str) -> Tensor | None:
        if branch not in views:  # nothing is claimed, so nothing is painted
            return None
        generator = torch.Generator().manual_seed(0)
        return latents_of(painters[branch], views[branch], ditr, steps, samples, generator)

    latents = {branch: draw(branch) for branch in views}

    def finish() -> list[Tensor]:
        return [decoded_of(painters[branch], views[branch], drawn) for branch, drawn in latents.items()]

    return {
        "stage one: region and refinement": find,
        "boundary maps": look,
        **{f"stage two: {branch} branch": lambda branch=branch: draw(branch) for branch in BRANCHES},
        "decoder and detail": finish,
        "whole": lambda: ditr(rgb, depth, steps=steps, samples=samples),
    }


def views_of(ditr: Ditr, rgb: np.ndarray, depth: np.ndarray, region: np.ndarray) -> dict[str, Views]:
    """Return what each branch is given of a frame: the whole of it, or windows around its region.

    Args:
        ditr: the system.
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 metres, clean.
        region: (H, W) bool.

    Returns:
        branch -> views; no optical one where windows are used and the region is empty.
    """
    frame = fit_frame(depth.shape, ditr.config.size)
    whole = [tuple(frame.into(image) for image in (rgb, depth, region))]
    guides = Plan().guides
    found = {"geometric": ditr.look(whole, guides[1], False)[0]}
    side = ditr.config.window
    spare = partial(baselines.nearest, rgb, depth)  # in place of what the geometric branch paints; rarely asked for
    close = [shown for *_, shown in close_ups(rgb, depth, region, side, spare)] if side else whole
    if close:
        found["optical"] = ditr.look(close, guides[0], bool(side))[0]
    return found


def latents_of(
    painter: Painter, views: Views, ditr: Ditr, steps: int, samples: int, generator: torch.Generator
) -> Tensor:
    """Return the latents (samples B, C, h, w) that a branch draws: steps 1 to 3 of ``stage_two.paint``."""
    given = (views.rgb, views.depth_n, views.valid, views.region, views.guide)
    image, filled, known = condition(*given, painter.evidence)
    masked = painter.autoencoder.encode(filled)
    features = encode_picture(painter, image, views.rgb)
    how = (ditr.schedule, steps, samples, ditr.config.sampler.prediction, generator)
    return denoise(painter.net, masked, known, features, *how)


def decoded_of(painter: Painter, views: Views, latents: Tensor) -> Tensor:
    """Return the normalised depth (samples B, 1, H, W) of latents: steps 4 and 5 of ``stage_two.paint``."""
    decoded = painter.autoencoder.decode(latents)
    return decoded if painter.detail is None else sharpen(painter.detail, decoded, views)


def format_latency(rows: list[dict[str, Any]]) -> str:
    """Return :func:`time_stages`'s rows as a text table, with peak memory where the rows hold it."""
    width = max(len(row["stage"]) for row in rows)
    heads = ["ms", "GFLOPs"] + ["peak MB"] * ("peak_mb" in rows[0])
    lines = ["stage".ljust(width) + "".join(head.rjust(10) for head in heads)]
    for row in rows:
        cells = [f"{row['ms']:.1f}", "-" if row["gflops"] is None else f"{row['gflops']:.2f}"]
        cells += [f"{row['peak_mb']:.0f}"] if "peak_mb" in row else []
        lines.append(row["stage"].ljust(width) + "".join(cell.rjust(10) for cell in cells))
    return "\n".join(lines)


def peak_mb(fn: Callable[[], object]) -> float:
    """Return the largest resident memory of this process, in MB (1e6 bytes), while ``fn`` runs."""
    try:
        import psutil
    except ImportError:
        raise ImportError("measuring memory needs psutil: pip install -e '.[notebooks]'") from None
    process, done = psutil.Process(), threading.Event()
    seen = [process.memory_info().rss]

    def watch() -> None:
        while not done.wait(INTERVAL_S):
            seen.append(process.memory_info().rss)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        fn()
    finally:
        seen.append(process.memory_info().rss)
        done.set()
        watcher.join()
    return max(seen) / MEGABYTE


def stage_peaks(
    weights: Path | str | None, sample: Sample, steps: int | None = None, samples: int | None = None
) -> dict[str, float]:
    """Return stage -> peak MB, measured in a fresh process, so that nothing else that ran here is counted.

    Counted is all that the process holds, Python, PyTorch and the weights included, because that is what a laptop must
    have; so the figure of a stage is not what the stage adds.

    Args:
        weights: folder; None for the shipped ones.
        sample: the frame.
        steps: of the sampler, the configuration's by default.
        samples: draws, likewise.
    """
    with get_context("spawn").Pool(1) as pool:
        return pool.apply(_stage_peaks, (weights, sample, steps, samples))


def _stage_peaks(weights: Path | str | None, sample: Sample, steps: int | None, samples: int | None) -> dict:
    with torch.no_grad():
        calls = stages(Ditr.from_pretrained(path=weights), sample, steps, samples)
        return {name: round(peak_mb(call), 1) for name, call in calls.items()}


def library_unet(channels_in: int, channels_out: int, width: int, levels: int, heads_at: int) -> nn.Module:
    """Return diffusers' ``UNet2DModel``: as many levels as asked for, attention from ``heads_at`` on.

    Raises:
        ImportError: without diffusers.
    """
    if importlib.util.find_spec("diffusers") is None:
        raise ImportError("the yardstick needs diffusers: pip install -e '.[dev]'")
    from diffusers import UNet2DModel

    down = ["AttnDownBlock2D" if k >= heads_at else "DownBlock2D" for k in range(levels)]
    up = [kind.replace("Down", "Up") for kind in reversed(down)]
    return UNet2DModel(
        in_channels=channels_in,
        out_channels=channels_out,
        block_out_channels=[width * 2**k for k in range(levels)],
        down_block_types=down,
        up_block_types=up,
        layers_per_block=1,
        norm_num_groups=4,
        attention_head_dim=width,
    ).eval()


@torch.no_grad()
def compare_unets(ditr: Ditr, runs: int = 7) -> dict[str, dict[str, float]]:
    """Time one denoising step of our optical branch beside diffusers' U-Net on the same latents.

    Returns:
        "ours" and "diffusers", each with ``parameters``, ``gflops``, ``ms`` and ``ms_per_gflop``. Ours
        includes the extractor of image features, which runs once a frame and whose time is not counted here.

    Raises:
        ImportError: without diffusers.
    """
    config, painter = ditr.config, ditr.painter("optical")
    net = painter.net
    height, width = (n // 4 for n in config.size)
    latent = config.autoencoder.latent_channels
    x, t = torch.randn(1, latent, height, width), torch.tensor([config.schedule.timesteps - 1])
    image, known = torch.randn(1, len(CHANNELS), *config.size), torch.ones(1, 1, height, width)
    features = encode_picture(painter, image, torch.zeros(1, 3, *config.size))
    channels = latent + latent + 1 + config.unet.cond_channels  # what ours concatenates at its entrance, too
    levels, first = len(config.unet.multipliers), min(config.unet.attention_levels)
    width_there = 4 * round(NARROWER * config.unet.width / 4)
    other = library_unet(channels, latent, width_there, levels, first)
    other = other.to(memory_format=torch.channels_last)
    wide = torch.randn(1, channels, height, width).contiguous(memory_format=torch.channels_last)
    calls = {"ours": (net, lambda: net(x, t, features, x, known)), "diffusers": (other, lambda: other(wide, t))}
    rows = {}
    for name, (network, call) in calls.items():
        gflops, ms = count_flops(call) / 1e9, median_ms(call, runs)
        rows[name] = {
            "parameters": sum(p.numel() for p in network.parameters()),
            "gflops": gflops,
            "ms": ms,
            "ms_per_gflop": ms / gflops,
        }
    return rows


def throughput(ditr: Ditr, steps: int = 3) -> dict[str, Any]:
    """Time training steps (forward, backward, update) of the optical branch with the recipe's batch.

    Args:
        ditr: whose configuration and autoencoder are used; its networks are not changed.
        steps: timed, after one that is thrown away; their median counts.
    """
    recipe, config = recipes.RECIPES["optical"], ditr.config
    net = type(ditr.parts["optical"])(config.unet, config.autoencoder.latent_channels, len(CHANNELS))
    net = net.to(memory_format=torch.channels_last)
    painter = replace(painter_of("optical", ditr.parts, config), net=net)
    loss = recipes.branch_step("optical", painter, Pool([load_scenes(SAMPLES / "train")]), config, recipe, ditr.backend)
    optimiser, count = torch.optim.AdamW(net.parameters(), lr=recipe.lr), iter(range(steps + 1))

    def step() -> None:
        optimiser.zero_grad(set_to_none=True)
        loss(next(count))["total"].backward()
        optimiser.step()

    seconds = median_ms(step, steps) / 1000
    return {
        "part": "optical",
        "batch": recipe.batch,
        "steps_per_s": 1 / seconds,
        "frames_per_s": recipe.batch / seconds,
    }


def format_unets(rows: dict[str, dict[str, float]]) -> str:
    """Return :func:`compare_unets`' rows as a text table."""
    lines = ["U-Net".ljust(12) + "parameters".rjust(12) + "GFLOPs".rjust(9) + "ms".rjust(9) + "ms/GFLOP".rjust(10)]
    for name, row in rows.items():
        figures = f"{row['parameters']:12,}{row['gflops']:9.2f}{row['ms']:9.1f}{row['ms_per_gflop']:10.1f}"
        lines.append(name.ljust(12) + figures)
    return "\n".join(lines)
