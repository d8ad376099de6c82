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
