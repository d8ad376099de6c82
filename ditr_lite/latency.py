"""Time and count each stage of the system.

Paper: Table VI (latency and GFLOPs per stage at 1280 x 720). Its 206 GFLOPs for stage two do not fit 1,000 steps of
two branches plus two ViT-L passes; so here every stage is counted by running it, sampler and all.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tqdm.auto import tqdm

from ditr_lite.boundary import boundary_maps
from ditr_lite.conditioning import condition, depth_bounds, fit, to_tensor
from ditr_lite.data import Sample
from ditr_lite.pipeline import BRANCHES, Ditr
from ditr_lite.unet import count_flops

MIN_RUNS = 5


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
    steps = ditr.config.sampler.steps if steps is None else steps
    samples = ditr.config.sampler.samples if samples is None else samples
    rows = []
    stages = _stages(ditr, sample, steps, samples)
    for name, stage in tqdm(stages.items(), desc="latency", unit="stage"):
        stage()  # the first run allocates and warms caches
        seconds = []
        for _ in range(runs):
            start = time.perf_counter()
            stage()
            seconds.append(time.perf_counter() - start)
        rows.append({"stage": name, "ms": 1000 * float(np.median(seconds)), "gflops": count_flops(stage) / 1e9 or None})
    return rows


def _stages(ditr: Ditr, sample: Sample, steps: int, samples: int) -> dict[str, Callable[[], Any]]:
    """Return every stage as a call without arguments, fed with what the stages before it made."""
    frame = fit(sample.depth.shape, ditr.config.size)
    rgb, depth, bounds = frame.into(sample.rgb), frame.into(sample.depth), depth_bounds(sample.depth)

    def find() -> np.ndarray:
        return ditr.refine(ditr.region_probability(rgb, depth, bounds) > 0.5)

    def guide() -> tuple[np.ndarray, ...]:
        return boundary_maps(rgb, depth, ditr.backend)

    region, maps, image = find(), guide(), to_tensor(rgb[None])
    known = depth > 0
    tensors = (np.where(known, bounds.normalise(depth), 0), known, region, maps[0], maps[2])
    depth_n, valid, mask, m_rgb, m_da = (torch.from_numpy(a.astype(np.float32))[None, None] for a in tensors)

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
    """Return :func:`measure`'s rows as a text table."""
    width = max(len(row["stage"]) for row in rows)
    lines = ["stage".ljust(width) + "ms".rjust(10) + "GFLOPs".rjust(10)]
    for row in rows:
        operations = "-" if row["gflops"] is None else f"{row['gflops']:.2f}"
        lines.append(row["stage"].ljust(width) + f"{row['ms']:10.1f}" + operations.rjust(10))
    return "\n".join(lines)
