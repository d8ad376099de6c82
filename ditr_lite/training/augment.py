"""What training varies: colour, lost readings, size and turn of a scene, and the mistakes that stage one makes.

Not in the paper, which names no augmentation. Rendered scenes are few and cleaner than a camera's; each function here
stands for one way in which the next frame may differ. Everything random comes from the generator that is handed in.
"""

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor


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


def lose_readings(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Lose further readings of (H, W) depth: border strips and rectangles, as with a narrower view or an occluder."""
    depth = depth.copy()
    if rng.random() < 0.25:
        strip = int(rng.integers(1, 20))
        depth[:, :strip] = 0
    if rng.random() < 0.25:
        y, x = rng.integers(0, depth.shape[0] - 10), rng.integers(0, depth.shape[1] - 10)
        depth[y : y + rng.integers(4, 40), x : x + rng.integers(4, 40)] = 0
    return depth


def lose_patches(
    depth_n: Tensor, valid: Tensor, rng: np.random.Generator, chance: float = 0.3, most: float = 0.5
) -> tuple[Tensor, Tensor]:
    """Lose readings in patches, up to half of a picture, so that a hole by itself does not come to mean glass.

    Real cameras miss 8 to 48 % of the pixels outside glass; rendered scenes seldom as many.

    Args:
        depth_n: (B, 1, H, W) normalised depth, 0 where missing.
        valid: (B, 1, H, W) 0/1.
        rng: draws which frames lose readings, where and how many.
        chance: of a frame to lose any.
        most: largest share of a frame's pixels that is lost.

    Returns:
        the same two, with less in them.
    """
    count, _, height, width = valid.shape
    coarse = torch.from_numpy(rng.normal(size=(count, 1, height // 12, width // 12)).astype(np.float32))
    field = F.interpolate(coarse, size=(height, width), mode="bicubic", align_corners=False)
    shares = torch.from_numpy(np.where(rng.random(count) < chance, rng.uniform(0, most, count), 0).astype(np.float32))
    limits = torch.stack([torch.quantile(f, share) for f, share in zip(field, shares, strict=True)])
    stays = (field >= limits.view(-1, 1, 1, 1)).to(valid.dtype)  # share 0: the limit is the minimum, all stay
    return depth_n * stays, valid * stays


def reframe(
    rgb: Tensor, maps: list[Tensor], rng: np.random.Generator, zoom: tuple[float, float] = (0.8, 1.6), turn: float = 0.3
) -> tuple[Tensor, list[Tensor]]:
    """Zoom, turn and shift every frame of a batch by its own random amount.

    Args:
        rgb: (B, 3, H, W), resampled smoothly; outside the old frame the border is repeated.
        maps: (B, 1, H, W) each, resampled to the nearest pixel; outside the old frame they are 0: missing, unknown.
        rng: draws the amounts.
        zoom: smallest and largest magnification.
        turn: largest turn to either side, radians.

    Returns:
        the same, reframed.
    """
    count, _, height, width = rgb.shape
    theta = np.zeros((count, 2, 3), np.float32)
    for i in range(count):
        scale, angle = 1 / np.exp(rng.uniform(*np.log(zoom))), rng.uniform(-turn, turn)
        c, s, aspect = scale * np.cos(angle), scale * np.sin(angle), width / height
        shift = rng.uniform(-1, 1, 2) * max(0.1, 1 - scale)  # a magnified frame may show any part of the old one
        theta[i] = [[c, -s / aspect, shift[0]], [s * aspect, c, shift[1]]]
    grid = F.affine_grid(torch.from_numpy(theta), [count, 1, height, width], align_corners=False)
    image = F.grid_sample(rgb, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return image, [F.grid_sample(m, grid, mode="nearest", padding_mode="zeros", align_corners=False) for m in maps]


def grow(region: Tensor, pixels: int) -> Tensor:
    """Return (B, 1, H, W) 0/1 grown by ``pixels`` on every side, or shrunk by one where that is negative."""
    if pixels > 0:
        return F.max_pool2d(region, 2 * pixels + 1, 1, pixels)
    return 1 - F.max_pool2d(1 - region, 3, 1, 1) if pixels < 0 else region


def mistake(region: Tensor, rng: np.random.Generator) -> Tensor:
    """Return a region as stage one might have found it: grown or shrunk, a part missed, something else taken for glass.

    A network that only ever saw true regions trusts every reading outside and no reading inside.

    Args:
        region: (B, 1, H, W) 0/1, the true one.
        rng: draws the mistakes, for each frame its own.
    """
    height, width = region.shape[2:]
    out = torch.cat([grow(frame[None], int(rng.integers(-1, 5))) for frame in region])
    for frame in out[:, 0]:
        for value, chance in ((0.0, 0.3), (1.0, 0.3)):
            if rng.random() < chance:
                h, w = (int(n * rng.uniform(0.05, 0.3)) for n in (height, width))
                y, x = int(rng.integers(0, height - h + 1)), int(rng.integers(0, width - w + 1))
                frame[y : y + h, x : x + w] = value
    return out
