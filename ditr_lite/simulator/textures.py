"""Procedural surface textures and surroundings for the rendered scenes; every image follows from a seed."""

import cv2
import numpy as np

SIZE = 256


def texture(kind: str, colours: np.ndarray, seed: int) -> np.ndarray:
    """Return a (256, 256, 3) float32 reflectance image.

    Args:
        kind: plain, noise, stripes, checker, wood, speckle or print.
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
    }
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
