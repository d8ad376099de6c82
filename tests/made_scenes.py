"""Scenes made of numbers: fast, and without files."""

import numpy as np

from ditr_lite.boundary import boundaries_from_labels
from ditr_lite.training.scenes import Scenes


def make_scenes(count: int, shape: tuple[int, int], seed: int = 0) -> Scenes:
    """Tilted planes at 0.5 to 0.8 m with a bright box of glass or metal, half missing, half 5 cm too far, and a cup."""
    rng = np.random.default_rng(seed)
    height, width = shape
    gt = np.tile(np.linspace(500, 800, width).astype(np.uint16), (count, height, 1))
    rgb = rng.integers(0, 120, (count, *shape, 3), np.uint8)
    material, instances = np.zeros((2, count, *shape), np.uint8)
    depth = gt.copy()
    gt[:, :3] = 0  # unknown
    for k in range(count):
        top, left = (int(rng.integers(height // 8, height // 2)), int(rng.integers(0, width // 3)))
        box = np.s_[k, top : top + height // 3, left : left + width // 3]
        rgb[box] += 120
        material[box] = 1 + k % 2
        instances[box] = 1
        depth[box] += 50
        depth[k, top : top + height // 6, left : left + width // 3] = 0
        cup = np.s_[k, height // 2 : 3 * height // 4, -width // 5 : -width // 10]  # opaque
        instances[cup] = 2
        for maps in (gt, depth):
            maps[cup] -= 100
    return Scenes([f"made_{k}" for k in range(count)], rgb, depth, gt, material, instances)


def table(seed: int = 0, shape: tuple[int, int] = (48, 64)) -> np.ndarray:
    """A table that slopes away from 0.5 to 0.9 m, with noise and a fifth of its readings missing."""
    rng = np.random.default_rng(seed)
    depth = np.linspace(0.9, 0.5, shape[0])[:, None] + 0.002 * rng.standard_normal(shape)
    return np.where(rng.random(shape) < 0.2, 0, depth).astype(np.float32)


def plane(height: int = 60, width: int = 80, near: float = 0.6, far: float = 0.9) -> np.ndarray:
    """Depth of a table that rises towards the top of the image: a plane is linear in 1 / z."""
    row = 1 / np.linspace(1 / far, 1 / near, height, dtype=np.float32)
    return np.repeat(row[:, None], width, axis=1)


def with_box(depth: np.ndarray, z: float = 0.5) -> np.ndarray:
    """Put the face of a box in front of a depth map (60, 80)."""
    depth = depth.copy()
    depth[20:40, 30:50] = z
    return depth


def box_outline(shape: tuple[int, int] = (60, 80)) -> np.ndarray:
    """Return the true outline of that box."""
    labels = np.zeros(shape, int)
    labels[20:40, 30:50] = 1
    return boundaries_from_labels(labels)
