"""Boundary maps that guide stage two: M_RGB from colour, M_D from depth, M_DA where both agree.

Paper: Sec. IV-C "Feature Extractor". The paper runs SAM (ViT-L) on RGB and on depth, which gives masks, and gets
the maps M_RGB and M_D; how, it does not say. We take the masks' outlines. Here anything that turns an image into a bool
map is a backend, see ``backends``.

Convention: a boundary belongs to the surface in front: the marked pixels are its outermost ones, one pixel wide.
"""

import cv2
import numpy as np

from .backends import Backend
from .classical import ClassicalBoundary

M_RGB, M_D, M_DA = range(3)  # places in what boundary_maps returns


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
    check_pair(boundary_rgb, boundary_depth, tolerance)
    return boundary_rgb & within(boundary_depth, tolerance)


def boundary_maps(
    rgb: np.ndarray, depth: np.ndarray, backend: Backend | None = None, tolerance: float = 2
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (M_RGB, M_D, M_DA) of one frame, each (H, W) bool.

    Paper: Sec. IV-C, S8: the optical branch is guided by M_DA, the geometric one by M_RGB.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float metres, raw, 0 = missing.
        backend: what finds boundaries, from :func:`backends.get_backend`; None for the classical one.
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


def check_pair(a: np.ndarray, b: np.ndarray, tolerance: float) -> None:
    """Raise a ValueError unless ``a`` and ``b`` are bool maps (H, W) of one size and ``tolerance`` is >= 0 pixels."""
    if a.shape != b.shape or a.ndim != 2 or a.dtype != bool or b.dtype != bool:
        raise ValueError(f"expected two (H, W) bool maps of one size, got {a.shape} {a.dtype} and {b.shape} {b.dtype}")
    if tolerance < 0:
        raise ValueError(f"expected a tolerance >= 0 pixels, got {tolerance}")
