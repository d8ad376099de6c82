"""Depth completion of transparent and reflective objects by latent diffusion: ``import ditr_lite as dl``.

Everything is loaded on first use, so the import itself costs nothing: ``dl.load_sample`` brings in ``data``,
``dl.Ditr`` brings in torch, ``dl.metrics`` is the module of that name.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# A file imports only from files that stand before it in this list.
MODULES = (
    "units",
    "config",
    "conditioning",
    "camera",
    "loss_types",
    "metrics",
    "region",
    "schedule",
    "autoencoder",
    "unet",
    "diffusion",
    "detail",
    "files",
    "data",
    "store",
    "boundary",
    "pipeline",
    "baselines",
    "datasets",
    "viz",
    "simulator",
    "training",
    "evaluation",
    "paper",
    "studies",
    "peers",
    "exercises",
    "cli",
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
