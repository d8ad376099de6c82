"""Windows: where the optical branch looks closely, one square around each blob of the region.

Not in the paper, which works on whole frames at a size it does not name. On a laptop the working size is small, and a
glass that is 60 pixels wide in a camera's picture would be 12 pixels wide in it. So stage one looks at the whole frame,
and the optical branch is given squares twice as wide as what it must paint.
"""

from dataclasses import dataclass

import cv2
import numpy as np

MARGIN = 2.0  # side of a window over the longer side of what it must hold
LEAST = 0.2  # smallest side, as a share of the frame's longer side
MOST = 8  # windows in a frame; further blobs join the nearest window


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
