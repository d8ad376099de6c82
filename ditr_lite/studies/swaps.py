"""What if? The trained system with one thing exchanged or withheld at a time; nothing is trained anew.

A swap asks what the shipped weights lean on. It does not ask what a system trained without that thing would reach: such
a system could learn to do without. Paper: Table IV takes stage one away (here ``empty region``) and its refinement
(``unrefined``) in this very manner, and Sec. IV-C gives each branch its guide; Table V breaks the error down.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from .. import metrics
from ..boundary import M_DA, M_RGB
from ..config import RefineConfig
from ..data import Sample
from ..evaluation.statistics import bootstrap_mean, interval, paired_bootstrap
from ..paper.tables import T1, T5
from ..pipeline import Ditr, compose
from ..stage_two import BRANCHES, Plan
from ..units import check_inputs
from ..windows import RIM

SCORED = ("optical", "geometric", "outside", "whole")
PARTS = ("geometric", "optical", "whole")  # Table V's two, and Table I's
TABLE_V = ("rmse", "mae", "rel")
DIGITS = 5  # of metres: a hundredth of a millimetre
Rows = dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class Swap:
    """One thing exchanged.

    Attributes:
        says: what, in words.
        guides: which boundary map guides the optical and the geometric branch; None for an empty one.
        only: the branch that paints everything, with its own guide; None for each its own part.
        evidence: whether the optical branch may see in-region readings.
        detail: whether the finer final step is taken.
        rim: pixels by which windows show the region wider than it is.
        refine: of the found region; None for the configuration's.
        region: "found" by stage one, the "true" one, or "empty".
        against: the swap that it is compared with.
    """

    says: str
    guides: tuple[int | None, int | None] = (M_DA, M_RGB)
    only: str | None = None
    evidence: bool = True
    detail: bool = True
    rim: int = RIM
    refine: RefineConfig | None = None
    region: str = "found"
    against: str = "default"

    def __post_init__(self):
        """Refuse what the system does not have."""
        if self.only not in (None, *BRANCHES) or self.region not in ("found", "true", "empty"):
            raise ValueError(
                f"expected only to be None or one of {', '.join(BRANCHES)} and region found, true or empty; "
                f"got {self.only!r}, {self.region!r}"
            )

    @property
    def plan(self) -> Plan:
        """Return what stage two is told."""
        painters = (self.only, self.only) if self.only else BRANCHES
        guides = tuple(self.guides[BRANCHES.index(painter)] for painter in painters)
        return Plan(painters, guides, self.evidence, self.detail, self.rim)


SWAPS: dict[str, Swap] = {
    "default": Swap("the shipped system"),
    "guides swapped": Swap("M_RGB guides the optical branch, M_DA the geometric one", (M_RGB, M_DA)),
    "no guide": Swap("both branches get an empty boundary map", (None, None)),
    "no evidence": Swap("the readings inside the region are hidden, as we read the paper", evidence=False),
    "no detail": Swap("the decoder's depth as it is, as in the paper", detail=False),
    "exact region": Swap("windows show the region as it is, not two pixels wider", rim=0),
    "optical everywhere": Swap("the optical branch also fills the holes outside", only="optical"),
    "geometric everywhere": Swap("the geometric branch also repaints the region", only="geometric"),
    "empty region": Swap("no stage one: every reading is kept, every hole geometric", region="empty"),
    "unrefined": Swap("stage one's mask as it is", refine=RefineConfig(0, 0, 0)),
    "refined 7/5/3": Swap("refined with the paper's kernels", refine=RefineConfig(7, 5, 3)),
    "true region": Swap("the true region is given", region="true"),
    "true, no evidence": Swap("the same without evidence", evidence=False, region="true", against="true region"),
    "true, exact": Swap("the same shown as it is", rim=0, region="true", against="true region"),
}


@dataclass(frozen=True)
class Swapped:
    """A system with one thing exchanged, which is told to it with every frame: the system itself stays as it is.

    The finer final step keeps its own guide, M_RGB, whatever the branches are given: one thing at a time.

    Attributes:
        ditr: the system.
        swap: what is exchanged.
    """

    ditr: Ditr
    swap: Swap

    def complete(self, sample: Sample, samples: int | None = None, seed: int = 0) -> np.ndarray:
        """Return the completed depth (H, W) in metres; ``samples`` and ``seed`` as for :class:`Ditr`.

        Raises:
            ValueError: where the true region is wanted and not known.
        """
        return self.paint(sample, self.region(sample), samples, seed)

    def region(self, sample: Sample) -> np.ndarray:
        """Return the region (H, W) bool that the swap gives or lets stage one find."""
        if self.swap.region == "true" and sample.region is None:
            raise ValueError(f"{sample.name} has no true region to give; choose a swap whose region is found")
        if self.swap.region == "true":
            return sample.region
        if self.swap.region == "empty":
            return np.zeros(sample.depth.shape, bool)
        rgb, depth, _ = check_inputs(sample.rgb, sample.depth, None, 1)
        return self.ditr.find_region(rgb, depth, refine=self.swap.refine)[1]

    def paint(self, sample: Sample, region: np.ndarray, samples: int | None = None, seed: int = 0) -> np.ndarray:
        """Return the completed depth (H, W) in metres for a region (H, W) bool."""
        sampler = self.ditr.config.sampler
        samples = sampler.samples if samples is None else samples
        rgb, depth, region = check_inputs(sample.rgb, sample.depth, region, samples)
        painting = self.ditr.inpaint(rgb, depth, region, sampler.steps, samples, seed, self.swap.plan)
        return compose(depth, painting.optical, painting.geometric, region)


def score_swaps(
    ditr: Ditr,
    samples: Sequence[Sample],
    swaps: Mapping[str, Swap] = SWAPS,
    draws: int | None = None,
    progress: bool = True,
) -> Rows:
    """Complete every frame under every swap, from the same noise, and score it.

    Args:
        ditr: the system.
        samples: frames with ground truth and region.
        swaps: name -> swap.
        draws: samples a frame; None for the configuration's.
        progress: show a bar.

    Returns:
        name -> what ``metrics.evaluate`` gives, one entry a frame.
    """
    systems = {name: Swapped(ditr, swap) for name, swap in swaps.items()}
    rows: Rows = {name: [] for name in swaps}
    for sample in tqdm(samples, desc="swaps", unit="frame", **({} if progress else {"disable": True})):
        for name, system in systems.items():
            depth = system.complete(sample, draws)
            rows[name].append(metrics.evaluate(depth, sample.depth_gt, sample.region, sample.depth))
    return rows


def summarise_swaps(rows: Rows) -> dict[str, Any]:
    """Return per swap and pixel set the RMSE in metres and its paired difference to what it is compared with.

    Returns:
        name -> ``says``, ``against`` (None for what all are compared with) and, for each of :data:`SCORED`, ``rmse_m``
        and ``minus_m``, both [mean, low, high] at 95 % over frames, None where there is nothing to compare.
    """
    rmse = {name: {key: [s[key] and s[key]["rmse"] for s in scores] for key in SCORED} for name, scores in rows.items()}
    out = {}
    for name in rows:
        other = None if SWAPS[name].against == name else SWAPS[name].against
        out[name] = {"says": SWAPS[name].says, "against": other}
        for key in SCORED:
            minus = other and interval(paired_bootstrap, rmse[name][key], rmse[other][key], digits=DIGITS)
            out[name][key] = {"rmse_m": interval(bootstrap_mean, rmse[name][key], digits=DIGITS), "minus_m": minus}
    return out


def breakdown(scores: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, list[float] | None]]:
    """Return Table V's figures of one system: part -> metric -> [mean, low, high] over frames, metres or a ratio."""
    return {
        part: {m: interval(bootstrap_mean, [s[part] and s[part][m] for s in scores], digits=DIGITS) for m in TABLE_V}
        for part in PARTS
    }


def format_swaps(report: Mapping[str, Mapping[str, Any]], sets: Sequence[str] = ("optical", "geometric")) -> str:
    """Return :func:`summarise_swaps`'s result as text: RMSE in mm, and the difference with its interval."""
    width = max(len(name) for name in report)
    lines = [" " * width + "".join(f"{key + ' mm':>13}  {'minus':>6} [95 % interval]" for key in sets)]
    for name, row in report.items():
        line = name.ljust(width)
        for key in sets:
            mean = row[key]["rmse_m"]
            line += f"{1000 * mean[0]:13.1f}" if mean else f"{'-':>13}"
            gap = row[key]["minus_m"]
            line += "  {:+6.1f} [{:+6.1f}, {:+6.1f}]".format(*(1000 * x for x in gap)) if gap else " " * 24
        lines.append(line + (f"  to {row['against']}" if row["against"] not in (None, "default") else ""))
    return "\n".join(lines)


def beside_table_v(parts: Mapping[str, Mapping[str, Any]]) -> str:
    """Return :func:`breakdown` beside the paper's row, its columns as printed and in the order that fits best."""
    printed = T5.records()["DITR"]
    fitting = T5.reordered(("rmse", "rel", "mae")).records()["DITR"]
    overall = T1.records()["DITR"]
    lines = [f"{'':10}{'':5}{'ours':>8} {'[95 % interval]':>17}{'T5 as printed':>15}{'RMSE, REL, MAE':>16}"]
    for part in PARTS:
        for metric in TABLE_V:
            mean, low, high = parts[part][metric]
            both = (overall[metric],) * 2 if part == "whole" else (d[f"{part}.{metric}"] for d in (printed, fitting))
            line = f"{part:10}{metric.upper():5}{mean:8.4f} [{low:7.4f}, {high:.4f}]{{:15.3f}}{{:16.3f}}".format(*both)
            lines.append(line + (" (T1)" if part == "whole" else ""))
    return "\n".join(lines)
