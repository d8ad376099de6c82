"""Boundary maps, the guides of stage two: how they are found, by which backend, and what the truth is."""

from .backends import BACKENDS, Backend, get_backend, own_backend
from .classical import ClassicalBoundary
from .maps import M_D, M_DA, M_RGB, boundary_maps, depth_aware, within
from .truth import ExactBoundary, boundaries_from_labels, depth_boundaries, precision_recall_f, true_maps

__all__ = [
    "BACKENDS",
    "Backend",
    "ClassicalBoundary",
    "ExactBoundary",
    "M_D",
    "M_DA",
    "M_RGB",
    "boundaries_from_labels",
    "boundary_maps",
    "depth_aware",
    "depth_boundaries",
    "get_backend",
    "own_backend",
    "precision_recall_f",
    "true_maps",
    "within",
]
