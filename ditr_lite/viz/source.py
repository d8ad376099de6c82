"""Excerpts of the package's own source, for notebooks that show the code that runs and no copy of it."""

import inspect
from collections.abc import Callable
from textwrap import dedent


def excerpt(function: Callable, begins: str, ends: str) -> str:
    """Return the lines of a function from the first that holds ``begins`` to the next that holds ``ends``, dedented.

    Raises:
        ValueError: when no such lines stand in the function.
    """
    lines = inspect.getsource(function).splitlines()
    first = next((k for k, line in enumerate(lines) if begins in line), None)
    last = None if first is None else next((k for k in range(first, len(lines)) if ends in lines[k]), None)
    if last is None:
        raise ValueError(f"{function.__name__} has no lines from {begins!r} to {ends!r}; look at its source")
    return dedent("\n".join(lines[first : last + 1]))
