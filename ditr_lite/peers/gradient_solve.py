"""Depth from readings and predicted surface orientation, by one sparse least-squares solve.

DeepCompletion (Zhang and Funkhouser 2018) and ClearGrasp (Sajjan et al. 2020) predict surface normals and occlusion
boundaries and solve for the depth that agrees with them and with the readings. A normal n and the ray r of a pixel give
the gradient of *log depth* on the image, -(n_x, n_y) / (f n.r): the orientation in a form that needs no camera and
makes the solve linear. Minimised over u = log depth:

    sum over readings (u - log z)^2  +  w sum over neighbours (1 - b) (u_next - u - g)^2
"""

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

DIVISOR = 2  # solved at half the working size, like the originals, and scaled back; _between_blocks is for 2
FOLLOW = 4.0  # w: how much a predicted gradient counts beside a reading
LEAST = 0.01  # an edge never cuts a pixel off altogether


def solve(readings: np.ndarray, gradients: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return dense depth that agrees with readings and gradients.

    Args:
        readings: (H, W) metres, 0 = none.
        gradients: (2, H, W) of log depth at full size: that of the next pixel to the right, then below, minus that of
            the pixel.
        edges: (H, W) in [0, 1], how probable an occlusion boundary is: gradients count less there.

    Returns:
        (H, W) float32 metres.

    Raises:
        ValueError: for maps that do not fit each other, or no reading.
    """
    height, width = readings.shape
    if gradients.shape != (2, height, width) or edges.shape != (height, width):
        raise ValueError(
            f"expected gradients (2, {height}, {width}) and edges of that size, got {gradients.shape} and {edges.shape}"
        )
    if not (readings > 0).any():
        raise ValueError("no reading to solve from; at least one is needed")
    h, w = height // DIVISOR, width // DIVISOR
    blocks = readings[: h * DIVISOR, : w * DIVISOR].reshape(h, DIVISOR, w, DIVISOR)
    count = (blocks > 0).sum(axis=(1, 3))
    known = np.where(count, blocks.sum(axis=(1, 3)) / np.maximum(count, 1), 0)  # the mean of a block's readings
    gx, gy = (_between_blocks(g, axis) for g, axis in zip(gradients, (1, 0), strict=True))
    cut = edges[: h * DIVISOR, : w * DIVISOR].reshape(h, DIVISOR, w, DIVISOR).max(axis=(1, 3))  # thin edges count
    trust = np.maximum(1 - cut, LEAST)
    index = np.arange(h * w).reshape(h, w)
    at = index[known > 0]
    read = sparse.csr_matrix((np.ones(len(at)), (np.arange(len(at)), at)), (len(at), h * w))
    rows = [(read, np.log(known[known > 0]))]
    pairs = ((index[:, :-1], index[:, 1:], gx[:, :-1], trust[:, :-1]), (index[:-1], index[1:], gy[:-1], trust[:-1]))
    for here, there, step, weight in pairs:
        root, n = np.sqrt(FOLLOW * weight.ravel()), here.size
        lines = np.tile(np.arange(n), 2)
        values = np.concatenate([-root, root])
        matrix = sparse.csr_matrix((values, (lines, np.concatenate([here.ravel(), there.ravel()]))), (n, h * w))
        rows.append((matrix, root * step.ravel()))
    a, b = sparse.vstack([m for m, _ in rows]), np.concatenate([v for _, v in rows])
    log = spsolve((a.T @ a).tocsc(), a.T @ b).reshape(h, w)
    return cv2.resize(np.exp(log).astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)


def _between_blocks(gradient: np.ndarray, axis: int) -> np.ndarray:
    """Return what the mean of the next block of 2x2 pixels lies above that of each block, (H/2, W/2).

    From block to block it is two pixels for either line of a block: (g0 + g1 + g1 + g2) / 2.
    """
    ends = np.take(gradient, [-1], axis)
    following = np.concatenate([np.delete(gradient, 0, axis), ends], axis)
    h, w = (n // DIVISOR * DIVISOR for n in gradient.shape)
    blocks = (gradient + following)[:h, :w].reshape(h // 2, 2, w // 2, 2)
    return blocks.sum(axis=(1, 3)) / 4
