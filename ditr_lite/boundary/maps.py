"""Boundary maps that guide stage two: M_RGB from colour, M_D from depth, M_DA where both agree.

Paper: Sec. IV-C "Feature Extractor". The paper runs SAM (ViT-L) on RGB and on depth and calls the outlines of its
masks M_RGB and M_D; how a set of masks becomes a map is not said. Here anything that turns an image into a bool map
is a backend, chosen by name: ``classical`` needs no weights, ``learned`` is a small network of ours (shipped), ``sam``
is the paper's network (bring a checkpoint), ``none`` finds nothing.

Convention: a boundary belongs to the surface in front: the marked pixels are its outermost ones, one pixel wide.
"""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from skimage.segmentation import find_boundaries

from ..data import Sample
from .classical import ClassicalBoundary, is_depth

__all__ = [
    "BACKENDS",
    "Backend",
    "ClassicalBoundary",
    "ExactBoundary",
    "boundaries_from_labels",
    "boundary_maps",
    "depth_aware",
    "depth_boundaries",
    "get_backend",
    "precision_recall_f",
    "true_maps",
    "within",
]

M_RGB, M_D, M_DA = range(3)  # places in what boundary_maps returns


class Backend(Protocol):
    """Whatever finds boundaries: one call, for colour and for depth."""

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return (H, W) bool for an image (H, W, 3) uint8, or a depth map (H, W) float metres with 0 = missing."""


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
    for axis in (0, 1):
        (a, b), (z, y) = (
            (np.take(m, range(m.shape[axis] - 1), axis), np.take(m, range(1, m.shape[axis]), axis))
            for m in (instances, depth_gt)
        )
        found = (a != b) & (z > 0) & (y > 0) & (np.abs(z - y) > jump)
        last = [(0, 0), (0, 0)]
        last[axis] = (0, 1)
        jumps |= np.pad(found, last) | np.pad(found, [pair[::-1] for pair in last])
    return outline & jumps


class ExactBoundary:
    """Answer with the truth of one rendered frame: the best guides there can be.

    Args:
        instances: (H, W) int, 0 = background.
        depth_gt: (H, W) float metres, 0 = unknown.
        jump: see :func:`depth_boundaries`.
    """

    def __init__(self, instances: np.ndarray, depth_gt: np.ndarray, jump: float = 0.01):
        self.colour, self.depth = boundaries_from_labels(instances), depth_boundaries(instances, depth_gt, jump)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return all outlines for a colour image, those with a depth jump for a depth map; (H, W) bool."""
        return (self.depth if is_depth(np.asarray(image)) else self.colour).copy()


def _load_classical(path: Path | str | None = None) -> Backend:
    _refuse_path("classical", path)
    return ClassicalBoundary()


def _load_none(path: Path | str | None = None) -> Backend:
    _refuse_path("none", path)
    return lambda image: np.zeros(np.shape(image)[:2], bool)


def _refuse_path(name: str, path: Path | str | None) -> None:
    if path is not None:
        raise ValueError(f"backend {name!r} has no weights; leave out path={str(path)!r}")


def _load_module(name: str) -> Callable[[Path | str | None], Backend]:
    # imported on first use: neither torch nor transformers is needed by those who do not ask for them
    return lambda path=None: import_module(f"{__package__}.{name}").load(path)


# name -> loader(path or None). A loader, not an object: weights are read only by those who ask for them.
BACKENDS: dict[str, Callable[..., Backend]] = {
    "classical": _load_classical,
    "learned": _load_module("learned"),
    "sam": _load_module("sam"),
    "none": _load_none,
}


def get_backend(name: str, path: Path | str | None = None) -> Backend:
    """Return the boundary backend called ``name``.

    Args:
        name: a key of :data:`BACKENDS`.
        path: ``learned``: a weights folder other than the shipped one; ``sam``: the folder of the checkpoint.

    Raises:
        ValueError: for an unknown name, or weights that are absent or cannot be used.
    """
    if name not in BACKENDS:
        raise ValueError(f"unknown boundary backend {name!r}; choose one of {', '.join(BACKENDS)}")
    return BACKENDS[name](path)


def within(mask: np.ndarray, tolerance: float) -> np.ndarray:
    """Return (H, W) bool: the pixels at most ``tolerance`` pixels (Euclidean) from a true pixel of ``mask``."""
    if not mask.any():
        return np.zeros(mask.shape, bool)  # OpenCV leaves the distance to an empty set undefined
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return distance <= tolerance + 1e-4  # float32 distances: 2 px must count as 2


def depth_aware(boundary_rgb: np.ndarray, boundary_depth: np.ndarray, tolerance: float = 2) -> np.ndarray:
    r"""Keep the colour boundaries that depth confirms.

    Paper: Sec. IV-C, I4, M_DA = M_RGB \ complement(M_D), "only RGB boundaries that appear on depth boundary maps are
    real boundaries between objects". Erratum: A \ complement(B) is the plain intersection of A and B, and of two maps
    one pixel wide, found in two images with different noise, hardly any pixel coincides. So M_D is first grown by
    ``tolerance``; tolerance 0 is the formula as printed.

    Args:
        boundary_rgb: (H, W) bool, M_RGB.
        boundary_depth: (H, W) bool, M_D.
        tolerance: pixels, Euclidean, >= 0.

    Returns:
        (H, W) bool, a subset of M_RGB.

    Raises:
        ValueError: for maps that are not bool and of one shape, or a negative tolerance.
    """
    _check_pair(boundary_rgb, boundary_depth, tolerance)
    return boundary_rgb & within(boundary_depth, tolerance)


def boundary_maps(
    rgb: np.ndarray, depth: np.ndarray, backend: Backend | None = None, tolerance: float = 2
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (M_RGB, M_D, M_DA) of one frame, each (H, W) bool.

    Paper: Sec. IV-C, S8: the optical branch is guided by M_DA, the geometric one by M_RGB.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float metres, raw, 0 = missing.
        backend: what finds boundaries, from :func:`get_backend`; None for the classical one.
        tolerance: see :func:`depth_aware`.

    Raises:
        ValueError: when the two images differ in size, or the backend or the tolerance cannot be used.
    """
    rgb, depth = np.asarray(rgb), np.asarray(depth)
    if rgb.shape[:2] != depth.shape:
        raise ValueError(f"expected rgb and depth of one size, got {rgb.shape} and {depth.shape}; resize one")
    backend = ClassicalBoundary() if backend is None else backend
    m_rgb, m_d = backend(rgb), backend(depth)
    return m_rgb, m_d, depth_aware(m_rgb, m_d, tolerance)


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
    _check_pair(pred, true, tolerance)
    right, hit = (pred & within(true, tolerance)).sum(), (true & within(pred, tolerance)).sum()
    nan = float("nan")
    precision = float(right / pred.sum()) if pred.any() else nan
    recall = float(hit / true.sum()) if true.any() else nan
    if not right:
        return precision, recall, 0.0 if pred.any() or true.any() else nan
    return precision, recall, float(2 * precision * recall / (precision + recall))


def _check_pair(a: np.ndarray, b: np.ndarray, tolerance: float) -> None:
    if a.shape != b.shape or a.ndim != 2 or a.dtype != bool or b.dtype != bool:
        raise ValueError(f"expected two (H, W) bool maps of one size, got {a.shape} {a.dtype} and {b.shape} {b.dtype}")
    if tolerance < 0:
        raise ValueError(f"expected a tolerance >= 0 pixels, got {tolerance}")


def true_maps(sample: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Return the truth for M_RGB and the truth for M_DA, each (H, W) bool.

    Raises:
        ValueError: for a frame without instances or true depth.
    """
    if sample.instances is None or sample.depth_gt is None:
        raise ValueError(f"{sample.name} has no instances or no true depth: boundaries need rendered scenes")
    return boundaries_from_labels(sample.instances), depth_boundaries(sample.instances, sample.depth_gt)
