"""What training looks at: frames and windows of rendered scenes, moved, turned and disturbed as cameras disturb them.

A *view* is a picture of a given size cut from a scene: the whole frame for stage one and the geometric branch, a window
around what is to be painted for the optical one. Everything random comes from the generator that is handed in.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..data import lossy
from ..region import IGNORE
from ..windows import LEAST, MARGIN
from .augment import colours, dusk, glare
from .scenes import Scenes

TIE = 0.01  # pixels: where a centre lies between two of the scene's, the later is taken, as `windows.centres` does


@dataclass(frozen=True)
class View:
    """One picture at network size, still in metres.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 metres, raw, 0 = missing.
        depth_gt: (H, W) float32 metres, 0 = unknown.
        material: (H, W) uint8, 0 opaque, 1 transparent, 2 reflective, IGNORE beyond the scene's border.
        region: (H, W) bool, what is to be painted by the optical branch: the true region, or a mistaken one.
    """

    rgb: np.ndarray
    depth: np.ndarray
    depth_gt: np.ndarray
    material: np.ndarray
    region: np.ndarray


def look(scenes: Scenes, i: int, matrix: np.ndarray, size: tuple[int, int], claimed: np.ndarray | None = None) -> View:
    """Cut a view out of scene ``i``.

    Args:
        scenes: the scenes.
        i: which one.
        matrix: (2, 3), takes pixels of the view to pixels of the scene.
        size: (H, W) of the view.
        claimed: (h, w) bool, further pixels of the scene that a mistaken stage one takes for glass.
    """
    flags = cv2.WARP_INVERSE_MAP
    wh = (size[1], size[0])
    between = matrix + np.float32([[0, 0, TIE], [0, 0, TIE]])
    picture, onto = shrunken(scenes.rgb[i], matrix)
    rgb = cv2.warpAffine(picture, onto, wh, flags=cv2.INTER_LINEAR | flags, borderMode=cv2.BORDER_REPLICATE)
    nearest = cv2.INTER_NEAREST | flags
    depth = pooled(cv2.warpAffine(scenes.depth[i], between, wh, flags=nearest), scenes.depth[i], matrix)
    depth = depth.astype(np.float32) / 1000
    gt = cv2.warpAffine(scenes.depth_gt[i], between, wh, flags=nearest).astype(np.float32) / 1000
    material = cv2.warpAffine(scenes.material[i], between, wh, flags=nearest, borderValue=IGNORE)
    region = lossy(material)
    if claimed is not None:
        region |= cv2.warpAffine(claimed.astype(np.uint8), between, wh, flags=nearest) > 0
    return View(rgb, depth, gt, material, region)


def shrunken(rgb: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a scene's picture with pixels as large as the view's, and the matrix into it: colour shrinks by area.

    Args:
        rgb: (h, w, 3) uint8; returned as it is where the view enlarges.
        matrix: (2, 3), takes pixels of the view to pixels of ``rgb``.
    """
    scale = np.sqrt(abs(np.linalg.det(matrix[:, :2].astype(float))))
    if scale <= 1:
        return rgb, matrix
    height, width = (max(1, round(n / scale)) for n in rgb.shape[:2])
    factor = np.array([[width / rgb.shape[1]], [height / rgb.shape[0]]])  # of x and y
    onto = factor * matrix
    onto[:, 2:] += factor / 2 - 0.5  # centres of pixels have whole numbers
    return cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), onto.astype(np.float32)


def pooled(small: np.ndarray, image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return a view of depth in which a pixel without a reading takes the closest that it covers, as in the system.

    Args:
        small: (H, W) the view, 0 = missing.
        image: (h, w) the scene's depth.
        matrix: (2, 3), takes pixels of the view to pixels of the scene.
    """
    linear, shift = matrix[:, :2].astype(float), matrix[:, 2:].astype(float)
    if abs(np.linalg.det(linear)) <= 1:  # no pixel covers more than one of the scene's
        return small
    holes = cv2.dilate((small == 0).astype(np.uint8), np.ones((3, 3), np.uint8))  # and around: roundings may differ
    near = cv2.warpAffine(holes, matrix, image.shape[::-1], flags=cv2.INTER_NEAREST)
    rows, columns = np.nonzero((near > 0) & (image > 0))
    place = np.linalg.solve(linear, np.stack([columns, rows]) - shift)  # (2, N) x and y in the view
    cell = np.floor(place + 0.5).astype(int)
    centre = linear @ cell + shift
    inside = (cell >= 0) & (cell < np.array(small.shape[::-1])[:, None])
    inside &= (centre >= -0.4) & (centre <= np.array(image.shape[::-1])[:, None] - 0.6)  # no cell beyond the border
    inside = inside.all(axis=0)
    order = np.argsort(-((place - cell) ** 2).sum(axis=0), kind="stable")  # the closest is written last
    order = order[inside[order]]
    out = small.copy()
    out[cell[1, order], cell[0, order]] = image[rows[order], columns[order]]
    return np.where(small > 0, small, out)


def placement(
    size: tuple[int, int], centre: tuple[float, float], scale: float, angle: float, mirror: bool
) -> np.ndarray:
    """Return the (2, 3) matrix that takes view pixels to scene pixels.

    Args:
        size: (H, W) of the view.
        centre: (row, column) of the scene that the view's centre shows.
        scale: scene pixels per view pixel.
        angle: turn, radians.
        mirror: whether left and right change places.
    """
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    linear = np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if mirror else 1.0, 1.0])
    middle = np.array([(size[1] - 1) / 2, (size[0] - 1) / 2])
    shift = np.array([centre[1], centre[0]]) - linear @ middle
    return np.concatenate([linear, shift[:, None]], axis=1).astype(np.float32)


def turn(rng: np.random.Generator) -> float:
    """Draw a turn: mostly slight, a third of all any angle: cameras are held in all ways."""
    if rng.random() < 0.65:
        return float(rng.normal(0, 0.15))
    if rng.random() < 0.5:
        return float(rng.integers(4) * np.pi / 2 + rng.normal(0, 0.1))
    return float(rng.uniform(-np.pi, np.pi))


def frame_view(
    scenes: Scenes, i: int, size: tuple[int, int], rng: np.random.Generator | None, still: bool = False
) -> View:
    """Return a whole scene at ``size``; with ``rng`` zoomed, moved and turned, or, ``still``, mirrored at most."""
    height, width = scenes.depth.shape[1:]
    whole = max(height / size[0], width / size[1])
    centre = ((height - 1) / 2, (width - 1) / 2)
    if rng is None:
        return look(scenes, i, placement(size, centre, whole, 0.0, False), size)
    if still:
        return look(scenes, i, placement(size, centre, whole, 0.0, bool(rng.random() < 0.5)), size)
    zoom = float(np.exp(rng.uniform(np.log(0.75), np.log(1.8))))
    free = max(0.1, 1 - 1 / zoom) / 2  # a magnified frame may show any part of the scene
    centre = tuple(c + rng.uniform(-free, free) * n for c, n in zip(centre, (height, width), strict=True))
    return look(scenes, i, placement(size, centre, whole / zoom, turn(rng), bool(rng.random() < 0.5)), size)


def window_view(
    scenes: Scenes, i: int, size: tuple[int, int], rng: np.random.Generator, mistaken: float = 0.35
) -> View:
    """Return a window around a blob of the region, or around something that stage one might take for glass.

    Args:
        scenes: the scenes, with instances.
        i: which one.
        size: (H, W) of the view.
        rng: draws the blob, the window about it and the mistakes.
        mistaken: chance that the region is not the true one.
    """
    region = lossy(scenes.material[i])
    claimed = None
    wrong = rng.random() < mistaken or not region.any()
    if wrong:
        claimed = false_claim(scenes, i, rng)
    box = _some_box(claimed if wrong and (rng.random() < 0.6 or not region.any()) else region, rng)
    longest = max(region.shape)
    side = max(MARGIN * max(box[2] - box[0], box[3] - box[1]) * np.exp(rng.uniform(-0.5, 0.4)), LEAST * longest)
    side = min(side, 1.2 * longest)
    centre = [(a + b) / 2 + side * rng.uniform(-0.12, 0.12) for a, b in ((box[0], box[2]), (box[1], box[3]))]
    matrix = placement(size, tuple(centre), side / size[0], turn(rng), bool(rng.random() < 0.5))
    view = look(scenes, i, matrix, size, claimed)
    return replace(view, region=blunder(view.region, rng) if rng.random() < mistaken else grow(view.region, rng))


def false_claim(scenes: Scenes, i: int, rng: np.random.Generator) -> np.ndarray:
    """Return (h, w) bool: an opaque thing of the scene, or a patch of it, that a mistaken stage one claims."""
    instances, height, width = scenes.instances[i], *scenes.material[i].shape
    opaque = np.unique(instances[(scenes.material[i] == 0) & (instances > 0)])
    if opaque.size and rng.random() < 0.7:
        return instances == rng.choice(opaque)
    out = np.zeros((height, width), np.uint8)
    axes = (rng.uniform(0.03, 0.2, 2) * width).astype(int) + 1
    at = (int(rng.integers(width)), int(rng.integers(height)))
    cv2.ellipse(out, at, tuple(map(int, axes)), float(rng.uniform(0, 180)), 0, 360, 1, -1)
    return out > 0


def _some_box(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return (top, left, bottom, right) of one blob, larger ones more often; of the whole frame where there is none."""
    count, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return np.array([0, 0, *mask.shape])
    areas = np.sqrt(stats[1:, cv2.CC_STAT_AREA])
    left, top, width, height = stats[1 + rng.choice(count - 1, p=areas / areas.sum()), :4]
    return np.array([top, left, top + height, left + width])


def grow(region: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a region grown by up to 4 pixels, or shrunk by one.

    The system shows a little more in windows that enlarge: there a pixel of the working size, by which refinement grows
    a region, is some three pixels wide, and ``windows.RIM`` adds two. Mistaken claims teach what lies farther out.
    """
    pixels = int(rng.integers(-1, 5))
    if pixels == 0:
        return region
    kernel = np.ones((2 * abs(pixels) + 1,) * 2, np.uint8)
    change = cv2.dilate if pixels > 0 else cv2.erode
    return change(region.astype(np.uint8), kernel) > 0


def blunder(region: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a region with a rough outline, a part missed and a part too many."""
    height, width = region.shape
    field = bumps(region.shape, rng)
    inside = region.astype(np.uint8)
    near = cv2.dilate(inside, np.ones((15, 15), np.uint8)) > 0
    far = cv2.erode(inside, np.ones((9, 9), np.uint8)) > 0
    level = rng.uniform(-0.5, 1.0)
    out = far | (near & (field > level)) if rng.random() < 0.5 else region & (field > rng.uniform(-2.5, -0.7))
    return grow(out, rng)


def read_truly(view: View, rng: np.random.Generator) -> View:
    """Let the sensor read parts of the glass and metal as they are, but for a bias and noise; all else stays.

    Real glass is read more truthfully than rendered glass: it is scratched, dusty, patterned, or of plastic. Whoever
    only sees rendered readings learns never to trust one.
    """
    field = bumps(view.depth.shape, rng)
    true = lossy(view.material) & (view.depth_gt > 0)
    if not true.any():
        return view
    read = true & (field > np.quantile(field[true], rng.uniform(0, 0.8)))
    if rng.random() < 0.5:
        read &= view.depth > 0  # holes stay holes
    bias, ripple = abs(rng.normal(0, 0.01)), rng.uniform(0.001, 0.008) * bumps(view.depth.shape, rng)
    noise = rng.normal(0, rng.uniform(0.0005, 0.004), view.depth.shape)
    seen = view.depth_gt * (1 + bias + ripple + noise)
    return replace(view, depth=np.where(read, seen, view.depth).astype(np.float32))


def bumps(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return a smooth random field (H, W) of mean 0 and spread 1."""
    field = cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), float(rng.uniform(4, 14)))
    return field / (field.std() + 1e-6)


def disturb(view: View, rng: np.random.Generator) -> View:
    """Vary the colours and lose, thin out or spoil readings as cameras and mountings do."""
    rgb = colours(view.rgb, rng)
    night = rng.random() < 0.12
    if night:
        rgb = dusk(rgb, rng)
    depth = lose(view.depth, rng)
    if rng.random() < (0.8 if night else 0.12):
        rgb, blinded = glare(rgb, rng)
        depth = np.where(blinded, 0, depth).astype(np.float32)
    if rng.random() < 0.2:
        depth = spoil(depth, rng)
    if rng.random() < 0.06:
        depth = thin_out(depth, rng)
    return replace(view, rgb=rgb, depth=depth if (depth > 0).sum() > 20 else view.depth)


def mix_views(view: View, other: View, rng: np.random.Generator) -> View:
    """Replace a rectangle of a view by what another shows there (CutMix, Yun et al. 2019), at a like distance.

    Things in front of other rooms and tables, cut off anywhere: a network that has few scenes learns the things rather
    than the scenes.

    Args:
        view: the one that stays around the rectangle.
        other: of the same size, the one that fills it.
        rng: draws the rectangle, 0.3 to 0.8 of each side.
    """
    height, width = view.depth.shape
    rows, columns = (round(rng.uniform(0.3, 0.8) * n) for n in (height, width))
    top, left = int(rng.integers(height - rows + 1)), int(rng.integers(width - columns + 1))
    inside = np.zeros((height, width), bool)
    inside[top : top + rows, left : left + columns] = True
    ratio = _middle(view.depth) / _middle(other.depth)
    return View(
        rgb=np.where(inside[..., None], other.rgb, view.rgb),
        depth=np.where(inside, ratio * other.depth, view.depth).astype(np.float32),
        depth_gt=np.where(inside, ratio * other.depth_gt, view.depth_gt).astype(np.float32),
        material=np.where(inside, other.material, view.material),
        region=np.where(inside, other.region, view.region),
    )


def _middle(depth: np.ndarray) -> float:
    return float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0


def lose(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Lose readings in patches, up to half of a picture, so that a hole by itself does not come to mean glass."""
    kind = rng.random()
    if kind < 0.55:
        return depth
    height, width = depth.shape
    coarse = rng.normal(size=(max(2, height // int(rng.integers(6, 40))),) * 2).astype(np.float32)
    field = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    share = rng.uniform(0, 0.5) if kind > 0.7 else rng.uniform(0, 0.15)
    return np.where(field >= np.quantile(field, share), depth, 0).astype(np.float32)


def spoil(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add far and near stray readings, single ones and specks, up to about one in a hundred."""
    out = depth.copy()
    count = int(rng.uniform(0, 0.005) * depth.size)
    for _ in range(count // 3 + 1):
        y, x = int(rng.integers(depth.shape[0])), int(rng.integers(depth.shape[1]))
        r = int(rng.integers(1, 4))
        factor = rng.uniform(1.5, 15) if rng.random() < 0.6 else rng.uniform(0.05, 0.5)
        out[y : y + r, x : x + r] = np.median(depth[depth > 0]) * factor if (depth > 0).any() else 0
    return out


def thin_out(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Keep few readings: some in a thousand, or every so many rows, as a sparse or a scanning sensor gives."""
    if rng.random() < 0.5:
        keep = rng.random(depth.shape) < np.exp(rng.uniform(np.log(0.003), np.log(0.05)))
        return np.where(keep, depth, 0).astype(np.float32)
    out = np.zeros_like(depth)
    step = int(rng.integers(4, 14))
    first = int(rng.integers(step))
    out[first::step] = depth[first::step]
    return out
