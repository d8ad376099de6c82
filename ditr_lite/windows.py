"""How a picture comes to the size that networks see, and how what they make of it comes back to the picture's.

First :class:`Frame` and :class:`Window`, then the results: a :class:`Claim` of stage one, the layers of a
:class:`Painting`, and the :class:`Completion` that a caller is given, whose maps are made when they are asked for.

A window is where the optical branch looks closely, one square around each blob of the region. Not in the paper, which
works on whole frames and names a size only where it measures time (Table VI). On a laptop the working size is small,
and a glass that is 60 pixels wide in a camera's picture would be 12 pixels wide in it. So stage one looks at the whole
frame, and the optical branch is given squares twice as wide as what it must paint.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from .conditioning import doubled, fill, pool
from .units import readings_seen, strips

MARGIN = 2.0  # side of a window over the longer side of what it must hold
LEAST = 0.2  # smallest side, as a share of the frame's longer side
MOST = 8  # windows in a frame; further blobs join the nearest window
RIM = 2  # pixels, as networks see them, by which windows show the region wider than it is
SAME = 1.4  # ratio of two distances beyond which they are of different surfaces, not of one at another level


@dataclass(frozen=True)
class Frame:
    """How an image lies in the working size: scaled to (``height``, ``width``), then padded right and below."""

    source: tuple[int, int]
    height: int
    width: int
    size: tuple[int, int]

    def into(self, image: np.ndarray) -> np.ndarray:
        """Bring an image to the working size: colour by area, depth and masks by nearest.

        Padding is missing depth and no mask; its colour is the picture's border, repeated as around training's views: a
        black bar would be something to see. Of depth, a cell whose nearest reading is missing takes the one that lies
        closest to its centre, if it holds any: sparse or line-wise readings survive.
        """
        if image.ndim == 3:
            method = cv2.INTER_AREA if self.height < self.source[0] else cv2.INTER_LINEAR
            small = cv2.resize(image, (self.width, self.height), interpolation=method)
            return np.pad(small, (*self.padding, (0, 0)), mode="edge")
        small = at_centres(image, (self.height, self.width))
        if np.issubdtype(image.dtype, np.floating):
            pool_readings(small, image)
        return np.pad(small, self.padding)

    @property
    def padding(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Rows before and after, columns before and after the image."""
        return (0, self.size[0] - self.height), (0, self.size[1] - self.width)

    @property
    def picture(self) -> np.ndarray:
        """(H, W) bool at the working size, False in the padding."""
        return np.pad(np.ones((self.height, self.width), bool), self.padding)

    def on_picture(self, find: Callable[..., tuple], *images: np.ndarray, **settings) -> tuple[np.ndarray, ...]:
        """Call ``find`` with images less their padding, whose edge it would take for a boundary; pad what it returns.

        Args:
            find: of images (h, w, ...) and ``settings``; returns maps (h, w).
            images: at the working size.
            settings: passed on.

        Returns:
            the maps at the working size, 0 in the padding.
        """
        found = find(*(image[: self.height, : self.width] for image in images), **settings)
        return tuple(np.pad(m, self.padding) for m in found)

    def back(self, image: np.ndarray) -> np.ndarray:
        """Bring a map (H, W) back from the working size: masks by nearest, depth smoothly but not over edges."""
        image = image[: self.height, : self.width]
        if image.dtype == bool:
            return at_centres(image, self.source)
        if image.shape == self.source:
            return image.copy()
        smooth = cv2.resize(image, self.source[::-1], interpolation=cv2.INTER_LINEAR)
        lines, columns = centres(self.height, self.source[0]), centres(self.width, self.source[1])
        for rows in strips(self.source):
            nearest = image[lines[rows, None], columns]
            edge = np.abs(smooth[rows] - nearest) > 0.01 * np.abs(nearest)  # averages over a jump: flying pixels
            np.copyto(smooth[rows], nearest, where=edge)
        return smooth


def at_centres(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize an image (h, w) to (H, W) ``size`` by nearest: each cell takes the pixel that holds its centre.

    OpenCV's ``INTER_NEAREST`` takes the pixel at a cell's corner, which lies up to half a cell aside from the colour
    that its other methods put there.
    """
    rows, columns = (centres(n, count) for n, count in zip(image.shape, size, strict=True))
    return image[rows[:, None], columns]


def centres(length: int, count: int) -> np.ndarray:
    """Return (count,) int: which of ``length`` pixels in a row hold the centres of ``count`` cells of equal width."""
    return (2 * np.arange(count) + 1) * length // (2 * count)


def fit_frame(source: tuple[int, int], size: tuple[int, int]) -> Frame:
    """Return the :class:`Frame` that puts an image of (H, W) ``source`` into ``size``, keeping its aspect."""
    scale = min(size[0] / source[0], size[1] / source[1])
    height, width = (max(1, min(limit, round(length * scale))) for length, limit in zip(source, size, strict=True))
    return Frame(source, height, width, size)


def pool_readings(small: np.ndarray, image: np.ndarray) -> None:
    """Give every cell of ``small`` (h, w) that is 0 the reading of ``image`` (H, W) that is closest to its centre.

    In place; a cell without any reading stays 0. Nothing happens where ``small`` is not smaller.
    """
    scale = np.array(small.shape) / image.shape
    if scale.min() >= 1:
        return
    rows, columns = ((np.arange(n) + 0.5) * s for n, s in zip(image.shape, scale, strict=True))
    y, x = np.minimum(rows.astype(int), small.shape[0] - 1), np.minimum(columns.astype(int), small.shape[1] - 1)
    for cells in strips((small.shape[0], image.size // small.shape[0])):  # some rows of cells at a time
        here = slice(*np.searchsorted(y, (cells.start, cells.stop)))
        _pool_rows(small, image[here], (y[here], x), (rows[here], columns))


def _pool_rows(small: np.ndarray, image: np.ndarray, cells: tuple, places: tuple) -> None:
    """Do :func:`pool_readings` for some rows of the image, all those of their cells."""
    (y, x), (rows, columns) = cells, places
    wanted = (image > 0) & (small == 0)[y[:, None], x[None]]
    v, u = np.nonzero(wanted)
    if v.size == 0:
        return
    away = (rows[v] - y[v] - 0.5) ** 2 + (columns[u] - x[u] - 0.5) ** 2
    order = np.argsort(-away, kind="stable")  # the closest is written last
    small[y[v[order]], x[u[order]]] = image[v[order], u[order]]


def level(painted: np.ndarray, depth: np.ndarray, region: np.ndarray) -> Tensor | None:
    """Return how far the readings lie above a painting, filled where there is none.

    The working size is smaller than a camera's picture: this gives a filled hole the level of its rim at full size, see
    :func:`tie`. By ratios, so that distance does not matter. Where an edge is painted a pixel aside, reading and
    painting are of two surfaces (:data:`SAME`): their ratio says nothing of a level, and in a hole it would do harm.

    Args:
        painted: (H, W) metres, dense.
        depth: (H, W) raw metres, 0 = missing; readings that are :func:`units.strays` do not count.
        region: (H, W) bool, whose readings do not count either.

    Returns:
        (1, 1, H/2, W/2) logarithm of the ratio, H/2 and W/2 rounded up; None where there is no reading.
    """
    known = readings_seen(depth)
    known &= ~region
    if not known.any():
        return None
    pooled = []
    for rows in strips(painted.shape):
        ratio = _ratio(painted[rows], depth[rows], known[rows])
        maps = (ratio, known[rows] & (np.abs(ratio) < np.log(SAME)))
        pooled.append(pool(*(torch.from_numpy(m.astype(np.float32))[None, None] for m in maps)))
    del painted, known  # of a large frame hundreds of megabytes, which filling needs
    mean, share = (torch.cat(parts, dim=2) for parts in zip(*pooled, strict=True))
    return fill(mean, (share > 0).float())


def tie(painted: np.ndarray, lift: Tensor, holes: np.ndarray) -> None:
    """Raise a painting (H, W) in metres by ``lift``, its :func:`level`, in place, in its holes (H, W) bool."""
    offset = doubled(lift, painted.shape)[0, 0].numpy()
    for rows in strips(painted.shape):
        np.multiply(painted[rows], np.exp(offset[rows]), out=painted[rows], where=holes[rows])


def _ratio(painted: np.ndarray, depth: np.ndarray, known: np.ndarray) -> np.ndarray:
    return np.log(np.where(known, depth, 1.0) / np.where(known, painted, 1.0)).astype(np.float32)


@dataclass(frozen=True)
class Window:
    """A square of a frame: its top left pixel, which may lie outside the frame, and its side, in pixels."""

    top: int
    left: int
    side: int

    def cut(self, image: np.ndarray) -> np.ndarray:
        """Return (side, side, ...) of an image (H, W, ...): colour repeats its border outside, all else is 0 there."""
        height, width = image.shape[:2]
        rows = np.arange(self.top, self.top + self.side)
        columns = np.arange(self.left, self.left + self.side)
        out = image[np.clip(rows, 0, height - 1)[:, None], np.clip(columns, 0, width - 1)[None]]
        if image.ndim == 2:
            outside_rows = (rows < 0) | (rows >= height)
            outside_columns = (columns < 0) | (columns >= width)
            out[outside_rows] = 0
            out[:, outside_columns] = 0
        return out

    def paste(self, part: np.ndarray, image: np.ndarray, where: np.ndarray) -> None:
        """Write ``part`` (side, side) into ``image`` (H, W), in place, at what the window covers of ``where``, bool."""
        height, width = image.shape
        y0, x0 = max(self.top, 0), max(self.left, 0)
        y1, x1 = min(self.top + self.side, height), min(self.left + self.side, width)
        inner = part[y0 - self.top : y1 - self.top, x0 - self.left : x1 - self.left]
        np.copyto(image[y0:y1, x0:x1], inner, where=where[y0:y1, x0:x1])


def square(box: np.ndarray, shape: tuple[int, int]) -> Window:
    """Return the window of a box (top, left, bottom, right), ends exclusive, in a frame of ``shape`` (H, W).

    It is moved into the frame as far as it fits.
    """
    longest = max(shape)
    side = max(MARGIN * max(box[2] - box[0], box[3] - box[1]), LEAST * longest)
    side = int(np.ceil(min(side, longest)))
    corner = []
    for start, end, length in ((box[0], box[2], shape[0]), (box[1], box[3], shape[1])):
        first = round((start + end - side) / 2)
        if side <= length:
            first = min(max(first, 0), length - side)
        else:
            first = (length - side) // 2
        corner.append(int(first))
    return Window(corner[0], corner[1], side)


def largest_piece(region: np.ndarray) -> np.ndarray:
    """Return the largest connected piece of a region, (H, W) bool; all False for an empty one."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros_like(region)
    return labels == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()


def box_around(region: np.ndarray, margin: float = 0.5) -> tuple[slice, slice]:
    """Return the rows and columns of a region with a border around it; the whole frame for an empty one.

    ``image[box]`` is the crop, and ``whole[box] = part`` puts it back.

    Args:
        region: (H, W) bool.
        margin: width of the border, as a share of the region's longer side; it ends where the frame ends.
    """
    rows, columns = np.nonzero(region)
    if not rows.size:
        return slice(0, region.shape[0]), slice(0, region.shape[1])
    border = int(np.ceil(margin * max(np.ptp(rows) + 1, np.ptp(columns) + 1)))
    top, left = max(0, int(rows.min()) - border), max(0, int(columns.min()) - border)
    bottom, right = (min(n, int(i.max()) + 1 + border) for n, i in zip(region.shape, (rows, columns), strict=True))
    return slice(top, bottom), slice(left, right)


def choose_windows(region: np.ndarray, most: int = MOST) -> list[tuple[Window, np.ndarray]]:
    """Choose windows that together cover a region, and say which of its pixels each one paints.

    Blobs are taken from the largest to the smallest. One that fits into a window there already is, with a border of a
    tenth of its side, is painted there; once there are ``most`` windows, the nearest one grows.

    Args:
        region: (H, W) bool.
        most: number of windows at the most.

    Returns:
        pairs of a window and the (H, W) bool pixels that it paints; every pixel of the region is in exactly one.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8), connectivity=8)
    blobs = sorted(range(1, count), key=lambda i: -stats[i, cv2.CC_STAT_AREA])
    boxes: list[np.ndarray] = []
    members: list[list[int]] = []
    for blob in blobs:
        left, top, width, height = stats[blob, :4]
        box = np.array([top, left, top + height, left + width])
        home = _home(box, boxes, region.shape, full=len(boxes) >= most)
        if home is None:
            boxes.append(box)
            members.append([blob])
        else:
            boxes[home] = np.concatenate([np.minimum(boxes[home][:2], box[:2]), np.maximum(boxes[home][2:], box[2:])])
            members[home].append(blob)
    return [(square(box, region.shape), _of(labels, box, blobs)) for box, blobs in zip(boxes, members, strict=True)]


def close_ups(
    rgb: np.ndarray,
    depth: np.ndarray,
    region: np.ndarray,
    side: int,
    spare: np.ndarray | Callable[[], np.ndarray],
    rim: int = RIM,
) -> list[tuple[Window, np.ndarray, Frame, tuple[np.ndarray, ...]]]:
    """Return the windows of a region: each with the (H, W) bool pixels it paints, its frame and what it shows.

    What it shows are rgb, depth and region, cut out and brought to ``side`` x ``side`` pixels. A window far from all
    readings shows ``spare`` instead of ``depth``. The region is shown wider by ``rim``: readings right beside glass are
    often wrong, and shown as known they would spread into it. What is painted stays the region itself.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 metres, clean.
        region: (H, W) bool.
        side: of what the networks see, pixels.
        spare: (H, W) metres, dense, such as the geometric branch paints, or a call that makes it.
        rim: pixels, as networks see them, by which the region is shown wider than it is.
    """
    found = []
    for window, pixels in choose_windows(region):
        inner = fit_frame((window.side, window.side), (side, side))
        read = inner.into(window.cut(depth))
        if not read.any():  # every reading is in some cell: there is none
            read = inner.into(window.cut(spare() if callable(spare) else spare))
        shown = inner.into(window.cut(region)).astype(np.uint8)
        wider = cv2.dilate(shown, np.ones((2 * rim + 1,) * 2, np.uint8)) > 0
        found.append((window, pixels, inner, (inner.into(window.cut(rgb)), read, wider)))
    return found


def _of(labels: np.ndarray, box: np.ndarray, blobs: list[int]) -> np.ndarray:
    """Return (H, W) bool of some blobs; outside their box nothing is written, so that it takes no memory there."""
    pixels = np.zeros(labels.shape, bool)
    inner = np.s_[box[0] : box[2], box[1] : box[3]]
    pixels[inner] = np.isin(labels[inner], blobs)
    return pixels


def _home(box: np.ndarray, boxes: list[np.ndarray], shape: tuple[int, int], full: bool) -> int | None:
    """Return which box's window a further box belongs to, None for a window of its own."""
    if not boxes:
        return None
    for i, other in enumerate(boxes):
        window = square(other, shape)
        border = window.side // 10
        fits = (
            box[0] >= window.top + border
            and box[1] >= window.left + border
            and box[2] <= window.top + window.side - border
            and box[3] <= window.left + window.side - border
        )
        if fits:
            return i
    if not full:
        return None
    centres = np.array([(b[:2] + b[2:]) / 2 for b in boxes])
    return int(np.argmin(np.linalg.norm(centres - (box[:2] + box[2:]) / 2, axis=1)))


@dataclass(frozen=True)
class Claim:
    """What stage one says of a frame, at the working size.

    Attributes:
        frame: how the frame lies in (h, w).
        probability: (h, w) float32.
        classes: (h, w) uint8, 0 where nothing is claimed, else the likelier class.
        region: (h, w) bool, refined.
    """

    frame: Frame
    probability: np.ndarray
    classes: np.ndarray
    region: np.ndarray

    def class_map(self) -> np.ndarray:
        """Return the classes at the size of the frame, (H, W) uint8."""
        codes = range(1, int(self.classes.max(initial=0)) + 1)
        claims = (np.uint8(code) * self.frame.back(self.classes == code) for code in codes)
        return sum(claims, np.zeros(self.frame.source, np.uint8))


@dataclass(frozen=True)
class Layer:
    """What a branch made of a view, at network size, and where that lies in the frame.

    Attributes:
        mean, spread: (h, w) float32 metres, over samples.
        view: how the view, a window or the frame, lies in (h, w).
        window: None for the frame.
        pixels: (H, W) bool, what is painted of the frame in a window.
    """

    mean: np.ndarray
    spread: np.ndarray
    view: Frame
    window: Window | None = None
    pixels: np.ndarray | None = None

    def onto(self, image: np.ndarray, what: str, region: np.ndarray | None = None) -> None:
        """Paint ``what``, "mean" or "spread", onto a map (H, W) in place; of a whole frame ``region`` alone, if any."""
        painted = self.view.back(getattr(self, what))
        if self.window is None:
            np.copyto(image, painted, where=True if region is None else region)
        else:
            self.window.paste(painted, image, self.pixels)


@dataclass(frozen=True)
class Painting:
    """What stage two made of a frame, before composition; its maps are made from network size when asked for.

    Attributes:
        whole: the geometric branch's, of the frame.
        close: the optical branch's.
        level: of the readings over the geometric branch's painting, see :func:`level`; None without any.
        holes: (H, W) bool as bits, where there is no reading outside the region.
        boundaries: M_RGB, M_D and M_DA of the frame, (h, w) bool.
    """

    whole: Layer
    close: tuple[Layer, ...]
    level: Tensor | None
    holes: np.ndarray
    boundaries: tuple[np.ndarray, ...]

    @property
    def windows(self) -> tuple[Window, ...]:
        """Where the optical branch looked."""
        return tuple(layer.window for layer in self.close if layer.window is not None)

    @property
    def geometric(self) -> np.ndarray:
        """(H, W) float32 metres, painted over the whole frame; holes at the level of the readings around them.

        Readings are not echoed: ``adjust`` asks for the painting.
        """
        view = self.whole.view
        painted = view.back(self.whole.mean)
        if self.level is not None:
            tie(painted, self.level, np.unpackbits(self.holes, axis=1, count=view.source[1]).view(bool))
        return painted

    @property
    def optical(self) -> np.ndarray:
        """(H, W) float32 metres, painted in windows around the region; what the geometric branch painted elsewhere."""
        image = self.geometric
        for layer in self.close:
            layer.onto(image, "mean")
        return image

    def compose(self, depth: np.ndarray, region: np.ndarray) -> np.ndarray:
        """Return what ``pipeline.compose`` makes of this, (H, W) float32 metres, with fewer maps in memory at once."""
        out = self.geometric
        for layer in self.close:
            layer.onto(out, "mean", region)
        np.copyto(out, depth, where=(depth > 0) & ~region)
        return out

    def spread(self, region: np.ndarray) -> np.ndarray:
        """Return (H, W) float32 metres, the standard deviation over samples of the branch that paints each pixel."""
        out = self.whole.view.back(self.whole.spread)
        for layer in self.close:
            layer.onto(out, "spread", region)
        return out


class OnDemand:
    """A map of a result: an array, or a call that makes it when it is first asked for.

    Most callers want ``depth`` alone, and of a large frame each map takes hundreds of megabytes.
    """

    def __init__(self, *default: Any):
        self.default = default

    def __set_name__(self, owner: type, name: str):
        self.name = name

    def __get__(self, result: Any, owner: type | None = None) -> Any:
        if result is None and not self.default:
            raise AttributeError(self.name)  # for dataclass: there is no default
        if result is None:
            return self.default[0]
        held = result.__dict__[self.name]
        if callable(held):
            held = result.__dict__[self.name] = held()
        return held

    def __set__(self, result: Any, value: Any):
        result.__dict__[self.name] = value


@dataclass(frozen=True)
class Completion:
    """What ``pipeline.Ditr`` returns; all maps have the size of the input.

    Depth, region and std are there; the other maps are made when they are first asked for.

    Attributes:
        depth: (H, W) float32 metres, dense.
        region: (H, W) bool, after refinement (the caller's, if one was given).
        std: (H, W) float32 metres, the error to expect (one standard deviation), see ``metrics.expected_error``.
        boundary_rgb, boundary_depth, boundary_da: (H, W) bool, M_RGB, M_D and M_DA.
        probability: (H, W) float32, stage one's belief before threshold and refinement; None for a given region.
        optical, geometric: (H, W) float32 metres, each branch's own repainting before composition; the optical branch
            paints the region only, the geometric one's is shown elsewhere.
        windows: where the optical branch looked.
        classes: (H, W) uint8, what stage one claims before refinement: 0 nothing, else the likelier of the classes
            ``data.TRANSPARENT`` and ``data.REFLECTIVE``; None for a given region.
    """

    depth: np.ndarray
    region: np.ndarray
    std: np.ndarray
    boundary_rgb: np.ndarray = OnDemand()
    boundary_depth: np.ndarray = OnDemand()
    boundary_da: np.ndarray = OnDemand()
    probability: np.ndarray | None = OnDemand()
    optical: np.ndarray = OnDemand()
    geometric: np.ndarray = OnDemand()
    windows: tuple[Window, ...]
    classes: np.ndarray | None = OnDemand(None)
