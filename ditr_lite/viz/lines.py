"""Curves: named lines in colours that are told apart, with labels and a legend, so that no notebook repeats it."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes

from .panels import FONT, OKABE_ITO, Picture

COLOURS = tuple(OKABE_ITO[k] for k in (4, 5, 6, 2, 0, 7))  # blue first; yellow cannot be seen as a line


def curves(
    ax: Axes,
    lines: Mapping[str, Any],
    x: str,
    y: str = "",
    style: str = "-",
    colours: Sequence[str] = COLOURS,
    **settings: Any,
) -> None:
    """Draw named curves, with a legend where there are several.

    Args:
        ax: where to.
        lines: name -> (x, y), or y alone, which is drawn over 0, 1, 2, ...
        x: label of the axis to the right, with its unit.
        y: label of the axis upwards, with its unit.
        style: of all lines, as in matplotlib, e.g. "o-".
        colours: of the lines, in order.
        settings: of the axes, as for ``ax.set``: ``title``, ``ylim``, ``xscale``.

    Raises:
        ValueError: for more lines than colours.
    """
    if len(lines) > len(colours):
        raise ValueError(f"expected at most {len(colours)} lines, as many as there are colours, got {len(lines)}")
    for (name, values), colour in zip(lines.items(), colours, strict=False):
        points = values if isinstance(values, tuple) else (range(len(values)), values)
        ax.plot(*points, style, color=colour, label=name)
    ax.set(xlabel=x, ylabel=y, **settings)
    if len(lines) > 1:
        ax.legend(fontsize=FONT)


def plot(lines: Mapping[str, Any], x: str, y: str = "", size: tuple[float, float] = (8, 2.8), **settings) -> Picture:
    """Return a picture of one panel of :func:`curves`, ``size`` in inches."""
    figure = Picture(*size)
    curves(figure.subplots(), lines, x, y, **settings)
    return figure
