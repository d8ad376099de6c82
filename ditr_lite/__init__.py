"""Depth completion of transparent and reflective objects by latent diffusion: ``import ditr_lite as dl``.

Everything is loaded on first use, so the import itself costs nothing: ``dl.load_sample`` brings in ``data``,
``dl.Ditr`` brings in torch, ``dl.metrics`` is the module of that name. The top reads as the paper does:

    what everything stands on   units config camera files data store
    why depth is missing        loss_types: optical and geometric, the paper's partition
    the way into a network      conditioning: depth to tensors and back, bounds; windows: the size it needs
    stage one                   region/: network, refinement; its pretrained encoder of colour
    the guides                  boundary/: maps, truth, backends
    stage two                   autoencoder schedule diffusion unet detail; stage_two: all of it, in five steps
    the whole                   pipeline: Ditr, both stages, how the branches are composed
    how good it is              metrics, and what to beat: baselines

The rest is in rooms: ``datasets`` (real data), ``viz`` (pictures), ``simulator`` (rendered scenes and sensors),
``training``, ``evaluation`` (scores, intervals, costs), ``paper`` (its tables, claims), ``studies``, ``peers``
(stand-ins for other systems), ``exercises`` (checkers of the notebooks) and ``cli`` (``python -m ditr_lite``).
"""

from importlib import import_module
from typing import Any

__version__ = "0.2.0"

# A file imports only from places that stand before its own in this list, or from its own room; rooms come last.
MODULES = (
    *("units", "config", "conditioning", "camera", "loss_types", "metrics", "windows", "region"),
    *("schedule", "autoencoder", "unet", "diffusion", "detail", "files", "data", "store", "boundary"),
    *("stage_two", "pipeline", "baselines"),
    *("datasets", "viz", "simulator", "training", "evaluation", "paper", "studies", "peers", "exercises", "cli"),
)

# The names that need no module in front of them.
_HOME = {
    "Camera": "camera",
    "Sample": "data",
    "Stereo": "camera",
    "list_samples": "data",
    "load_sample": "data",
    "read_sample": "data",
    "save_sample": "data",
    "preset": "config",
    "Ditr": "pipeline",
}

__all__ = sorted(_HOME) + list(MODULES)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
        globals()[name] = value  # the next look-up no longer passes through here
        return value
    if name in MODULES:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it offers {', '.join(__all__)}")


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
