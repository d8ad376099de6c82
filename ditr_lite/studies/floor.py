"""The autoencoder's floor: the error that is left when the ground truth itself is encoded and decoded.

Paper: Sec. IV-C "Latent Space"; no figure is given there. Whatever the diffusion does in latents, its result passes
through the decoder, so no result can be expected to be better than this on average.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from tqdm.auto import tqdm

from ..autoencoder import VQAutoencoder
from ..conditioning import Bounds, depth_bounds, fill
from ..config import from_dict
from ..data import Sample
from ..evaluation.statistics import bootstrap_mean, format_interval, interval
from ..metrics import pixel_sets
from ..store import load_part, read_card
from ..training.losses import depth_steps
from ..units import without_strays

EDGE = 0.05  # relative step between neighbours from which a pixel lies at a depth edge
SETS = ("whole", "optical", "geometric", "edge", "interior")


def load_autoencoder(weights: Path | str | None = None) -> VQAutoencoder:
    """Return the trained autoencoder of a weights folder, by default the shipped one; other parts may be missing.

    Raises:
        ValueError: when there is none or it is damaged.
    """
    model = VQAutoencoder(from_dict(read_card(weights)["config"]).autoencoder)
    model.load_state_dict(load_part("autoencoder", weights))
    return model.eval().requires_grad_(False)


def depth_edges(depth_gt: np.ndarray, relative: float = EDGE) -> np.ndarray:
    """Return (H, W) bool: pixels of which a 4-neighbour is more than ``relative`` times farther or nearer.

    Both sides of the step count. Pixels without ground truth, 0, are no edge and nobody's neighbour. Relative, because
    a step of a centimetre is large on a glass and nothing on the wall.

    Raises:
        ValueError: unless ``relative`` > 0.
    """
    if not relative > 0:
        raise ValueError(f"expected a relative step > 0, got {relative}; 0.05 is 5 %")
    known = torch.from_numpy(depth_gt > 0)[None, None]
    log = torch.from_numpy(np.log(np.where(depth_gt > 0, depth_gt, 1).astype(np.float64)))[None, None]
    return (depth_steps(log, known) > math.log1p(relative))[
        0, 0
    ].numpy()  # max / min > 1.05: a difference of logarithms


def in_units(sample: Sample) -> tuple[Bounds, Tensor]:
    """Return the bounds of a frame's raw depth and its ground truth in network units, (1, 1, H, W), without gaps.

    Where no truth is known it is filled from around.

    Raises:
        ValueError: for a frame without ground truth, or without any reading.
    """
    if sample.depth_gt is None:
        raise ValueError(f"{sample.name} has no ground-truth depth: there is nothing to encode")
    bounds = depth_bounds(without_strays(sample.depth))
    truth = torch.from_numpy(sample.depth_gt)[None, None]
    known = (truth > 0).float()
    return bounds, fill(bounds.normalise(truth) * known, known)


@torch.no_grad()
def reconstruct(model: VQAutoencoder, sample: Sample) -> tuple[np.ndarray, np.ndarray, Tensor]:
    """Encode and decode the ground truth of one frame, with and without the quantiser.

    It is normalised by the bounds of the *raw* depth without its strays, as in inference; where no truth is known, the
    encoder sees a fill from around. The frame is taken as a whole: in windows, which show things larger, less is lost.

    Args:
        model: the autoencoder.
        sample: a frame with ground truth, H and W multiples of the model's factor.

    Returns:
        (H, W) float32 metres; the same without the quantiser; the indices of the codes (1, h, w) int64.

    Raises:
        ValueError: for a frame without ground truth, without any reading, or of another size.
    """
    bounds, truth = in_units(sample)
    out = model(truth)
    both = out["reconstruction"], model.decode(out["latents"], quantize=False)
    with_it, without = (bounds.denormalise(x[0, 0].numpy()).astype(np.float32) for x in both)
    return with_it, without, out["indices"]


def measure_floor(samples: Iterable[Sample], model: VQAutoencoder, progress: bool = True) -> dict[str, Any]:
    """Measure what encoding and decoding costs on frames with ground truth.

    Args:
        samples: frames.
        model: the autoencoder.
        progress: show a bar.

    Returns:
        ``images``; ``edge_step``; ``rmse_m``: set -> [mean, low, high], metres, mean over frames and its 95 % bootstrap
        interval, None for a set that is empty everywhere; ``rmse_m_unquantized``: the same without the quantiser;
        ``pixels``: set -> number; ``codes``: their ``total`` number, how many were ``used`` at least once, that
        ``share``, ``perplexity`` = exp(entropy), as many codes as would be in use were all used equally, and the
        latent ``vectors`` that chose; ``factor``, ``numbers_per_pixel`` (of the continuous latents), ``bits_per_pixel``
        (of the codes' indices, at equal length).

    Raises:
        ValueError: for no frame, or one that :func:`reconstruct` refuses.
    """
    rmse: tuple[dict[str, list], ...] = tuple({name: [] for name in SETS} for _ in range(2))
    hits, pixels, images = np.zeros(model.config.codes, int), dict.fromkeys(SETS, 0), 0
    for sample in tqdm(samples, desc="frames", unit="frame", **({} if progress else {"disable": True})):
        images += 1
        sets = _sets(sample)
        *both, indices = reconstruct(model, sample)
        for decoded, lists in zip(both, rmse, strict=True):
            square = (decoded - sample.depth_gt.astype(np.float64)) ** 2
            for name, mask in sets.items():
                lists[name].append(float(np.sqrt(square[mask].mean())) if mask.any() else None)
        pixels = {name: n + int(sets[name].sum()) for name, n in pixels.items()}
        hits += np.bincount(indices.flatten().numpy(), minlength=len(hits))
    if not images:
        raise ValueError("no frame to measure: the list of samples is empty")
    used, cells = int((hits > 0).sum()), model.factor**2
    return {
        "images": images,
        "edge_step": EDGE,
        "rmse_m": {name: interval(bootstrap_mean, values) for name, values in rmse[0].items()},
        "rmse_m_unquantized": {name: interval(bootstrap_mean, values) for name, values in rmse[1].items()},
        "pixels": pixels,
        "codes": {
            "total": len(hits),
            "used": used,
            "share": used / len(hits),
            "perplexity": perplexity(hits),
            "vectors": int(hits.sum()),
        },
        "factor": model.factor,
        "numbers_per_pixel": model.config.latent_channels / cells,
        "bits_per_pixel": math.log2(len(hits)) / cells,
    }


def error_by_distance(model: VQAutoencoder, samples: Sequence[Sample], farthest: int = 8) -> np.ndarray:
    """Return (N, 2, farthest + 1): squared error in square metres and pixels, by distance from the nearest depth edge.

    Distances are rounded to whole pixels; the last place holds all that is as far or farther. Only pixels with known
    truth count.

    Args:
        model: the autoencoder.
        samples: N frames with ground truth, each with a depth edge.
        farthest: pixels.

    Raises:
        ValueError: for a frame that :func:`reconstruct` refuses, or one without an edge.
    """
    sums = np.zeros((len(samples), 2, farthest + 1))
    for part, sample in zip(sums, samples, strict=True):
        decoded, *_ = reconstruct(model, sample)
        edges, known = depth_edges(sample.depth_gt), sample.depth_gt > 0
        if not edges.any():
            raise ValueError(f"{sample.name} has no depth edge to measure distances from: leave this frame out")
        apart = np.minimum(np.rint(distance_transform_edt(~edges)), farthest).astype(int)[known]
        square = (decoded - sample.depth_gt.astype(np.float64))[known] ** 2
        part[0] = np.bincount(apart, square, minlength=farthest + 1)
        part[1] = np.bincount(apart, minlength=farthest + 1)
    return sums


def perplexity(counts: np.ndarray) -> float:
    """Return exp(entropy) of how often each of K codes was chosen: 1 when one takes all, K when all are equal.

    Raises:
        ValueError: when nothing was counted, or a count is negative.
    """
    counts = np.asarray(counts, dtype=float)
    if counts.ndim != 1 or (counts < 0).any() or not counts.sum() > 0:
        raise ValueError(f"expected counts (K,), none negative and not all 0, got shape {counts.shape}")
    p = counts[counts > 0] / counts.sum()
    return float(np.exp(-(p * np.log(p)).sum()))


def format_floor(report: Mapping[str, Any]) -> str:
    """Return :func:`measure_floor`'s result as text."""
    codes, step = report["codes"], 100 * report["edge_step"]
    lines = [f"{report['images']} frames, f = {report['factor']}; RMSE in mm, mean over frames [95 % interval]"]
    lines.append("pixels".ljust(10) + "encoded, quantised, decoded".rjust(30) + "without the quantiser".rjust(26))
    for name in SETS:
        with_it, without = (format_interval(report[key][name], 1000, ".2f") for key in ("rmse_m", "rmse_m_unquantized"))
        lines.append(name.ljust(10) + with_it.rjust(30) + without.rjust(26) + f"{report['pixels'][name]:14,} px")
    lines.append(f"edge: a 4-neighbour is more than {step:.0f} % nearer or farther; interior: all other pixels")
    used = (
        f"{codes['used']:,} of {codes['total']:,} ({codes['share']:.0%}) at least once by {codes['vectors']:,} vectors"
    )
    lines.append(f"codes in use: {used}; perplexity {codes['perplexity']:.0f}")
    rate = f"{report['numbers_per_pixel']:.4g} numbers a pixel, {report['bits_per_pixel']:.3g} bits as indices"
    return "\n".join([*lines, f"rate: {rate}"])


def _sets(sample: Sample) -> dict[str, np.ndarray]:
    found = pixel_sets(sample.depth_gt, sample.region, sample.depth)
    nowhere = np.zeros(sample.depth.shape, bool)
    edge = depth_edges(sample.depth_gt)
    sets = {name: nowhere if found[name] is None else found[name] for name in SETS[:3]}
    return sets | {"edge": edge, "interior": found["whole"] & ~edge}
