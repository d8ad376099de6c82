"""How much memory each stage needs: resident memory, sampled while the stage runs in a process of its own.

Counted is all that the process holds, Python, PyTorch and the weights included, because that is what a laptop must
have; so the figure of a stage is not what the stage adds.
"""

import threading
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path

import psutil
import torch

from ..data import Sample
from ..pipeline import Ditr
from . import latency

INTERVAL_S = 0.002
MEGABYTE = 1e6


def peak_mb(fn: Callable[[], object], interval: float = INTERVAL_S) -> float:
    """Return the largest resident memory of this process, in MB (1e6 bytes), while ``fn`` runs."""
    process, done = psutil.Process(), threading.Event()
    seen = [process.memory_info().rss]

    def watch() -> None:
        while not done.wait(interval):
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
        stages = latency.stages(Ditr.from_pretrained(path=weights), sample, steps, samples)
        return {name: round(peak_mb(stage), 1) for name, stage in stages.items()}
