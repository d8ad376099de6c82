"""When does it fail? Every frame described by what is known of its scene, and the errors ranked against that.

Paper: Sec. V-G and Fig. 13 show failures on objects that are "too large" and on overlapping ones, picked by hand.
Picked frames show that such failures exist, not that they are more frequent there; a search over all frames can tell.
"""

from collections.abc import Mapping

import numpy as np

from ..data import Sample
from ..evaluation.statistics import spearman_bootstrap

MIN_PIXELS = 20  # fewer of an object are a sliver between others, not an object that is seen
DESCRIBED = {  # what a frame is described by: name -> what it says
    "region_share": "share of the picture that is glass or mirror",
    "largest_share": "share of the picture that the largest such object covers",
    "objects": "number of glass and metal objects seen",
    "overlap": "share of their outlines that borders another object",
    "distance_m": "median true distance of the region, m",
    "missing_share": "share of the region without a reading",
    "miss_rate": "share of the region that stage one misses",
}
PAPER = ("largest_share", "overlap")  # Sec. V-G names these two
Description = dict[str, float | None]


def describe(sample: Sample, miss_rate: float | None = None) -> Description:
    """Return the figures of :data:`DESCRIBED` for one frame.

    Args:
        sample: with region, instances and ground truth.
        miss_rate: of stage one after refinement, as ``evaluate`` measures it; None where it is not known.

    Raises:
        ValueError: for a frame without those, or with nothing in its region.
    """
    if sample.region is None or sample.instances is None or sample.depth_gt is None:
        raise ValueError(f"{sample.name} lacks region, instances or ground truth: describe rendered scenes")
    known = sample.region & (sample.depth_gt > 0)
    if not known.any():
        raise ValueError(f"{sample.name} has nothing in its region: there is no optical error to explain")
    sizes = np.bincount(sample.instances[sample.region])
    seen = sizes[1:][sizes[1:] >= MIN_PIXELS]
    return {
        "region_share": float(sample.region.mean()),
        "largest_share": float(sizes[1:].max(initial=0) / sample.region.size),
        "objects": float(len(seen)),
        "overlap": overlap(sample.instances, sample.region),
        "distance_m": float(np.median(sample.depth_gt[known])),
        "missing_share": float((sample.depth[sample.region] == 0).mean()),
        "miss_rate": miss_rate,
    }


def overlap(instances: np.ndarray, region: np.ndarray) -> float:
    """Return which share of the outline of glass and metal objects borders another object and not the background.

    The outline is counted in pairs of pixels above or beside each other that belong to different instances, at least
    one of them in the region. Whether objects overlap or only touch in the picture makes no difference to a camera.

    Args:
        instances: (H, W) whole numbers, 0 = background.
        region: (H, W) bool.

    Returns:
        0 to 1; 0 for a region without any outline.

    Raises:
        ValueError: for maps of different shapes.
    """
    if instances.shape != region.shape:
        raise ValueError(f"instances are {instances.shape}, the region {region.shape}: they should be alike")
    outline = shared = 0
    for one, other in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        apart = (instances[one] != instances[other]) & (region[one] | region[other])
        outline += int(apart.sum())
        shared += int((apart & (instances[one] > 0) & (instances[other] > 0)).sum())
    return shared / outline if outline else 0.0


def correlations(
    errors: Mapping[str, float | None], described: Mapping[str, Description]
) -> dict[str, tuple[float, float, float] | None]:
    """Return Spearman's correlation of the error with every figure of :data:`DESCRIBED`, over the frames in both.

    Returns:
        figure -> (rho, low, high); None where it cannot be told (not measured, or the same in all frames).
    """
    names = [name for name in described if errors.get(name) is not None]
    out = {}
    for key in DESCRIBED:
        try:
            out[key] = spearman_bootstrap([described[name][key] for name in names], [errors[name] for name in names])
        except ValueError:
            out[key] = None
    return out


def partial_correlations(
    errors: Mapping[str, float | None], described: Mapping[str, Description]
) -> dict[str, tuple[float, float, float] | None]:
    """Return :func:`correlations` of the paper's two cases, each with the other one held fixed.

    Scenes with large objects also have more outlines that meet: without this, one case would stand in for the other.

    Returns:
        case of :data:`PAPER` -> (partial rank correlation, low, high); None where it cannot be told.
    """
    names = [name for name in described if errors.get(name) is not None]
    column = {key: [described[name][key] for name in names] for key in PAPER}
    out = {}
    for key, other in zip(PAPER, PAPER[::-1], strict=True):
        try:
            out[key] = spearman_bootstrap(column[key], [errors[name] for name in names], held=column[other])
        except ValueError:
            out[key] = None
    return out


def format_ranges(described: Mapping[str, Description]) -> str:
    """Return a line for each figure of :data:`DESCRIBED`: name, what it says, range over the frames that have it."""
    lines = []
    for key, says in DESCRIBED.items():
        values = [d[key] for d in described.values() if d[key] is not None]
        lines.append(
            f"{key:14} {says:57} " + (f"{min(values):6.3f} to {max(values):6.3f}" if values else "not measured")
        )
    return "\n".join(lines)


def worst(errors: Mapping[str, float | None], count: int = 10) -> list[str]:
    """Return the names of the frames with the largest errors, the worst first; frames without an error do not count."""
    scored = {name: error for name, error in errors.items() if error is not None}
    return sorted(scored, key=lambda name: -scored[name])[:count]


def correlation_verdict(key: str, rho: tuple[float, float, float] | None) -> str:
    """Return in words what a correlation says about one figure of :data:`DESCRIBED`."""
    if rho is None:
        return f"{key}: cannot be told from these frames"
    said = "errors grow with it" if rho[1] > 0 else "errors shrink with it" if rho[2] < 0 else "no measurable relation"
    return "{}: {} (rank correlation {:+.2f} [{:+.2f}, {:+.2f}])".format(key, said, *rho)


def format_verdicts(
    rho: Mapping[str, tuple[float, float, float] | None], apart: Mapping[str, tuple[float, float, float] | None]
) -> str:
    """Return :func:`correlation_verdict` of every figure, and whether the paper's two cases are confirmed.

    Args:
        rho: as :func:`correlations` returns it.
        apart: as :func:`partial_correlations` returns it; a case is confirmed where its interval lies above 0.
    """
    lines = [correlation_verdict(key, found) for key, found in rho.items()]
    for key, other in zip(PAPER, PAPER[::-1], strict=True):
        confirmed = apart[key] is not None and apart[key][1] > 0
        left = "{:+.2f} [{:+.2f}, {:+.2f}] is left".format(*apart[key]) if apart[key] else "it cannot be told"
        lines.append(
            f"the paper's case '{key}': {'confirmed' if confirmed else 'not confirmed'} on these scenes; "
            f"with {other} held fixed {left}"
        )
    return "\n".join(lines)
