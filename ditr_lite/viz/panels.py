"""Single panels that always look alike: depth, error, spread, colour with outlines, codes, clouds from the side.

Depth is in metres on ``viridis_r``, |error| in millimetres on ``magma`` from 0, signed error on symmetric ``RdBu_r``;
pixels without a value are grey, a colour in none of the maps, and their number stands in the title.
"""

import base64
import builtins
from collections.abc import Mapping, Sequence
from functools import partial
from io import BytesIO
from textwrap import wrap

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from ..camera import Camera, unproject
from ..units import check_metres

OUTLINES = (
    "#E69F00",
    "#56B4E9",
    "#CC79A7",
    "#009E73",
    "#D55E00",
)  # of masks, side by side at times
# Tol's muted colours: for a second set of codes beside one in OKABE_ITO
MUTED = ("#332288", "#88CCEE", "#117733", "#DDCC77", "#CC6677", "#AA4499", "#44AA99", "#882255")
OKABE_ITO = ("#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7", "#000000")
GREY = "#9E9E9E"  # no value
# The narrowest column of the book at a screen's size has 736 pixels: there, type of 9.9 pt in a figure of 800 pixels is
# 12 pixels high and can be read on a projector.
DPI, FONT = 96, 9.9
WIDTH_IN = 800 / DPI
SMALLEST_TYPE = "smallest type (px)"  # a remark in the PNG
ERROR_MM = 50.0  # upper end of |error| where no row fixes it
BARS = {"depth": "depth (m)", "error": "|error| (mm)", "signed": "error (mm), + is too far", "spread": "std (mm)"}


class Picture(Figure):
    """A matplotlib figure that a notebook shows as a small PNG of few colours, without pyplot.

    It is never wider than a page shows, and as wide where several panels lie beside each other; none of its words is
    smaller than can be read there. What a caller asks for beyond that is brought within it before the figure is drawn,
    and titles and labels are broken to the width of their panels.
    """

    def __init__(self, width: float, height: float):
        super().__init__(figsize=(width, height), dpi=DPI, layout="constrained")
        FigureCanvasAgg(self)

    def make_legible(self) -> None:
        """Bring width, size of type and lines of titles and labels within what can be read at the size shown."""
        width, height = self.get_size_inches()
        if width > WIDTH_IN:
            self.set_size_inches(WIDTH_IN, height)
        elif width < WIDTH_IN and self._columns() > 1:
            self.set_size_inches(WIDTH_IN, height * (WIDTH_IN / width) ** 0.4)
        self._enlarge_type()
        self.draw_without_rendering()  # only now are all ticks there, and is the width of a panel known
        self._enlarge_type()
        changed = [_break_lines(text, ax) for ax in self.axes for text in (ax.title, ax.xaxis.label)]
        changed += [_thin_ticks(ax) for ax in self.axes]
        if any(changed):
            self.draw_without_rendering()  # two lines are laid out in the second draw
            self._enlarge_type()

    def _columns(self) -> int:
        """Return how many panels lie beside each other, colour bars not counted."""
        places = [ax.get_subplotspec() for ax in self.axes if ax.get_label() != "<colorbar>"]
        return len({place.colspan.start for place in places if place})

    def _enlarge_type(self) -> None:
        for text in self.findobj(Text):
            text.set_fontsize(max(text.get_fontsize(), FONT))

    def smallest_type_px(self) -> float:
        """Return the height of the smallest type of the figure, in its own pixels; 0 where there are no words."""
        sizes = [text.get_fontsize() for text in self.findobj(Text) if text.get_text().strip()]
        return min(sizes, default=0.0) * self.dpi / 72

    def savefig(self, *args, **keywords) -> None:
        """Save as matplotlib does, legibly."""
        self.make_legible()
        super().savefig(*args, **keywords)

    def png(self, colours: int = 112) -> bytes:
        """Return the figure as an indexed PNG, about a sixth of the full-colour one's size.

        Colours, 256 at most, are chosen for coverage, not by frequency, so that a thin colour bar does not break into
        steps.
        """
        self.make_legible()
        self.canvas.draw()
        image = Image.fromarray(np.asarray(self.canvas.buffer_rgba())[..., :3])
        indexed = image.quantize(colours, Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)
        remarks = PngInfo()
        remarks.add_text(SMALLEST_TYPE, f"{self.smallest_type_px():.1f}")
        indexed.save(data := BytesIO(), "png", optimize=True, pnginfo=remarks)
        return data.getvalue()

    def _ipython_display_(self) -> None:
        # Asked for before anything else; otherwise pyplot's inline backend would show its own, larger rendering.
        builtins.get_ipython().display_pub.publish(self._repr_mimebundle_())

    def _repr_mimebundle_(self, include=None, exclude=None) -> dict[str, str]:
        titles = "; ".join(t for ax in self.axes if (t := ax.get_title().replace("\n", ", ")))
        return {"image/png": base64.b64encode(self.png()).decode("ascii"), "text/plain": f"<Picture: {titles}>"}


def _break_lines(text: Text, ax: Axes) -> bool:
    """Break lines of a title or label that are wider than its panel, so that neighbours do not collide; say whether."""
    needed, given = text.get_window_extent().width, ax.get_window_extent().width
    if needed <= given or "$" in text.get_text():  # a formula is not cut
        return False
    lines = text.get_text().split("\n")
    letters = max(12, int(max(map(len, lines)) * given / needed))
    text.set_text("\n".join("\n".join(wrap(line, letters, break_long_words=False)) for line in lines))
    return True


def _thin_ticks(ax: Axes) -> bool:
    """Halve the number of ticks along a panel whose numbers run into each other, or turn their names; say whether."""
    low, high = sorted(ax.get_xlim())
    ticks = [tick for tick in ax.xaxis.get_major_ticks() if low <= tick.get_loc() <= high and tick.label1.get_text()]
    boxes = sorted((tick.label1.get_window_extent() for tick in ticks), key=lambda box: box.x0)
    crowded = any(right.x0 - left.x1 < 2 for left, right in zip(boxes, boxes[1:], strict=False))
    if not crowded:
        return False
    if isinstance(ax.xaxis.get_major_locator(), MaxNLocator):
        ax.xaxis.get_major_locator().set_params(nbins=max(2, len(ticks) // 2))
    else:
        for tick in ticks:
            tick.label1.set(rotation=25, horizontalalignment="right", rotation_mode="anchor")
    return True


def depth_limits(*maps: np.ndarray) -> tuple[float, float]:
    """Return the 2nd and 98th percentile, in metres, of the valid pixels of all ``maps``."""
    valid = np.concatenate([m[m > 0].ravel() for m in map(check_metres, maps)])
    low, high = np.percentile(valid, [2, 98]) if valid.size else (0.0, 1.0)
    return float(low), float(max(high, low + 1e-3))


def depth(
    ax: Axes, depth_m: np.ndarray, limits: tuple[float, float] | None = None, title: str = "", bar: bool = True
) -> AxesImage:
    """Draw a depth map (H, W), metres, 0 = missing, between ``limits`` (its own percentiles by default)."""
    low, high = limits or depth_limits(depth_m)
    valid = check_metres(depth_m) > 0
    return _map(ax, "depth", depth_m, valid, (low, high), title, "missing", bar)


def error(
    ax: Axes,
    depth_m: np.ndarray,
    depth_gt: np.ndarray,
    limit_mm: float | None = None,
    title: str = "",
    bar: bool = True,
    signed: bool = False,
    where: np.ndarray | None = None,
) -> AxesImage:
    """Draw |depth - ground truth| in millimetres where both are known, 0 to ``limit_mm``; the title has the mean.

    ``signed`` keeps the sign and leaves the title alone: red is too far, blue too near. ``where``, (H, W) bool, names
    the pixels that are judged; all others are grey and not counted.
    """
    difference, valid = difference_mm(depth_m, depth_gt)
    if where is not None and (where.shape != valid.shape or where.dtype != bool):
        raise ValueError(f"where should be {valid.shape} bool, got {where.shape} {where.dtype}")
    judged = np.ones_like(valid) if where is None else where
    shown, limit = valid & judged, limit_mm or ERROR_MM
    absent = int((judged & ~valid).sum())
    if signed:
        return _map(ax, "signed", difference, shown, (-limit, limit), title, "unknown", bar, absent)
    mean = f"mean {np.abs(difference[shown]).mean():.1f} mm" if shown.any() else ""
    title = "\n".join(filter(None, (title, mean)))
    return _map(ax, "error", np.abs(difference), shown, (0, limit), title, "unknown", bar, absent)


signed_error = partial(error, signed=True)


def spread(ax: Axes, std_m: np.ndarray, limit_mm: float | None = None, title: str = "", bar: bool = True) -> AxesImage:
    """Draw the spread over samples or the error to expect, given in metres, in millimetres."""
    std_mm = check_metres(std_m) * 1000.0
    limit = limit_mm or spread_limit(std_m)
    return _map(ax, "spread", std_mm, np.ones(std_mm.shape, bool), (0, limit), title, "", bar)


def spread_limit(std_m: np.ndarray) -> float:
    """Return where the colours of a spread, given in metres, end, in millimetres: all but its largest values."""
    return max(1000.0 * float(np.percentile(std_m, 98)), 1.0)


def rgb(
    ax: Axes,
    image: np.ndarray,
    regions: np.ndarray | Mapping[str, np.ndarray] | None = None,
    title: str = "",
) -> AxesImage:
    """Draw a colour picture (H, W, 3) uint8 with the outline of one mask, or of several, their names below it.

    Raises:
        ValueError: when the picture is not RGB uint8, or a mask not boolean of the same size.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"a picture should be (H, W, 3) uint8, got {image.shape} {image.dtype}")
    named = regions if isinstance(regions, Mapping) else {} if regions is None else {"": regions}
    drawn = ax.imshow(image, interpolation="nearest")
    for mask, colour in zip(named.values(), OUTLINES, strict=False):
        if mask.shape != image.shape[:2] or mask.dtype != bool:
            raise ValueError(f"a mask should be {image.shape[:2]} bool, got {mask.shape} {mask.dtype}")
        outline(ax, mask, colour)
    if any(named):
        handles = [Line2D([], [], color=colour, label=label) for label, colour in zip(named, OUTLINES, strict=False)]
        _legend_below(ax, handles, columns=min(len(handles), 3))
    _bare(ax, title)
    return drawn


def outline(ax: Axes, mask: np.ndarray, colour: str = OKABE_ITO[0]) -> None:
    """Draw the outline of a mask (H, W) bool; nothing for an empty one."""
    if mask.any():
        limits = ax.axis()  # of the picture beneath, so that panels with and without an outline are alike
        ax.contour(np.pad(mask, 1), [0.5], colors=colour, linewidths=1.2, extent=_extent(mask.shape))
        ax.axis(limits)


def heat(
    ax: Axes, values: np.ndarray, title: str = "", limits: tuple[float, float] | None = None, bar: bool = True
) -> AxesImage:
    """Draw numbers (H, W) without a unit, such as probabilities, dark to bright, with a colour bar.

    Raises:
        ValueError: when ``values`` is not (H, W).
    """
    values = np.asarray(values)
    if values.ndim != 2:
        raise ValueError(f"values should be (H, W), got {values.shape}")
    low, high = limits or (None, None)
    drawn = ax.imshow(values, cmap="cividis", vmin=low, vmax=high, interpolation="nearest")
    _bare(ax, title)
    if bar:
        extend = "both" if limits else "neither"
        ax.figure.colorbar(drawn, ax=ax, fraction=0.05, pad=0.02, extend=extend).ax.tick_params(labelsize=FONT)
    return drawn


def labels(
    ax: Axes, codes: np.ndarray, names: Mapping[int, str], title: str = "", colours: Sequence[str] = OKABE_ITO
) -> AxesImage:
    """Draw whole-number codes (H, W) with a legend of those that occur and their pixel counts.

    The first name is the background, white; the others take ``colours`` in turn; codes without a name are grey.

    Raises:
        ValueError: for more names than there are colours, or codes that are not whole numbers (H, W).
    """
    if codes.ndim != 2 or codes.dtype.kind not in "bui":
        raise ValueError(f"codes should be whole numbers (H, W), got {codes.shape} {codes.dtype}")
    if len(names) > 1 + len(colours):
        raise ValueError(f"at most {1 + len(colours)} codes can be told apart, got {len(names)}")
    index = np.full(codes.shape, len(names))
    for k, code in enumerate(names):
        index[codes == code] = k
    shown = [*("#FFFFFF", *colours)[: len(names)], GREY]
    drawn = ax.imshow(index, cmap=ListedColormap(shown), vmin=-0.5, vmax=len(names) + 0.5, interpolation="nearest")
    counts = np.bincount(index.ravel(), minlength=len(names) + 1)
    square = {"marker": "s", "linestyle": "", "markeredgecolor": "black", "markeredgewidth": 0.5}
    entries = zip(shown, [*names.values(), "other"], counts, strict=True)
    handles = [Line2D([], [], color=colour, label=f"{name} {n:,}", **square) for colour, name, n in entries if n]
    _legend_below(ax, handles, columns=2)
    _bare(ax, title)
    return drawn


def point_cloud_side(
    ax: Axes,
    depth_m: np.ndarray,
    camera: Camera,
    colours: np.ndarray | str = OKABE_ITO[4],
    mask: np.ndarray | None = None,
    label: str = "",
    max_points: int = 20_000,
) -> int:
    """Draw the point cloud from the side, z to the right and y down, and return how many points were drawn.

    Args:
        ax: where to; call again to lay a second cloud over the first.
        depth_m: (H, W) metres, 0 = missing.
        camera: of the same size.
        colours: (H, W, 3) uint8, or one colour for all points.
        mask: (H, W) bool, the pixels to draw; None draws all.
        label: for the legend.
        max_points: of more, every second, third ... is drawn.
    """
    if mask is not None and (mask.shape != depth_m.shape or mask.dtype != bool):
        raise ValueError(f"mask should be {depth_m.shape} bool, got {mask.shape} {mask.dtype}")
    shown = depth_m if mask is None else np.where(mask, depth_m, np.zeros_like(depth_m))
    points = unproject(shown, camera)
    step = max(1, -(-len(points) // max_points))
    if not isinstance(colours, str):
        colours = colours[shown > 0][::step] / 255.0
    ax.scatter(points[::step, 2], points[::step, 1], s=1.5, c=colours, linewidths=0, label=label or None)
    if not ax.yaxis_inverted():  # y points down, as in the picture
        ax.invert_yaxis()
    if label:
        ax.legend(fontsize=FONT, markerscale=4)
    ax.set_xlabel("z, away from the camera (m)", fontsize=FONT)
    ax.set_ylabel("y, down (m)", fontsize=FONT)
    ax.set_aspect("equal", adjustable="datalim")
    ax.tick_params(labelsize=FONT)
    return len(points[::step])


def _map(ax, kind, values, valid, limits, title, absent, bar, count=None) -> AxesImage:
    """Draw ``values`` where ``valid``, grey elsewhere, the number of grey pixels, or ``count``, in the title."""
    shown = np.ma.masked_array(values, ~valid)
    drawn = ax.imshow(shown, cmap=colours_of(kind), vmin=limits[0], vmax=limits[1], interpolation="nearest")
    n = int(valid.size - valid.sum()) if count is None else count
    _bare(ax, f"{title}\n{n:,} px {absent}".strip() if n else title)
    if bar:
        add_bar(ax.figure, drawn, ax, kind)
    return drawn


def colours_of(kind: str) -> matplotlib.colors.Colormap:
    """Return the colour map of one kind of panel, grey where there is no value."""
    name = {"depth": "viridis_r", "signed": "RdBu_r"}.get(kind, "magma")
    return matplotlib.colormaps[name].with_extremes(bad=GREY)


def add_bar(figure: Figure, drawn: AxesImage, ax: Axes, kind: str, inside: bool = False) -> None:
    """Add the labelled colour bar of one kind of panel beside ``ax``, or inside it, at its left edge."""
    extend = "both" if kind in ("depth", "signed") else "max"
    place = {"cax": ax.inset_axes((0, 0, 0.05, 1))} if inside else {"ax": ax, "fraction": 0.05, "pad": 0.02}
    bar = figure.colorbar(drawn, extend=extend, **place)
    bar.set_label(BARS[kind], fontsize=FONT)
    bar.ax.tick_params(labelsize=FONT)


def difference_mm(depth_m: np.ndarray, depth_gt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return depth - ground truth in millimetres, and where both are known."""
    depth_m, depth_gt = check_metres(depth_m), check_metres(depth_gt)
    if depth_m.shape != depth_gt.shape:
        raise ValueError(f"depth is {depth_m.shape}, its ground truth {depth_gt.shape}: they should be alike")
    return (depth_m - depth_gt) * 1000.0, (depth_m > 0) & (depth_gt > 0)


def _legend_below(ax: Axes, handles: list[Line2D], columns: int) -> None:
    """Put a legend below a panel, in at most so many columns and as few as its place across the figure has room for."""
    style = {"fontsize": FONT, "frameon": False, "handlelength": 1.2, "columnspacing": 1.0}
    place = ax.get_subplotspec()
    share = len(place.colspan) / place.get_gridspec().ncols if place else 1.0
    room = 0.95 * DPI * share * (WIDTH_IN if share < 1 else ax.figure.get_figwidth())
    for n in range(columns, 0, -1):
        legend = ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=n, **style)
        if legend.get_window_extent().width <= room:
            return


def _extent(shape: tuple[int, int]) -> tuple[float, float, float, float]:
    """Return where the corner pixels of a mask padded by one pixel lie, so that outlines close at the border."""
    height, width = shape
    return (-1, width, -1, height)


def _bare(ax: Axes, title: str) -> None:
    ax.set_xticks([])
    ax.set_yticks([])
    ax.set_title(title, fontsize=FONT)
