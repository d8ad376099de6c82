"""The exercises' checkers: each prints a check mark, or a cross with the reason, and never raises.

A checker runs the learner's function beside the reference. Where the two differ it also runs the mistakes that people
make there; the one that gives the learner's result is named. Later cells use the reference, so an unsolved notebook
still runs to its end.
"""

import numpy as np

from ..camera import Camera
from .checker import Function, check


def check_disparity_to_depth(attempt: Function) -> bool:
    """Check ``attempt(disparity_px, fx, baseline_m) -> depth_m``, z = fx B / d, where d <= 0 means missing, 0."""

    def right(d, fx, b):
        return np.where(d > 0, fx * b / np.where(d > 0, d, 1), 0)

    disparity = np.array([[30.0, 0.0, 12.5], [60.0, 0.5, -1.0]])
    mistakes = {
        "missing pixels (disparity <= 0) should become 0, not infinite or negative": lambda d, fx, b: fx * b / d,
        "pixels of negative disparity are missing too: matchers mark failure by -1": lambda d, fx, b: np.where(
            d == 0, 0, fx * b / d
        ),
        "every disparity above 0 counts, less than a pixel too": lambda d, fx, b: right(np.where(d < 1, 0, d), fx, b),
        "that is millimetres; the depth is wanted in metres": lambda d, fx, b: 1000 * right(d, fx, b),
        "the fraction is upside down: depth is fx B / d": lambda d, fx, b: np.where(d > 0, d / (fx * b), 0),
        "the baseline is left out": lambda d, fx, b: right(d, fx, 1),
        "the focal length is left out": lambda d, fx, b: right(d, 1, b),
    }
    return check(
        "disparity to depth", attempt, right, [(disparity, 600.0, 0.05), (disparity.T, 450.0, 0.055)], mistakes
    )


def check_rmse(attempt: Function) -> bool:
    """Check ``attempt(pred, gt) -> float``, Eq. 4 over the pixels with ground truth (gt > 0)."""

    def right(pred, gt):
        from ..metrics import rmse

        return rmse(pred, gt)

    def differences(pred, gt):
        return (pred - gt)[gt > 0].astype(np.float64)

    rng = np.random.default_rng(4)
    pred = rng.uniform(0.4, 0.9, (2, 6, 8)).astype(np.float32)
    gt = np.where(rng.random((2, 6, 8)) < 0.3, 0, pred + rng.normal(0, 0.03, (2, 6, 8))).astype(np.float32)
    mistakes = {
        "the square root is missing": lambda p, g: np.mean(differences(p, g) ** 2),
        "missing ground truth (0) is counted as an error": lambda p, g: np.sqrt(np.mean((p - g) ** 2)),
        "the sum over valid pixels is divided by all H W pixels": lambda p, g: np.sqrt(
            np.sum(differences(p, g) ** 2) / g.size
        ),
        "that is the mean absolute error: square before averaging, root after": lambda p, g: np.mean(
            np.abs(differences(p, g))
        ),
        "that is millimetres; metres are wanted": lambda p, g: 1000 * right(p, g),
        "the mean is missing: that is the root of the summed squares": lambda p, g: np.sqrt(
            np.sum(differences(p, g) ** 2)
        ),
        "the mean error is subtracted: that is the standard deviation": lambda p, g: np.std(differences(p, g)),
    }
    return check("RMSE", attempt, right, list(zip(pred, gt, strict=True)), mistakes, rtol=1e-4)


def check_compose(attempt: Function) -> bool:
    """Check ``attempt(depth, optical, geometric, region) -> depth``, what each pixel of the output is taken from (S9).

    Inside the region the optical branch, where depth is missing outside it the geometric branch, and everywhere else
    the depth as it came, bit for bit.
    """

    def right(depth, optical, geometric, region):
        return np.where(region, optical, np.where(depth == 0, geometric, depth))

    rng = np.random.default_rng(9)
    depth, optical, geometric = rng.uniform(0.4, 0.9, (3, 6, 8)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = 0
    region = np.zeros(depth.shape, dtype=bool)
    region[2:5, 2:6] = True
    mistakes = {
        "the two branches are swapped": lambda d, o, g, r: right(d, g, o, r),
        "the region is inverted": lambda d, o, g, r: right(d, o, g, ~r),
        "readings inside the region are kept; they must be re-estimated": lambda d, o, g, r: np.where(
            d > 0, d, np.where(r, o, g)
        ),
        "valid readings outside the region are replaced; they must stay": lambda d, o, g, r: np.where(r, o, g),
        "holes outside the region stay 0": lambda d, o, g, r: np.where(r, o, d),
        "holes outside the region are filled from the optical branch": lambda d, o, g, r: right(d, o, o, r),
        "holes inside the region are filled from the geometric branch": lambda d, o, g, r: np.where(
            d == 0, g, np.where(r, o, d)
        ),
    }
    return check("composition", attempt, right, [(depth, optical, geometric, region)], mistakes, rtol=0)


def check_unproject(attempt: Function) -> bool:
    """Check ``attempt(u, v, z, camera) -> (x, y, z)``: the 3-D point, in metres, of the pixel in column u and row v."""

    def right(u, v, z, camera):
        from ..camera import unproject

        depth = np.zeros((camera.height, camera.width))
        depth[v, u] = z
        return unproject(depth, camera)[0]

    def swapped(u, v, z, c):
        return np.array([(v - c.cx) * z / c.fx, (u - c.cy) * z / c.fy, z])

    camera = Camera(fx=92.0, fy=88.0, cx=64.2, cy=35.9, width=128, height=72)
    pixels = [(100, 12, 0.62, camera), (3, 60, 1.4, camera)]
    mistakes = {
        "u and v are swapped: u is the column and goes with cx and fx, v the row": swapped,
        "x and y are swapped": lambda u, v, z, c: right(u, v, z, c)[[1, 0, 2]],
        "the principal point is left out: subtract cx and cy": lambda u, v, z, c: np.array(
            [u * z / c.fx, v * z / c.fy, z]
        ),
        "the depth is left out of x and y": lambda u, v, z, c: np.array([(u - c.cx) / c.fx, (v - c.cy) / c.fy, z]),
        "fx is used for both axes": lambda u, v, z, c: np.array([(u - c.cx) * z / c.fx, (v - c.cy) * z / c.fx, z]),
        "that is millimetres; metres are wanted": lambda u, v, z, c: 1000 * right(u, v, z, c),
        "y points down, as the rows do: no minus sign": lambda u, v, z, c: right(u, v, z, c) * [1, -1, 1],
        "z is depth along the optical axis, not distance along the ray": lambda u, v, z, c: (
            right(u, v, z, c) * (z / np.linalg.norm(right(u, v, z, c)))
        ),
    }
    return check("unprojection", attempt, right, pixels, mistakes)


def check_shadow_width(attempt: Function) -> bool:
    """Check ``attempt(z_near, z_far, baseline_m, fx) -> px``, the width of a parallax shadow: fx B (1/near - 1/far)."""

    def right(near, far, baseline, fx):
        from ..camera import shadow_width_px

        return shadow_width_px(near, far, baseline, fx)

    mistakes = {
        "that is negative: the nearer surface moves further, 1/near - 1/far": lambda n, f, b, fx: -right(n, f, b, fx),
        "the baseline is taken in millimetres; it comes in metres": lambda n, f, b, fx: 1000 * right(n, f, b, fx),
        "the baseline is divided by 1000; it comes in metres already": lambda n, f, b, fx: right(n, f, b, fx) / 1000,
        "take the difference of the inverse depths, not the inverse of their difference": lambda n, f, b, fx: (
            fx * b / (f - n)
        ),
        "shifts go with 1/z: take the difference of the inverse depths": lambda n, f, b, fx: fx * b * (f - n),
        "the focal length is left out, so that is not pixels": lambda n, f, b, fx: right(n, f, b, 1),
        "that is the shift of the near surface alone; subtract the far one's": lambda n, f, b, fx: fx * b / n,
        "the two shifts are added; the shadow is their difference": lambda n, f, b, fx: fx * b * (1 / n + 1 / f),
    }
    return check("shadow width", attempt, right, [(0.5, 0.8, 0.05, 600.0), (0.4, 1.2, 0.015, 460.0)], mistakes)
