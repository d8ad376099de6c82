"""What training varies of a picture's colours; what it varies of place and depth is in ``views``.

Not in the paper, which names no augmentation. Rendered scenes are few and cleaner than a camera's. Everything random
comes from the generator that is handed in.
"""

import cv2
import numpy as np


def colours(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Vary gain, contrast, gamma, white balance, hue, sharpness and noise of an (H, W, 3) uint8 image."""
    image = (rgb.astype(np.float32) / 255) ** rng.uniform(0.7, 1.4)
    image = (image - 0.5) * rng.uniform(0.7, 1.25) + 0.5 + rng.uniform(-0.1, 0.1)
    image = image * (1 + rng.normal(0, 0.06, 3).astype(np.float32))
    if rng.random() < 0.3:  # metals and glass of other colours than those at hand
        mix = np.eye(3)[rng.permutation(3)] + rng.normal(0, 0.15, (3, 3))
        image = image @ (mix / mix.sum(axis=0)).astype(np.float32)
    image += rng.normal(0, rng.uniform(0, 0.03), image.shape).astype(np.float32)
    if rng.random() < 0.3:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.2))
    if rng.random() < 0.1:
        image = np.repeat(image.mean(2, keepdims=True), 3, axis=2)
    return (np.clip(image, 0, 1) * 255).astype(np.uint8)


def dusk(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Darken an (H, W, 3) uint8 image as at night: dim, tinted, dimmer on one side, with a sensor's noise."""
    height, width = rgb.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j].astype(np.float32)
    slope = rng.uniform(-0.6, 0.6, 2)
    light = rng.uniform(0.2, 0.65) * np.exp(slope[0] * y + slope[1] * x) * np.exp(rng.normal(0, 0.12, 3))[:, None, None]
    image = rgb.astype(np.float32) / 255 * light.transpose(1, 2, 0)
    image += rng.normal(0, rng.uniform(0.005, 0.04), image.shape)
    return (np.clip(image, 0, 1) * 255).astype(np.uint8)


def glare(rgb: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Put lamps and their reflections into a picture: bright spots or streaks with a halo, blinding in their core.

    A lamp blinds a depth camera as glass does, and it shines; without such pictures stage one takes it for glass.

    Args:
        rgb: (H, W, 3) uint8.
        rng: draws number, place, shape and colour.

    Returns:
        (H, W, 3) uint8; (H, W) bool, the cores, where readings get lost.
    """
    height, width = rgb.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    light = np.zeros((height, width, 3), np.float32)
    core = np.zeros((height, width), bool)
    for _ in range(int(rng.integers(1, 5))):
        away_y, away_x = y - rng.uniform(0, height), x - rng.uniform(0, width)
        angle = rng.uniform(0, np.pi)
        radius = width * np.exp(rng.uniform(np.log(0.008), np.log(0.06)))
        longer = np.exp(rng.uniform(0, 1.5)) if rng.random() < 0.5 else 1.0
        along = (np.cos(angle) * away_x + np.sin(angle) * away_y) / (longer * radius)
        across = (np.cos(angle) * away_y - np.sin(angle) * away_x) / radius
        distance = along**2 + across**2
        brightness = 1.5 * np.exp(-distance) + rng.uniform(0, 0.25) * np.exp(-distance / 16)
        light += brightness[..., None] * (1 - rng.uniform(0, 0.35, 3)).astype(np.float32)
        if rng.random() < 0.6:
            core |= distance < rng.uniform(0.2, 1.5)
    return np.clip(rgb + 255 * light, 0, 255).astype(np.uint8), core
