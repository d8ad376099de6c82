"""Pictures of what passes from part to part of the pipeline: windows, what a branch is given, latents."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from ..conditioning import CHANNELS
from ..windows import Frame, Window
from .panels import FONT, OKABE_ITO, Picture, add_bar, depth, depth_limits, rgb, signed_error

WINDOWS = tuple(OKABE_ITO[k] for k in (1, 2, 6, 4, 5, 7))  # not yellow: titles have these colours, too
CloseUp = tuple[Window, np.ndarray, Frame, tuple[np.ndarray, ...]]


def draw_plane(ax: Any, image: np.ndarray | Tensor, title: str, limits: tuple, colours: str = "gray") -> Any:
    """Draw one plane (h, w) in greys, or another colour map, between limits, without ticks; return what was drawn."""
    drawn = ax.imshow(np.asarray(image), cmap=colours, vmin=limits[0], vmax=limits[1], interpolation="nearest")
    ax.set(xticks=[], yticks=[])
    ax.set_title(title, fontsize=FONT)
    return drawn


def frame_and_windows(image: np.ndarray, region: np.ndarray, close: Sequence[CloseUp]) -> Picture:
    """Draw a frame with one coloured square around each blob, and beside it what each square shows.

    Args:
        image: (H, W, 3) uint8.
        region: (H, W) bool.
        close: as :func:`windows.close_ups` returns it.
    """
    across = max(1, len(close))
    figure = Picture(min(12.0, 3.6 + 2.4 * across), 2.7)
    axes = figure.subplots(1, 1 + across, width_ratios=[1.5] + [1] * across)
    rgb(axes[0], image, region, "frame and windows")
    for k, (window, _, _, (seen, _, blob)) in enumerate(close):
        colour = WINDOWS[k % len(WINDOWS)]
        corners = np.array([[0, 0], [0, 1], [1, 1], [1, 0], [0, 0]]) * window.side + (window.top, window.left)
        axes[0].plot(corners[:, 1], corners[:, 0], color=colour, linewidth=1.5)
        rgb(axes[1 + k], seen[::3, ::3], blob[::3, ::3], f"{window.side} px wide,\nshown with {len(seen)}")
        axes[1 + k].title.set_color(colour)
    axes[0].autoscale()  # windows may reach beyond the frame
    for ax in axes[1 + len(close) :]:
        ax.set_axis_off()
    return figure


def draw_given(rows: Mapping[str, tuple[Tensor, Tensor, Tensor, Any]], limits: tuple[float, float]) -> Picture:
    """Draw what branches are given, one row each: boundary map, share of unknown, filled start, evidence.

    Args:
        rows: name -> image (9, h, w), filled (1, h, w) and known share (1, h/4, w/4) of one view, and its bounds.
        limits: of depth, metres.
    """
    figure = Picture(10.0, 2.3 * len(rows))
    axes = figure.subplots(len(rows), 4, squeeze=False)
    for row, (name, (image, filled, share, bounds)) in zip(axes, rows.items(), strict=True):
        guide, evidence = (image[CHANNELS.index(channel)] for channel in ("boundary", "evidence"))
        start_m = bounds.denormalise(filled[0].numpy())
        believed_m = bounds.denormalise((filled[0] + evidence).numpy())
        draw_plane(row[0], guide, f"{name}: boundary", (0, 1), "gray_r")
        draw_plane(row[1], 1 - share[0], "share of unknown", (0, 1), "gray_r")
        shown = depth(row[2], start_m, limits, "filled start", bar=False)
        differs = signed_error(row[3], believed_m, start_m, 100, "evidence minus start", bar=False)
    add_bar(figure, shown, axes[:, 2], "depth")
    bar = figure.colorbar(differs, ax=axes[:, 3], fraction=0.05, pad=0.02, extend="both")
    bar.set_label("difference (mm), + is farther", fontsize=FONT)
    return figure


def draw_latents(rows: Mapping[str, Tensor], limit: float) -> Picture:
    """Draw latents (C, h, w), one row for each name and one column for each channel, from -limit to limit."""
    channels = next(iter(rows.values())).shape[0]
    figure = Picture(2.2 * channels, 2.4 * len(rows))
    for axes, (name, planes) in zip(figure.subplots(len(rows), channels, squeeze=False), rows.items(), strict=True):
        for k, ax in enumerate(axes):
            few_greys = (4 * planes[k]).round() / 4  # for a small file
            draw_plane(ax, few_greys, f"{name}, channel {k}", (-limit, limit))
    return figure


def draw_steps(
    steps: Mapping[int, tuple[Tensor, np.ndarray, str]], limit: float, truth: np.ndarray, where: np.ndarray
) -> Picture:
    """Draw noisy latents after a step, the depth that was predicted in it, and its error, one column for each step.

    Args:
        steps: number of the step -> a plane of noisy latents (h, w), the decoded prediction in metres, and the title
            of its error.
        limit: of the latents.
        truth: metres; its limits are shared.
        where: (H, W) bool, the pixels whose error is drawn.
    """
    figure = Picture(2.6 * len(steps) + 0.8, 6.9)
    axes = figure.subplots(3, len(steps), squeeze=False)
    for (above, middle, below), (t, (noisy, guess, title)) in zip(axes.T, steps.items(), strict=True):
        greys = draw_plane(above, (2 * noisy).round() / 2, f"latents after step {t}", (-limit, limit))
        few_colours = np.round(200 * guess) / 200  # 5 mm apart, for a small file
        shown = depth(middle, few_colours, depth_limits(truth), f"depth predicted in step {t}", bar=False)
        differs = signed_error(
            below, np.round(100 * (guess - truth)) / 100 + truth, truth, 100, title, False, where=where
        )
    bar = figure.colorbar(greys, ax=axes[0], fraction=0.05, pad=0.02, extend="both")  # keeps the columns in line
    bar.set_label("latent (no unit)", fontsize=FONT)
    for drawn, row, kind in ((shown, axes[1], "depth"), (differs, axes[2], "signed")):
        add_bar(figure, drawn, row, kind)
    return figure


def draw_probability(ax: Any, values: np.ndarray) -> None:
    """Draw stage one's probability (H, W) from 0 to 1 with its colour bar."""
    drawn = draw_plane(ax, values, "probability", (0, 1), "cividis")
    ax.figure.colorbar(drawn, ax=ax, fraction=0.05).ax.tick_params(labelsize=FONT - 1)
