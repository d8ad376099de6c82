"""Backends of boundary maps: what turns a picture or a depth map into a bool map, chosen by name or brought along.

``classical`` needs no weights, ``learned`` is a small network of ours (shipped), ``sam`` is the paper's network (bring
a checkpoint), ``none`` finds nothing.
"""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Protocol

import numpy as np

from .classical import ClassicalBoundary


class Backend(Protocol):
    """Whatever finds boundaries: one call, for colour and for depth."""

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return (H, W) bool for an image (H, W, 3) uint8, or a depth map (H, W) float metres with 0 = missing."""


def _load_classical(path: Path | str | None = None) -> Backend:
    _refuse_path("classical", path)
    return ClassicalBoundary()


def _load_none(path: Path | str | None = None) -> Backend:
    _refuse_path("none", path)
    return find_nothing


def find_nothing(image: np.ndarray) -> np.ndarray:
    """Return no boundary at all, (H, W) bool; unlike a lambda it can be sent to another process."""
    return np.zeros(np.shape(image)[:2], bool)


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


def own_backend(backend: Backend) -> Backend:
    """Return a caller's boundary backend with a ValueError for anything but a map (h, w) bool of its picture's size."""

    def call(image: np.ndarray) -> np.ndarray:
        found = backend(image)
        try:
            found = np.asarray(found)
        except ValueError:  # ragged lists
            raise ValueError(f"boundary: expected {image.shape[:2]} bool, got {type(found).__name__}") from None
        if found.shape != image.shape[:2] or found.dtype != bool:
            raise ValueError(
                f"boundary: expected {image.shape[:2]} bool of a picture {image.shape}, got {found.shape} {found.dtype}"
            )
        return found

    return call
