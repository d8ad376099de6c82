"""What boundary maps should find: the true outlines of rendered objects, and how near a map comes to them.

Ours; the paper scores no boundary map. The outlines come from the simulator's labels and its true depth, so they are
exact: the outermost pixels of each object, and of these the ones at which depth jumps.
"""

import numpy as np
from skimage.segmentation import find_boundaries

from ..data import Sample
from .classical import is_depth
from .maps import check_pair, within

ALL = slice(None)
# Every pair of neighbours once: a pixel and the one on its right, a pixel and the one below it.
NEIGHBOURS = (
    ((ALL, slice(None, -1)), (ALL, slice(1, None))),
    ((slice(None, -1), ALL), (slice(1, None), ALL)),
)


def boundaries_from_labels(instances: np.ndarray) -> np.ndarray:
    """Mark the outermost pixels of every labelled object.

    ``skimage.segmentation.find_boundaries`` with mode "inner": the marked pixel lies on the object and has a
    4-neighbour with another label; background (0) is never marked. One pixel wide, two where two objects touch.

    Args:
        instances: (H, W) int, 0 = background.

    Returns:
        (H, W) bool.

    Raises:
        ValueError: when ``instances`` is not (H, W) of integers.
    """
    instances = np.asarray(instances)
    if instances.ndim != 2 or not np.issubdtype(instances.dtype, np.integer):
        raise ValueError(f"expected instance labels (H, W) of integers, got {instances.shape} {instances.dtype}")
    return find_boundaries(instances, connectivity=1, mode="inner", background=0)


def depth_boundaries(instances: np.ndarray, depth_gt: np.ndarray, jump: float = 0.01) -> np.ndarray:
    """Mark those outlines at which true depth jumps: what M_D and M_DA should find.

    An outline pixel counts when true depth differs by more than ``jump`` from a 4-neighbour of another label: an
    object's foot on the table is an outline, yet no jump.

    Args:
        instances: (H, W) int, 0 = background.
        depth_gt: (H, W) float metres, 0 = unknown, which is no jump.
        jump: metres.

    Returns:
        (H, W) bool, a subset of :func:`boundaries_from_labels`.

    Raises:
        ValueError: for maps of different size, or a negative jump.
    """
    outline = boundaries_from_labels(instances)
    if depth_gt.shape != outline.shape or jump < 0:
        raise ValueError(f"expected depth_gt {outline.shape} and jump >= 0, got {depth_gt.shape} and {jump}")
    jumps = np.zeros(outline.shape, bool)
    for first, second in NEIGHBOURS:
        differ = instances[first] != instances[second]
        known = (depth_gt[first] > 0) & (depth_gt[second] > 0)
        apart = np.abs(depth_gt[first] - depth_gt[second]) > jump
        found = differ & known & apart  # one entry a pair of neighbours
        jumps[first] |= found
        jumps[second] |= found
    return outline & jumps


class ExactBoundary:
    """Answer with the truth of one rendered frame: the best guides there can be.

    Args:
        instances: (H, W) int, 0 = background.
        depth_gt: (H, W) float metres, 0 = unknown.
    """

    def __init__(self, instances: np.ndarray, depth_gt: np.ndarray):
        self.colour = boundaries_from_labels(instances)
        self.depth = depth_boundaries(instances, depth_gt)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return all outlines for a colour image, those with a depth jump for a depth map; (H, W) bool."""
        return (self.depth if is_depth(np.asarray(image)) else self.colour).copy()


def precision_recall_f(pred: np.ndarray, true: np.ndarray, tolerance: float = 1) -> tuple[float, float, float]:
    """Score a boundary map against the true one.

    Precision is the share of predicted pixels with a true one within ``tolerance``, recall the share of true pixels
    with a predicted one, F their harmonic mean. (Simpler than the one-to-one matching of the Berkeley benchmark:
    thick predictions are not punished for being thick.)

    Args:
        pred: (H, W) bool.
        true: (H, W) bool.
        tolerance: pixels, Euclidean, >= 0.

    Returns:
        (precision, recall, F) in [0, 1]; NaN for a share of an empty set, F only when both maps are empty.

    Raises:
        ValueError: for maps that are not bool and of one shape, or a negative tolerance.
    """
    check_pair(pred, true, tolerance)
    right = (pred & within(true, tolerance)).sum()
    hit = (true & within(pred, tolerance)).sum()
    nan = float("nan")
    precision = float(right / pred.sum()) if pred.any() else nan
    recall = float(hit / true.sum()) if true.any() else nan
    if not right:
        return precision, recall, 0.0 if pred.any() or true.any() else nan
    return precision, recall, float(2 * precision * recall / (precision + recall))


def true_maps(sample: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Return the truth for M_RGB and the truth for M_DA, each (H, W) bool.

    Raises:
        ValueError: for a frame without instances or true depth.
    """
    if sample.instances is None or sample.depth_gt is None:
        raise ValueError(f"{sample.name} has no instances or no true depth: boundaries need rendered scenes")
    return boundaries_from_labels(sample.instances), depth_boundaries(sample.instances, sample.depth_gt)
