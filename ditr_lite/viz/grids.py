"""Every picture of the repository: rows and grids of panels with shared limits, and the panels themselves.

Figures are :class:`Picture` objects outside pyplot. In a notebook, make one the cell's last expression; elsewhere, use
``savefig``. The rules of colour and units are in ``panels``.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.image import AxesImage

from ..data import Sample
from ..files import written_whole
from .panels import (
    BARS,
    ERROR_MM,
    WIDTH_IN,
    Picture,
    add_bar,
    colours_of,
    depth,
    depth_limits,
    difference_mm,
    error,
    outline,
    rgb,
    signed_error,
    spread,
    spread_limit,
)

TALLEST_IN = 6.0  # a panel, however narrow its picture


class Panel(NamedTuple):
    """One panel of a grid: ``kind`` is rgb, depth, error, signed or spread; error kinds take a predicted depth map."""

    kind: str
    array: np.ndarray
    title: str = ""


def grid(
    rows: Sequence[Sequence[Panel | tuple | None]],
    depth_gt: np.ndarray | None = None,
    region: np.ndarray | Mapping[str, np.ndarray] | None = None,
    limits: tuple[float, float] | None = None,
    error_mm: float | None = None,
    where: np.ndarray | None = None,
) -> Picture:
    """Draw rows of panels with one set of limits and one colour bar per kind.

    Args:
        rows: panels ``(kind, array, title)``; None leaves a place empty.
        depth_gt: (H, W) metres: fixes the depth limits and is what errors are taken against.
        region: outlined on the rgb panels; a mapping names several.
        limits: depth limits in metres, instead of those of ``depth_gt`` (or of the depth panels, without it).
        error_mm: upper end of the error bars, instead of the 98th percentile over all error panels.
        where: (H, W) bool, the pixels that error panels judge; others are grey there.
    """
    rows = [[panel and Panel(*panel) for panel in row_] for row_ in rows]
    panels = [panel for row_ in rows for panel in row_ if panel]
    depths = [p.array for p in panels if p.kind == "depth"]
    errors = [p.array for p in panels if p.kind in ("error", "signed")]
    if errors and depth_gt is None:
        raise ValueError("error panels need depth_gt, what the error is taken against")
    limits = limits or depth_limits(*([depth_gt] if depth_gt is not None else depths or [np.zeros((1, 1))]))
    if errors and error_mm is None:
        judged = True if where is None else where
        values = np.concatenate([np.abs(d[v & judged]) for d, v in (difference_mm(e, depth_gt) for e in errors)])
        error_mm = max(float(np.percentile(values, 98)), 1.0) if values.size else ERROR_MM
    spreads = [spread_limit(p.array) for p in panels if p.kind == "spread"]
    columns = max(map(len, rows))
    width = min(WIDTH_IN, 3.2 * columns)
    height, wide = panels[0].array.shape[:2]
    legend = 0.2 * isinstance(region, Mapping)  # inches for the names of the outlines
    tall = min(0.92 * width / columns * height / wide, TALLEST_IN)
    figure = Picture(width, len(rows) * (tall + 0.45 + legend))
    axes = figure.subplots(len(rows), columns, squeeze=False)
    draw = {
        "rgb": lambda ax, p: rgb(ax, p.array, region, p.title),
        "depth": lambda ax, p: depth(ax, p.array, limits, p.title, bar=False),
        "error": lambda ax, p: error(ax, p.array, depth_gt, error_mm, p.title, bar=False, where=where),
        "signed": lambda ax, p: signed_error(ax, p.array, depth_gt, error_mm, p.title, bar=False, where=where),
        "spread": lambda ax, p: spread(ax, p.array, max(spreads), p.title, bar=False),
    }
    for places, row_ in zip(axes, rows, strict=True):
        drawn: dict[str, tuple[AxesImage, list[Axes]]] = {}
        for ax, panel in zip(places, [*row_, *[None] * (columns - len(row_))], strict=True):
            if panel is None:
                ax.set_axis_off()
                continue
            if panel.kind not in draw:
                raise ValueError(f"unknown kind of panel {panel.kind!r}; choose one of {', '.join(draw)}")
            image = draw[panel.kind](ax, panel)
            if panel.kind in BARS:
                drawn.setdefault(panel.kind, (image, []))[1].append(ax)
        for kind, (image, places_of) in drawn.items():
            empty = (
                len(drawn) == 1 and not places[-1].axison
            )  # the bar takes the empty last place, columns stay aligned
            add_bar(figure, image, places[-1] if empty else places_of[-1], kind, inside=empty)
    return figure


def row(panels: Sequence[Panel | tuple | None], **settings) -> Picture:
    """Draw one row of panels; ``settings`` are those of :func:`grid`."""
    return grid([panels], **settings)


def compare(sample: Sample, predictions: Mapping[str, np.ndarray], error_mm: float | None = None) -> Picture:
    """Draw a sample and predictions of its depth in one row, and the error of each beneath it."""
    maps = {"raw": sample.depth, **predictions}
    top = [Panel("rgb", sample.rgb, sample.name), *(Panel("depth", m, name) for name, m in maps.items())]
    if sample.depth_gt is None:
        return grid([top], region=sample.region)
    errors = [None, *(Panel("error", m, name) for name, m in maps.items()), None]
    top.append(Panel("depth", sample.depth_gt, "ground truth"))
    return grid([top, errors], sample.depth_gt, sample.region, error_mm=error_mm)


def contact_sheet(samples: Sequence[Sample], columns: int = 6, shared: bool = True) -> Picture:
    """Draw many samples small: colour with region outline above raw depth above ground truth.

    Args:
        samples: what to draw.
        columns: samples beside each other.
        shared: give all depths the same limits and one bar; otherwise each sample has the limits of its own truth.
    """
    if not samples:
        raise ValueError("no samples to draw")
    truths = [s.depth_gt if s.depth_gt is not None else s.depth for s in samples]
    low, high = depth_limits(*truths)
    columns, blocks = min(columns, len(samples)), -(-len(samples) // columns)
    height, wide = samples[0].depth.shape
    width = min(WIDTH_IN, 3.2 * columns)
    figure = Picture(width, blocks * (2.75 * width / columns * height / wide + 0.9))
    axes = figure.subplots(3 * blocks, columns, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for k, sample in enumerate(samples):
        block, column = divmod(k, columns)
        three = axes[3 * block : 3 * block + 3, column]
        rgb(three[0], sample.rgb, sample.region, sample.name)
        limits = (low, high) if shared else depth_limits(truths[k])
        depth(three[1], sample.depth, limits, "raw", bar=False)
        if sample.depth_gt is not None:
            depth(three[2], sample.depth_gt, limits, "truth", bar=False)
    if not shared:
        return figure
    colours = ScalarMappable(Normalize(low, high), colours_of("depth"))
    figure.colorbar(colours, ax=axes, label=BARS["depth"], extend="both", shrink=0.5, aspect=40)
    return figure


def save_panel(
    path: Path | str,
    image: np.ndarray,
    depth_raw: np.ndarray,
    depth_out: np.ndarray,
    region: np.ndarray | None = None,
    std: np.ndarray | None = None,
    width: int = 480,
) -> None:
    """Write one row, colour | raw | completed | expected error, with the region outlined, as a PNG.

    The file is there whole or not at all.

    Args:
        path: where to.
        image: (H, W, 3) uint8.
        depth_raw: (H, W) metres, 0 = missing.
        depth_out: (H, W) metres; the depth limits come from it.
        region: (H, W) bool or None.
        std: (H, W) metres or None.
        width: of each map, in pixels at least; of a picture that is higher than wide, its height.
    """
    panels = [Panel("rgb", image, "input"), Panel("depth", depth_raw, "raw"), Panel("depth", depth_out, "completed")]
    if std is not None:
        panels.append(Panel("spread", std, "expected error"))
    figure = row(panels, region=region, limits=depth_limits(depth_out))
    maps = figure.axes[: len(panels)]
    if region is not None:
        for ax in maps[1:]:
            outline(ax, region)
    figure.make_legible()
    extents = [ax.get_window_extent() for ax in maps]
    smallest = min(max(extent.width, extent.height) for extent in extents)
    figure.set_dpi(np.ceil(figure.dpi * max(1.0, 1.01 * width / smallest)))
    with written_whole(path) as part:
        part.write_bytes(figure.png(colours=256))
