"""A reader's own method from its address ``module:function``, checked at every call, ready for ``evaluation``.

The quickest experiment there is: write ``f(rgb, depth, region) -> depth``, name it, see it in the table beside DITR.
"""

import sys
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path

import numpy as np

from ..baselines import REGISTRY, Fill
from .scoring import RESERVED


def find_methods(addresses: Iterable[str], folder: Path | str = ".") -> dict[str, Fill]:
    """Return name -> call of several methods, found as :func:`find_method` finds one.

    Raises:
        ValueError: likewise, and for two methods of one name: they would share a row of the table.
    """
    found: dict[str, Fill] = {}
    for address in addresses:
        name, method = find_method(address, folder)
        if name in found:
            raise ValueError(f"two methods are called {name!r}: give one of them another name")
        found[name] = method
    return found


def find_method(address: str, folder: Path | str = ".") -> tuple[str, Fill]:
    """Import a method and return its name in tables and a call that checks what comes back.

    Args:
        address: ``module:function``, the module being looked for in ``folder`` first, then among installed ones.
        folder: as a rule the current directory.

    Returns:
        (function's name, call), of the baselines' call shape.

    Raises:
        ValueError: for an address of another form, a module or function that is not there or cannot be imported, or a
            name that a row of the tables has already. The call raises ValueError when the depth that comes back cannot
            be scored.
    """
    module, colon, function = address.partition(":")
    if not (module and colon and function) or module.startswith("."):  # a relative import has no package here
        raise ValueError(f"a method is named module:function, like mine:fill for fill in mine.py; got {address!r}")
    if function in REGISTRY or function in RESERVED:
        what = "baseline" if function in REGISTRY else "row that every table has"
        raise ValueError(f"{function!r} is the name of a {what}: call your function something else")
    sys.path.insert(0, str(Path(folder).resolve()))
    try:
        method = getattr(import_module(module), function, None)
    except (ImportError, SyntaxError) as error:
        raise ValueError(f"cannot import {module!r} from {Path(folder).resolve()}: {error}") from None
    finally:
        sys.path.pop(0)
    if not callable(method):
        raise ValueError(f"{module} has no function {function!r}; write it as f(rgb, depth, region) -> depth")
    return function, checked(method, function)


def checked(method: Callable, name: str) -> Fill:
    """Return ``method`` with a ValueError for any result that is not dense metric depth of the frame's size."""

    def call(rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
        result = np.asarray(method(rgb.copy(), depth.copy(), None if region is None else region.copy()))
        if result.shape != depth.shape or not np.issubdtype(result.dtype, np.floating):
            raise ValueError(f"{name}: expected {depth.shape} of floats, metres; got {result.shape} {result.dtype}")
        if not (np.isfinite(result).all() and (result > 0).all()):
            raise ValueError(f"{name}: some pixels are not positive and finite; fill every pixel, in metres")
        return result.astype(np.float32)

    return call
