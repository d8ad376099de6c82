"""Pictures of ablations and failures: intervals beside each other, errors against what a scene is, the worst scenes."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ..data import Sample
from .panels import FONT, GREY, OKABE_ITO, Picture, add_bar, error, rgb

Interval = Sequence[float]
PARTS = {"optical": 0, "geometric": 1, "autoencoder": 2, "detail": 6, "region": 7}  # the branches as in other pictures


def intervals(
    ax: Axes, rows: Mapping[str, Interval | None], label: str, title: str = "", scale: float = 1000.0, zero: bool = True
) -> None:
    """Draw one (mean, low, high) per row, the first on top; in colour when it excludes 0, grey when it does not.

    Args:
        ax: where to.
        rows: name -> interval; None leaves the row empty.
        label: of the axis, with its unit.
        title: of the panel.
        scale: what the values are multiplied by, 1000 from metres to millimetres.
        zero: whether the values are differences: a dashed line marks 0, and colour says which side they lie on.
    """
    for k, interval in enumerate(rows.values()):
        if interval is None:
            continue
        mean, low, high = (scale * x for x in interval)
        colour = OKABE_ITO[4]
        if zero:
            colour = OKABE_ITO[5] if low > 0 else OKABE_ITO[2] if high < 0 else GREY
        ax.plot([low, high], [k, k], color=colour, linewidth=2)
        ax.plot(mean, k, "o", color=colour, markersize=5)
    if zero:
        ax.axvline(0, color="black", linestyle="--", linewidth=0.8)
    ax.set_yticks(range(len(rows)), list(rows), fontsize=FONT)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlabel(label, fontsize=FONT)
    ax.set_title(title, fontsize=FONT)
    ax.tick_params(axis="x", labelsize=FONT)


def training_curves(curves: Mapping[str, Sequence[tuple[int, float]]]) -> Picture:
    """Draw validation figures against the training step: stage one's IoU in a panel of its own, all errors in another.

    Args:
        curves: part of :data:`PARTS` -> (step, figure) pairs; ``region`` holds IoU, the others errors relative to the
            distance.
    """
    figure = Picture(8.5, 2.8)
    left, right = figure.subplots(1, 2)
    for name, points in curves.items():
        ax, scale = (right, 1) if name == "region" else (left, 100)
        steps, values = np.array(points, float).T
        ax.plot(steps, scale * values, "o-", color=OKABE_ITO[PARTS[name]], markersize=3, label=name)
    left.set(xlabel="step", ylabel="error (% of distance)", title="validation error")
    right.set(xlabel="step", ylabel="IoU", title="validation IoU of stage one")
    if left.lines:
        left.set_ylim(0, 1.6 * max(line.get_ydata().max() for line in left.lines))  # room for the names
        left.legend(fontsize=FONT, loc="upper center", ncols=2)
    return figure


def surest_kept(kinds: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float]]]]) -> Picture:
    """Draw, a panel for each kind of pixel, the RMSE of the surest pixels against the share of pixels that is kept.

    Args:
        kinds: title -> name of a curve -> shares and RMSE in metres; the curve called "oracle", the best that
            any order could give, is dotted.
    """
    figure = Picture(10.0, 3.4)
    names = list(dict.fromkeys(name for curves in kinds.values() for name in curves if name != "oracle"))
    colours = dict(zip(names, (GREY, OKABE_ITO[5], OKABE_ITO[6]), strict=False)) | {"oracle": OKABE_ITO[4]}
    axes = figure.subplots(1, len(kinds), squeeze=False)[0]
    for ax, (title, curves) in zip(axes, kinds.items(), strict=True):
        for name, (shares, risks) in curves.items():
            line = ":" if name == "oracle" else "o-"
            ax.plot(100 * np.array(shares), 1000 * np.array(risks), line, color=colours[name], markersize=3, label=name)
        ax.set_xlabel("surest pixels kept (%)", fontsize=FONT)
        ax.set_title(title, fontsize=FONT)
        ax.set_ylim(0, None)
    axes[0].set_ylabel("RMSE of those (mm)", fontsize=FONT)
    lines = {line.get_label(): line for ax in axes for line in ax.lines}
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=len(lines), fontsize=FONT)
    return figure


def scatter(ax: Axes, x: Sequence[float], y_m: Sequence[float], marked: Sequence[bool], label: str, title: str) -> None:
    """Draw errors, given in metres, in millimetres against one figure of the scene; ``marked`` frames stand out."""
    x, y, marked = np.asarray(x, float), 1000 * np.asarray(y_m, float), np.asarray(marked, bool)
    for which, colour, size in ((~marked, OKABE_ITO[1], 10), (marked, OKABE_ITO[5], 20)):
        ax.scatter(x[which], y[which], s=size, color=colour, linewidths=0)
    ax.set_xlabel(label, fontsize=FONT)
    ax.set_title(title, fontsize=FONT)
    ax.set_ylim(0, None)
    ax.tick_params(labelsize=FONT)


def against_scene(
    errors: Mapping[str, float],
    described: Mapping[str, Mapping[str, float]],
    rho: Mapping[str, Interval | None],
    marked: Sequence[str] = (),
) -> Picture:
    """Draw the errors against each figure that scenes are described by, and the rank correlation with each.

    Args:
        errors: scene -> optical RMSE in metres.
        described: scene -> figure -> value.
        rho: figure -> (correlation, low, high), None where it cannot be told.
        marked: scenes that stand out.
    """
    figure, names = Picture(7.2, 3.0), list(described)
    axes = figure.subplots(2, -(-(len(rho) + 1) // 2)).ravel()
    for ax, key in zip(axes, rho, strict=False):
        values = [described[n][key] for n in names], [errors[n] for n in names], [n in marked for n in names]
        scatter(ax, *values, "", key)
        if np.equal(np.mod(values[0], 1), 0).all():  # a count
            ax.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    for ax in axes[len(rho) : -1]:
        ax.set_axis_off()
    intervals(axes[-1], rho, "rank correlation", scale=1)
    figure.supylabel("optical error (mm)", fontsize=FONT)
    return figure


def worst_scenes(
    samples: Sequence[Sample],
    depths: Sequence[np.ndarray],
    titles: Sequence[str],
    found: Sequence[np.ndarray],
    columns: int = 5,
) -> Picture:
    """Draw many scenes small: colour with the true and the found region above the error inside the true region.

    Args:
        samples: with region and ground truth.
        depths: (H, W) metres, the completion of each.
        titles: of each.
        found: (H, W) bool, the region that stage one found in each.
        columns: scenes in a row.

    Raises:
        ValueError: for no scenes, or lists of different lengths.
    """
    if not samples or not len(samples) == len(depths) == len(titles) == len(found):
        raise ValueError(f"expected as many of each, got {len(samples)}, {len(depths)}, {len(titles)}, {len(found)}")
    columns, blocks = min(columns, len(samples)), -(-len(samples) // columns)
    figure = Picture(1.9 * columns + 0.5, 3.3 * blocks)
    axes = figure.subplots(2 * blocks, columns, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for k, (sample, depth, title, region) in enumerate(zip(samples, depths, titles, found, strict=True)):
        block, column = divmod(k, columns)
        rgb(axes[2 * block, column], sample.rgb, {"true": sample.region, "found": region}, title)
        legend = axes[2 * block, column].get_legend()
        if k == 0:  # one legend says it for all
            names = [text.get_text() for text in legend.texts]
            style = {"loc": "outside lower center", "ncols": 2, "fontsize": FONT, "frameon": False}
            figure.legend(legend.legend_handles, names, **style)
        legend.remove()
        inside = np.where(sample.region, sample.depth_gt, 0)  # elsewhere no error is of interest
        drawn = error(axes[2 * block + 1, column], depth, inside, 100.0, bar=False)
        axes[2 * block + 1, column].set_title("")
        if column == columns - 1:
            add_bar(figure, drawn, axes[2 * block + 1, column], "error")
    return figure
