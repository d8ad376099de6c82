"""Surface textures, drawn or photographed, and surroundings for the rendered scenes; each follows from a seed."""

from functools import lru_cache

import cv2
import numpy as np

from ..data import SAMPLES

SIZE = 256
# Photographs that come with scikit-image, free of copyright as far as it knows; held-out scenes see the second row.
PHOTOGRAPHS = ("brick", "grass", "gravel", "coffee", "chelsea", "astronaut", "camera")
HELD_OUT_PHOTOGRAPHS = ("rocket", "immunohistochemistry", "retina")
GROUNDS = ("brick", "grass", "gravel")  # those that lie or stand about in sheets
SURROUNDINGS = (
    *("apartment", "bridge", "city", "dawn", "esplanade", "forest", "hall"),
    *("night", "park", "sky", "studio", "sunrise", "venice", "warehouse"),
)
HELD_OUT_SURROUNDINGS = ("lab", "lobby", "sunset", "workshop")
PEAK = 50.0  # suns and lamps are cut at this many times the median: they would leave bright specks


def texture(kind: str, colours: np.ndarray, seed: int) -> np.ndarray:
    """Return a (256, 256, 3) float32 reflectance image.

    Args:
        kind: plain, noise, stripes, checker, wood, speckle or print; for rooms also planks, tiles, cloth, packaging,
            a name of ``PHOTOGRAPHS`` or ``HELD_OUT_PHOTOGRAPHS``, or ``view:`` and the name of a surrounding.
        colours: (2, 3) base colour and companion, linear RGB.
        seed: decides everything that is random in it.

    Raises:
        ValueError: for an unknown kind.
    """
    makers = {
        "plain": lambda rng: np.zeros((SIZE, SIZE)),
        "noise": _noise,
        "stripes": _stripes,
        "checker": _checker,
        "wood": _wood,
        "speckle": lambda rng: (rng.random((SIZE, SIZE)) < rng.uniform(0.02, 0.3)).astype(float),
        "print": _print,
        "planks": _planks,
        "tiles": _tiles,
        "cloth": _cloth,
    }
    if kind == "packaging" or kind in PHOTOGRAPHS + HELD_OUT_PHOTOGRAPHS or kind.startswith("view:"):
        return _whole(kind, colours, np.random.default_rng(seed))
    if kind not in makers:
        raise ValueError(f"unknown texture {kind!r}; choose one of {', '.join(makers)}")
    rng = np.random.default_rng(seed)
    blend = makers[kind](rng)[..., None]
    grain = 1 + rng.normal(0, 0.02, (SIZE, SIZE, 1))
    return np.clip((colours[0] * (1 - blend) + colours[1] * blend) * grain, 0.01, 0.97).astype(np.float32)


def environment(seed: int, level: float) -> np.ndarray:
    """Return a (64, 128, 3) float32 radiance map of a room: a soft gradient with a few bright windows."""
    rng = np.random.default_rng([seed, 3])
    rows = np.linspace(1.3, 0.4, 64)[:, None, None]
    tint = 1 + rng.normal(0, 0.08, 3)
    image = np.broadcast_to(level * rows * tint, (64, 128, 3)).copy()
    for _ in range(rng.integers(1, 5)):
        y, x = rng.integers(4, 34), rng.integers(0, 112)
        image[y : y + rng.integers(4, 14), x : x + rng.integers(4, 16)] = rng.uniform(1.5, 6) * level * tint
    return image.astype(np.float32)


def _noise(rng) -> np.ndarray:
    total = np.zeros((SIZE, SIZE))
    for cells in (4, 8, 16, 32, 64)[rng.integers(0, 3) :]:
        field = rng.random((cells, cells)).astype(np.float32)
        total += cv2.resize(field, (SIZE, SIZE), interpolation=cv2.INTER_CUBIC) / np.sqrt(cells)
    low, high = total.min(), total.max()
    return (total - low) / (high - low)


def _stripes(rng) -> np.ndarray:
    y, x = np.mgrid[:SIZE, :SIZE]
    angle, period = rng.uniform(0, np.pi), rng.uniform(8, 40)
    return (np.sin(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period) > rng.uniform(-0.5, 0.5)).astype(float)


def _checker(rng) -> np.ndarray:
    y, x = np.mgrid[:SIZE, :SIZE]
    cell = int(rng.integers(8, 40))
    return ((x // cell + y // cell) % 2).astype(float)


def _wood(rng) -> np.ndarray:
    long = cv2.resize(rng.random((64, 4)).astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
    rings = np.sin(2 * np.pi * rng.uniform(4, 12) * (long + np.linspace(0, 1, SIZE)[:, None] * rng.uniform(0, 1.5)))
    return np.clip(0.5 + 0.5 * rings, 0, 1)


def _print(rng) -> np.ndarray:
    """A printed page: lines of "text" and shapes. Its edges are in the picture but not in the depth."""
    image = np.zeros((SIZE, SIZE), np.float32)
    for _ in range(rng.integers(4, 12)):
        a, b = rng.integers(0, SIZE, 2), rng.integers(0, SIZE, 2)
        value = float(rng.uniform(0.3, 1))
        if rng.random() < 0.5:
            cv2.rectangle(image, tuple(map(int, a)), tuple(map(int, b)), value, int(rng.choice([-1, 2, 4])))
        else:
            cv2.circle(image, tuple(map(int, a)), int(rng.integers(8, 50)), value, int(rng.choice([-1, 3])))
    for y in range(int(rng.integers(10, 40)), SIZE - 8, 14):
        for x in range(12, SIZE - 20, 18):
            if rng.random() < 0.6:
                cv2.rectangle(image, (x, y), (x + int(rng.integers(5, 15)), y + 5), 1.0, -1)
    return image.astype(float)


def _planks(rng) -> np.ndarray:
    """Floor boards: fine grain along x, each board with a tone of its own, dark joints."""
    fine = cv2.resize(rng.random((SIZE, 6)).astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
    broad = cv2.resize(rng.random((40, 3)).astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
    image = 0.5 * fine + 0.5 * broad
    boards = int(rng.choice([1, 3, 5, 8]))  # one board: a table top without joints
    high = SIZE // boards
    for k in range(boards if boards > 1 else 0):
        row = slice(k * high, (k + 1) * high)
        cut = int(rng.integers(20, SIZE - 20))
        image[row, :cut] += rng.normal(0, 0.15)
        image[row, cut:] += rng.normal(0, 0.15)
        image[row, cut : cut + 2] = image[k * high] = 1.3
    return np.clip(image, 0, 1)


def _tiles(rng) -> np.ndarray:
    """Tiles with joints between them."""
    count = int(rng.integers(2, 7))
    image = (
        0.25 * _noise(rng)
        + np.kron(rng.normal(0.1, 0.05, (count, count)), np.ones((SIZE // count + 1,) * 2))[:SIZE, :SIZE]
    )
    step = SIZE / count
    for k in range(count):
        at = int(k * step)
        image[at : at + 3] = image[:, at : at + 3] = 1
    return np.clip(image, 0, 1)


def _cloth(rng) -> np.ndarray:
    """Woven threads over soft folds."""
    y, x = np.mgrid[:SIZE, :SIZE]
    period = rng.uniform(3, 8)
    threads = 0.5 + 0.25 * np.sin(2 * np.pi * x / period) * np.sin(2 * np.pi * y / period)
    return np.clip(0.6 * threads + 0.4 * _noise(rng), 0, 1)


def _whole(kind: str, colours: np.ndarray, rng) -> np.ndarray:
    """Return a (256, 256, 3) float32 picture that brings colours of its own: packaging, a photograph, a view."""
    if kind == "packaging":
        return _packaging(colours, rng)
    picture = _view(kind[5:]) if kind.startswith("view:") else _photograph(kind)
    height, width = picture.shape[:2]
    side = int(min(height, width) * rng.uniform(0.4, 1.0))
    y, x = rng.integers(0, height - side + 1), rng.integers(0, width - side + 1)
    crop = cv2.resize(picture[y : y + side, x : x + side], (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    grey = crop.mean(axis=2, keepdims=True)
    tint = colours[0] / colours[0].mean()
    crop = (grey + (crop - grey) * rng.uniform(0.2, 1.2)) * tint ** rng.uniform(0, 1)
    crop = crop * colours.mean() / max(float(crop.mean()), 1e-3)
    return np.clip(crop if kind.startswith("view:") or rng.random() < 0.5 else crop[:, ::-1], 0.01, 0.9).astype(
        np.float32
    )


def _packaging(colours: np.ndarray, rng) -> np.ndarray:
    """A printed carton or label: coloured fields, lines of text, a picture."""
    image = np.empty((SIZE, SIZE, 3), np.uint8)
    image[:] = 255 * colours[0]
    for _ in range(rng.integers(2, 6)):
        a, b = rng.integers(0, SIZE, 2), rng.integers(0, SIZE, 2)
        ink = tuple(map(float, 255 * rng.choice([colours[1], rng.random(3), np.full(3, 0.85), np.full(3, 0.04)])))
        if rng.random() < 0.7:
            cv2.rectangle(image, tuple(map(int, a)), tuple(map(int, b)), ink, -1)
        else:
            cv2.circle(image, tuple(map(int, a)), int(rng.integers(12, 70)), ink, -1, cv2.LINE_AA)
    for _ in range(rng.integers(1, 6)):
        word = "".join(chr(c) for c in rng.integers(65, 91, rng.integers(3, 9)))
        ink = (230,) * 3 if rng.random() < 0.5 else (8,) * 3
        at = (int(rng.integers(-20, 160)), int(rng.integers(20, SIZE)))
        size = float(rng.uniform(0.5, 2.2))
        cv2.putText(image, word, at, cv2.FONT_HERSHEY_DUPLEX, size, ink, int(rng.integers(1, 4)), cv2.LINE_AA)
    for y in range(int(rng.integers(120, 230)), SIZE - 6, 9):
        cv2.line(image, (20, y), (int(rng.integers(80, 230)), y), (25,) * 3, 2)
    return np.clip(image.astype(np.float32) / 255, 0.01, 0.92)


@lru_cache(maxsize=16)
def _photograph(name: str) -> np.ndarray:
    """Return a photograph of scikit-image as (H, W, 3) float32 linear RGB."""
    from skimage import data

    image = getattr(data, name)()
    image = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., :3]
    if max(image.shape) > 700:
        image = cv2.resize(image, (512, 512 * image.shape[0] // image.shape[1]), interpolation=cv2.INTER_AREA)
    return (image.astype(np.float32) / 255) ** 2.2


@lru_cache(maxsize=16)
def panorama(name: str) -> np.ndarray:
    """Return a photographed surrounding as (256, 512, 3) float32 radiance of median 1, peaks cut.

    Raises:
        ValueError: for an unknown name, or where the file is missing.
    """
    import OpenEXR

    path = SAMPLES / "environments" / f"{name}.exr"
    if name not in SURROUNDINGS + HELD_OUT_SURROUNDINGS or not path.is_file():
        raise ValueError(f"no surrounding {name!r} in {path.parent}: run ditr_lite from its repository")
    image = OpenEXR.File(str(path)).channels()["RGB"].pixels.astype(np.float32)
    level = max(float(np.median(image.mean(axis=2))), 0.15 * float(np.clip(image, 0, 1).mean()))
    return np.clip(image / level, 0, PEAK)


def surrounding(name: str, turn: float, level: float) -> np.ndarray:
    """Return a (256, 512, 3) float32 radiance map: a :func:`panorama`, turned by ``turn`` of a full turn.

    Args:
        name: of a panorama.
        turn: 0 to 1.
        level: radiance that the mean of the upper half is scaled to, peaks excluded.
    """
    image = np.roll(panorama(name), round(turn * 512), axis=1)
    image = image * (level / np.minimum(image[:128], 8).mean())
    return (0.85 * image + 0.15 * level).astype(np.float32)  # light that has been around a room


def _view(name: str) -> np.ndarray:
    """Return the middle band of a panorama as a picture: what a far wall of that place looks like."""
    band = panorama(name)[72:184]
    return np.clip(band / np.percentile(band, 90), 0, 1)
