"""The ledger of claims: *the paper says / we measured / holds?* for every doubtful point, each with its computation.

A misprint is called a misprint; what is not said is called not said. ``entry.measured()`` computes the middle column.
"""

from collections.abc import Callable
from dataclasses import dataclass

from . import findings

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
    ("Eq. 9", "ε = L_t − α_t x_θ", findings.noise_scale, "misprint", "divide by √(1 − ᾱ_t)", "04_ddpm_math"),
    (
        "Eq. 7",
        "L_t given L_0 is N(0, I)",
        findings.signal_left,
        "in the limit",
        "DDPM's mean and variance",
        "04_ddpm_math",
    ),
    (
        "Sec. IV-C, Eq. 2",
        "M_DA = M_RGB ∖ ∁M_D; disjoint: {φ}",
        findings.intersection,
        "misprint",
        "an intersection with a tolerance of 2 pixels; ∅",
        "05_boundary_maps",
    ),
    (
        "Eq. 4–6",
        "sums over the image are divided by HW",
        findings.unknown_pixels,
        "misprint",
        "divide by the number of known pixels, as the paper's experiments do",
        "07_metrics",
    ),
    (
        "Sec. V-B",
        "δ counts pixels whose relative loss is below n %",
        findings.bands,
        "no",
        "the field's max(p/g, g/p) < 1 + n %",
        "07_metrics",
    ),
    (
        "Tables I, II, V",
        "RMSE and MAE stand side by side",
        findings.impossible,
        "no",
        "average all columns alike; the pooled value beside the mean",
        "07_metrics",
    ),
    (
        "Table I",
        "scores are 'overall'",
        findings.optical_weight,
        "not said",
        "whole, optical, geometric and outside always apart",
        "07_metrics",
    ),
    (
        "Sec. V-A",
        "TODD has 57,715 image sets",
        findings.dataset_sizes,
        "no",
        "name the source of a count",
        "07_metrics",
    ),
    (
        "Sec. V-B",
        "the learning rate mixes a trigonometric and an exponential factor",
        findings.learning_rates,
        "not said",
        "half a cosine × an exponential, beside TROSNet's law; the shipped weights: warm-up, then a cosine",
        "02_region_refinement",
    ),
    (
        "Table VI",
        "stage two takes 206 GFLOPs and 2.26 s (1,000 steps, two branches, two ViT-L extractors)",
        findings.operations,
        "no",
        "count every network; `python -m ditr_lite bench` times them",
        "04_ddpm_math",
    ),
    (
        "Sec. IV-C",
        "SAM gives boundary maps; the denoiser gets F(x)",
        findings.inputs,
        "not said",
        "backends behind one call; known depth and mask are channels of x",
        "05_boundary_maps",
    ),
    (
        "Sec. V-B",
        "learning rate 1e-6 at batch 64",
        findings.base_rate,
        "not said",
        "the rate itself stands in the recipe",
        "04_ddpm_math",
    ),
    (
        "Sec. IV-A",
        "inside the mask depth is re-estimated, the readings are dropped",
        findings.in_region_evidence,
        "in part",
        "readings inside are evidence; two baselines keep them",
        "08_ablations",
    ),
    (
        "Sec. IV-C",
        "L = Enc(D_in); CNN-based and transformer-based; a decoder that contains an encoder",
        findings.latent_target,
        "contradictory",
        "the target is Enc of the ground truth; convolutions only",
        "03_vq_autoencoder",
    ),
    (
        "Sec. IV-C",
        "the feature is the query, L_t key and value",
        findings.attention,
        "in part",
        "both built, the printed one and latent diffusion's",
        "04_ddpm_math",
    ),
    (
        "Sec. IV-B",
        "median 7 × 7, dilation 5 × 5, three times; of no named resolution",
        findings.refinement,
        "not said",
        "kernels chosen on the validation split",
        "02_region_refinement",
    ),
    (
        "Sec. IV-B",
        "stage one is fine-tuned with the final RMSE",
        findings.gradients,
        "no",
        "soft stand-ins for threshold, median and dilation, one step for the sampler",
        "02_region_refinement",
    ),
    (
        "Sec. V-C",
        "training and testing are not differentiated on ClearGrasp; the geometric branch learns on all of STD-CatKnown",
        findings.held_out,
        "in part",
        "test shapes and materials are never trained on",
        "09_your_own_camera",
    ),
    (
        "Sec. V-C",
        "DITR surpasses all previous methods",
        findings.surpassed,
        "no",
        "intervals, and ties and defeats named",
        "07_metrics",
    ),
    (
        "Sec. III",
        "RMSE ranks a generative method",
        findings.posterior_mean,
        "in part",
        "CRPS, coverage and flying pixels beside RMSE",
        "07_metrics",
    ),
]
ENTRIES = tuple(Entry(number, *row) for number, row in enumerate(_ROWS, start=1))


def table(entries: tuple[Entry, ...] = ENTRIES) -> str:
    """Compute every entry and return the ledger as a Markdown table."""
    head = ("#", "where", "the paper says", "we measured", "holds?", "we do", "notebook")
    lines = [head, ("---",) * len(head)]
    for e in entries:
        lines.append((str(e.number), e.where, e.says, e.measured(), e.holds, e.ours, f"`{e.notebook}`"))
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
