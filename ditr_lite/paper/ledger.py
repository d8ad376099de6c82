"""The ledger of claims: *the paper says / we measured / holds?* for every doubtful point, each with its computation.

A misprint is called a misprint; what is not said is called not said. ``entry.measured()`` computes the middle column.
"""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from .. import boundary, conditioning, diffusion, metrics, region
from ..data import SAMPLES, list_samples, load_sample
from ..evaluation.costs import vit_flops
from ..schedule import make_schedule
from ..store import WEIGHTS
from ..training.as_the_paper import trosnet_learning_rate
from ..unet import CrossAttentionFeatureQuery, CrossAttentionLatentQuery
from . import audit
from .audit import beaten_in, below_rel_floor, implied_weight, rank_orders
from .tables import SIZES, SIZES_ELSEWHERE, T1, T2, T3, T5, T6

RESULTS = WEIGHTS / "results_test.json"


def committed() -> dict:
    """Return the committed results on the test split, as ``python -m ditr_lite evaluate --json`` wrote them."""
    return json.loads(RESULTS.read_text(encoding="utf-8"))


def _mean_rmse_mm(method: str) -> float:
    """Return the committed optical RMSE, the mean over images, in millimetres."""
    return 1000 * committed()["summary"]["methods"][method]["optical"]["rmse"]


def noise_scale() -> str:
    """Eq. 9: the standard deviation of what it calls the noise."""
    schedule, generator = make_schedule(), torch.Generator().manual_seed(0)
    x0, eps = (torch.randn(2, 20_000, generator=generator, dtype=torch.float64) for _ in range(2))
    t = torch.tensor([schedule.timesteps // 20, schedule.timesteps // 2])
    x_t = diffusion.q_sample(x0, t, eps, schedule)
    printed = (x_t - schedule.alphas_cumprod[t].sqrt()[:, None] * x0).std(dim=1)
    whole = diffusion.eps_from_x0(x_t, t, x0, schedule).std(dim=1)
    return (
        f"as printed, the noise has deviation {printed[0]:.2f} at T/20 and {printed[1]:.2f} at T/2; "
        f"after division by √(1 − ᾱ) {whole[0]:.2f} and {whole[1]:.2f}"
    )


def signal_left() -> str:
    """Eq. 7: how much of the clean latent is left along the way."""
    left = make_schedule().alphas_cumprod.sqrt()
    at = {"T/10": len(left) // 10, "T/2": len(left) // 2, "T": len(left) - 1}
    shares = ", ".join(f"{100 * left[t]:.1f} % at {name}" for name, t in at.items())
    return f"signal left in L_t: {shares}; N(0, I) is the limit only"


def intersection() -> str:
    """I4: it is an intersection, and of thin maps one pixel apart nothing is left of it."""
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 64, 64)) < 0.3
    same = np.array_equal(a & ~(~b), a & b)
    line, moved = np.zeros((2, 32, 32), bool)
    line[:, 15], moved[:, 16] = True, True
    exact, near = boundary.depth_aware(line, moved, 0).sum(), boundary.depth_aware(line, moved).sum()
    return f"A ∖ ∁B = A ∩ B: {same}; two lines one pixel apart share {exact} pixels exactly, {near} of 32 within 2 px"


def unknown_pixels() -> str:
    """Eq. 4-6: what unknown ground truth does to a mean over H x W."""
    truth = np.full((10, 10), 0.6)
    pred = truth + 0.01
    truth[:2] = 0  # a fifth is unknown
    over_all = math.sqrt(np.mean((pred - truth) ** 2))
    return (
        f"off by 10 mm everywhere, a fifth of the truth unknown: RMSE {1000 * over_all:.0f} mm over H × W, "
        f"{1000 * metrics.rmse(pred, truth):.0f} mm over known pixels"
    )


def bands() -> str:
    """I2: which delta Table III can have used."""
    worded, field = (below_rel_floor(T3.records(), worded) for worded in (True, False))
    return (
        f"REL too small for the shares in {len(worded)} rows of T3 under the wording ({', '.join(worded)}), "
        f"in {len(field)} under max(p/g, g/p)"
    )


def impossible() -> str:
    """Tables I, II and V: rows with RMSE below MAE, and the order of columns that explains T5 best."""
    found = {t.name: [f.row for f in audit.audit_table(t.records())] for t in (T1, T2, T5)}
    best = rank_orders(T5, T1)[0]
    return (
        f"RMSE < MAE: {', '.join(found['T1'])} in T1, {', '.join(found['T2'])} in T2, {len(found['T5'])} of "
        f"{best.entries} entries of T5; read as {', '.join(best.order).upper()}, T5 passes {best.possible} of "
        f"{best.entries} and {best.between} of {best.pairs}"
    )


def optical_weight() -> str:
    """Table I: the weight of optical pixels that it implies for DFNet, beside their share of frames."""
    whole, parts = T1.records()["DFNet"], T5.reordered(("rmse", "rel", "mae")).records()["DFNet"]
    found = [
        implied_weight(whole[m], parts[f"optical.{m}"], parts[f"geometric.{m}"], power, 0.0005)
        for m, power in (("rmse", 2), ("mae", 1), ("rel", 1))
    ]
    low, values, high = zip(*found, strict=True)
    row = committed()["summary"]["methods"]["ditr"]
    return (
        f"DFNet: {100 * min(values):.0f} to {100 * max(values):.0f} % of the weight on optical pixels "
        f"({100 * min(low):.0f} to {100 * max(high):.0f} % with rounding), if T5's columns are RMSE, REL, MAE; "
        f"they are {100 * row['optical']['n'] / row['whole']['n']:.0f} % of our test frames, 3 and 13 % "
        "of the two real frames of our data card"
    )


def dataset_sizes() -> str:
    """Sec. V-A: whose counts these are."""
    twins = [name for name, n in SIZES_ELSEWHERE.items() if n == SIZES["TODD"]]
    return (
        f"STD: 30 × 900 = {30 * 900:,}; TODD's {SIZES['TODD']:,} is the count of {twins[0]}, "
        f"as the L515 is its camera; TODD's authors name nearly {SIZES_ELSEWHERE['TODD']:,}"
    )


def learning_rates() -> str:
    """Sec. V-B: TROSNet's public training script, which the paper follows."""
    rate = np.array([[trosnet_learning_rate(epoch, step) for step in range(228)] for epoch in range(150)])
    return (
        f"TROSNet's script: {rate.min():.1e} to {rate.max():.1e}, a sine on a slow line "
        f"({rate.mean(1)[0]:.1e} to {rate.mean(1)[-1]:.1e}); no exponential"
    )


def operations() -> str:
    """Table VI: what two ViT-L passes alone cost."""
    latency, gflops = T6.rows["DITR stage two"]
    return (
        f"two ViT-L passes take {vit_flops() / 1e9:,.0f} G multiply-adds, {gflops:.0f} are given for all; "
        f"1000 steps × 2 branches leave {latency / 2000:.1f} ms and {gflops / 2000:.1f} G a call"
    )


def inputs() -> str:
    """Sec. IV-C: what we had to choose."""
    return f"we had to choose: boundaries from {', '.join(boundary.BACKENDS)}; x = ({', '.join(conditioning.CHANNELS)})"


def base_rate() -> str:
    """Sec. V-B: the rate of latent diffusion's configuration files is one per sample and GPU."""
    return f"as a base rate it stands for 1e-6 × 64 = {1e-6 * 64:.1e} on one GPU"


def in_region_evidence() -> str:
    """Sec. IV-A: what the readings inside the region are worth."""
    names = ("harmonic", "keep_and_fill", "keep_and_fill_debiased")
    return "optical RMSE of simple fills, mm: " + ", ".join(f"{name} {_mean_rmse_mm(name):.0f}" for name in names)


def latent_target() -> str:
    """Sec. IV-C: what a diffusion that ends at Enc(D_in) would at best return."""
    return f"a perfect Dec(Enc(D_in)) returns D_in, {_mean_rmse_mm('sensor'):.0f} mm off where the region was read"


def attention() -> str:
    """Sec. IV-C: on a constant latent, does the output still depend on the image?"""
    torch.manual_seed(0)
    latent, images = torch.ones(1, 16, 4, 4), torch.randn(2, 16, 4, 4)
    change = {}
    for kind in (CrossAttentionFeatureQuery, CrossAttentionLatentQuery):
        with torch.no_grad():
            a, b = kind(16, 16, 2)(latent.expand(2, -1, -1, -1), images)
        change[kind] = float((a - b).abs().max())
    feature, latent_query = change.values()
    return (
        f"values come from L_t: where it is constant, another image changes the output by {feature:.0e}; "
        f"in latent diffusion's form by {latent_query:.0e}"
    )


def refinement() -> str:
    """Sec. IV-B: the area of a true region after refinement, at our size."""
    masks = [load_sample(name).region for name in list_samples("test")[:12]]
    ratios = [metrics.area_ratio(region.refine_region(mask), mask) for mask in masks if mask.any()]
    height, width = masks[0].shape
    return (
        f"at {width} × {height} it multiplies the true area by {min(ratios):.1f} to {max(ratios):.1f} "
        f"(median {np.median(ratios):.1f}, {len(ratios)} scenes)"
    )


def gradients() -> str:
    """Sec. IV-B: what is left of a gradient after the threshold."""
    logits = torch.linspace(-3, 3, 64, requires_grad=True)
    nudged = ((logits + 1e-4).sigmoid() > 0.5) != (logits.sigmoid() > 0.5)
    hard = (logits.sigmoid() > 0.5).float()
    return (
        f"the thresholded mask carries a gradient: {hard.requires_grad}; "
        f"a nudge of 1e-4 changes {int(nudged.sum())} of {len(logits)} pixels"
    )


def held_out() -> str:
    """Sec. V-C: what our own split holds out."""
    seen = {"training": ("train", "val", "rooms_val"), "test": ("test",)}  # rooms_val has the shapes of rooms_train
    shapes = {which: set() for which in seen}
    for which, splits in seen.items():
        for path in sorted(path for split in splits for path in (SAMPLES / split).glob("*/meta.json")):
            things = json.loads(path.read_text(encoding="utf-8"))["meta"]["things"]
            shapes[which] |= {thing["family"] for thing in things if thing["kind"]}
    common = sorted(shapes["training"] & shapes["test"])
    return (
        f"our test objects on table tops: {len(shapes['test'])} glass and metal shapes, of which {len(common)} "
        f"in training, rooms included ({', '.join(common) or 'none'})"
    )


def surpassed() -> str:
    """Sec. V-C: where another method is better."""
    found = {t.name: beaten_in(t.records(), "DITR") for t in (T1, T2, T3)}
    texts = [f"{name} {m} ({who})" for name, beaten in found.items() for m, who in beaten.items()]
    return f"another method is better in {', '.join(texts)}"


def posterior_mean() -> str:
    """Sec. III: a perfect sampler and the mean of its samples, scored."""
    truth, *draws = np.random.default_rng(0).normal(1.0, 0.05, (17, 100_000))
    one, mean = metrics.rmse(draws[0], truth), metrics.rmse(np.mean(draws, axis=0), truth)
    crps = {name: 1000 * metrics.crps(np.stack(e), truth) for name, e in (("16 draws", draws), ("one", draws[:1]))}
    return (
        f"one draw from the exact posterior scores {one / mean:.2f} times the RMSE of the mean of 16; "
        f"CRPS {crps['16 draws']:.0f} mm against {crps['one']:.0f}"
    )


VERDICTS = ("misprint", "in the limit", "not said", "in part", "contradictory", "no")


@dataclass(frozen=True)
class Entry:
    """One claim.

    Attributes:
        number: 1 to 20.
        where: equation, table or section of the paper.
        says: what stands there, in our words.
        measured: computes what we found, one sentence.
        holds: one of VERDICTS.
        ours: what we do instead, or about it.
        notebook: where it is shown at length.
    """

    number: int
    where: str
    says: str
    measured: Callable[[], str]
    holds: str
    ours: str
    notebook: str


_ROWS = [
    ("Eq. 9", "ε = L_t − α_t x_θ", noise_scale, "misprint", "divide by √(1 − ᾱ_t)", "04_ddpm_math"),
    (
        "Eq. 7",
        "L_t given L_0 is N(0, I)",
        signal_left,
        "in the limit",
        "DDPM's mean and variance",
        "04_ddpm_math",
    ),
    (
        "Sec. IV-C, Eq. 2",
        "M_DA = M_RGB ∖ ∁M_D; disjoint: {φ}",
        intersection,
        "misprint",
        "an intersection with a tolerance of 2 pixels; ∅",
        "05_boundary_maps",
    ),
    (
        "Eq. 4–6",
        "sums over the image are divided by HW",
        unknown_pixels,
        "misprint",
        "divide by the number of known pixels, as the paper's experiments do",
        "07_metrics",
    ),
    (
        "Sec. V-B",
        "δ counts pixels whose relative loss is below n %",
        bands,
        "no",
        "the field's max(p/g, g/p) < 1 + n %",
        "07_metrics",
    ),
    (
        "Tables I, II, V",
        "RMSE and MAE stand side by side",
        impossible,
        "no",
        "average all columns alike; the pooled value beside the mean",
        "07_metrics",
    ),
    (
        "Table I",
        "scores are 'overall'",
        optical_weight,
        "not said",
        "whole, optical, geometric and outside always apart",
        "07_metrics",
    ),
    (
        "Sec. V-A",
        "TODD has 57,715 image sets",
        dataset_sizes,
        "no",
        "name the source of a count",
        "07_metrics",
    ),
    (
        "Sec. V-B",
        "the learning rate mixes a trigonometric and an exponential factor",
        learning_rates,
        "not said",
        "half a cosine × an exponential, beside TROSNet's law; the shipped weights: warm-up and cosine in each run",
        "02_region_refinement",
    ),
    (
        "Table VI",
        "stage two takes 206 GFLOPs and 2.26 s (1,000 steps, two branches, two ViT-L extractors)",
        operations,
        "no",
        "count every network; `python -m ditr_lite bench` times them",
        "04_ddpm_math",
    ),
    (
        "Sec. IV-C",
        "SAM gives boundary maps; the denoiser gets F(x)",
        inputs,
        "not said",
        "backends behind one call; known depth and mask are channels of x",
        "05_boundary_maps",
    ),
    (
        "Sec. V-B",
        "learning rate 1e-6 at batch 64",
        base_rate,
        "not said",
        "the rate itself stands in the recipe",
        "04_ddpm_math",
    ),
    (
        "Sec. IV-A",
        "masks times depth go to the branches: literally the optical one gets the readings inside; for ClearGrasp they "
        "are set to zero (Sec. V-C)",
        in_region_evidence,
        "contradictory",
        "readings inside are evidence, never known depth; two baselines keep them",
        "08_ablations",
    ),
    (
        "Sec. IV-C",
        "L = Enc(D_in); CNN-based and transformer-based; a decoder that contains an encoder",
        latent_target,
        "contradictory",
        "the target is Enc of the ground truth; convolutions only",
        "03_vq_autoencoder",
    ),
    (
        "Sec. IV-C",
        "the feature is the query, L_t key and value",
        attention,
        "in part",
        "both built: the printed one, as Perceiver IO's decoder asks, which the paper cites, and latent diffusion's",
        "04_ddpm_math",
    ),
    (
        "Sec. IV-B",
        "median 7 × 7, dilation 5 × 5, three times; of no named resolution",
        refinement,
        "not said",
        "kernels chosen on the validation split",
        "02_region_refinement",
    ),
    (
        "Sec. IV-B",
        "stage one is fine-tuned with the final RMSE",
        gradients,
        "no",
        "soft stand-ins for threshold, median and dilation, one step for the sampler",
        "02_region_refinement",
    ),
    (
        "Sec. V-C",
        "training and testing are not differentiated on ClearGrasp (it trains on the training set, so perhaps only for "
        "pixels without truth); the geometric branch learns on all of STD-CatKnown",
        held_out,
        "in part",
        "the data card says what the test splits hold out, and what not",
        "09_your_own_camera",
    ),
    (
        "Sec. V-C, V-G",
        "DITR surpasses all previous (on TODD) or other methods",
        surpassed,
        "no",
        "intervals, and ties and defeats named",
        "07_metrics",
    ),
    (
        "Sec. III",
        "RMSE ranks a generative method",
        posterior_mean,
        "in part",
        "CRPS, coverage and flying pixels beside RMSE",
        "07_metrics",
    ),
]
ENTRIES = tuple(Entry(number, *row) for number, row in enumerate(_ROWS, start=1))


def format_ledger(entries: tuple[Entry, ...] = ENTRIES) -> str:
    """Compute every entry and return the ledger as a Markdown table."""
    head = ("#", "where", "the paper says", "we measured", "holds?", "we do", "notebook")
    lines = [head, ("---",) * len(head)]
    for e in entries:
        lines.append((str(e.number), e.where, e.says, e.measured(), e.holds, e.ours, f"`{e.notebook}`"))
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
