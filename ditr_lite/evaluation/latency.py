"""Time and count each stage of the system.

Paper: Table VI (latency and GFLOPs per stage at 1280 x 720). Its 206 GFLOPs for stage two do not fit 1,000 steps of
two branches plus two ViT-L passes; so here every stage is counted by running it, sampler and all.
"""

import cProfile
import pstats
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from tqdm.auto import tqdm

from ..boundary import boundary_maps
from ..conditioning import condition, depth_bounds, depth_tensors, fit, to_tensor
from ..data import Sample
from ..pipeline import BRANCHES, Ditr
from ..unet import count_flops

MIN_RUNS = 5
LARGE = (720, 1280)  # of Table VI
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
def measure(
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
    wide = size[::-1]
    rgb = cv2.resize(sample.rgb, wide, interpolation=cv2.INTER_CUBIC)
    return replace(sample, rgb=rgb, depth=cv2.resize(sample.depth, wide, interpolation=cv2.INTER_NEAREST))


def stages(
    ditr: Ditr, sample: Sample, steps: int | None = None, samples: int | None = None
) -> dict[str, Callable[[], Any]]:
    """Return every stage as a call without arguments, fed with what the stages before it made."""
    steps = ditr.config.sampler.steps if steps is None else steps
    samples = ditr.config.sampler.samples if samples is None else samples
    frame = fit(sample.depth.shape, ditr.config.size)
    rgb, depth, bounds = frame.into(sample.rgb), frame.into(sample.depth), depth_bounds(sample.depth)

    def find() -> np.ndarray:
        return ditr.find_region(rgb, depth, bounds, frame)[1]

    def guide() -> tuple[np.ndarray, ...]:
        return frame.on_picture(boundary_maps, rgb, depth, backend=ditr.backend)

    region, maps, image = find(), guide(), to_tensor(rgb[None])
    depth_n, valid = depth_tensors(depth, bounds)
    mask, m_rgb, m_da = (torch.from_numpy(a.astype(np.float32))[None, None] for a in (region, maps[0], maps[2]))

    def paint(branch: str) -> torch.Tensor:
        evidence = ditr.config.evidence and branch == "optical"
        given = condition(image, depth_n, valid, mask, m_da if branch == "optical" else m_rgb, evidence)
        return ditr.denoise(branch, *given, steps, samples, torch.Generator().manual_seed(0))

    latents = [paint(branch) for branch in BRANCHES]

    def finish() -> list[torch.Tensor]:
        decoded = [ditr.decode(x) for x in latents]
        return ditr.sharpen(decoded, image, depth_n, valid, mask, m_rgb) if "detail" in ditr.parts else decoded

    return {
        "stage one: region and refinement": find,
        "boundary maps": guide,
        **{f"stage two: {branch} branch": lambda branch=branch: paint(branch) for branch in BRANCHES},
        "decoder and detail": finish,
        "whole": lambda: ditr(sample.rgb, sample.depth, steps=steps, samples=samples),
    }


def format_latency(rows: list[dict[str, Any]]) -> str:
    """Return :func:`measure`'s rows as a text table, with peak memory where the rows hold it."""
    width = max(len(row["stage"]) for row in rows)
    heads = ["ms", "GFLOPs"] + ["peak MB"] * ("peak_mb" in rows[0])
    lines = ["stage".ljust(width) + "".join(head.rjust(10) for head in heads)]
    for row in rows:
        cells = [f"{row['ms']:.1f}", "-" if row["gflops"] is None else f"{row['gflops']:.2f}"]
        cells += [f"{row['peak_mb']:.0f}"] if "peak_mb" in row else []
        lines.append(row["stage"].ljust(width) + "".join(cell.rjust(10) for cell in cells))
    return "\n".join(lines)
