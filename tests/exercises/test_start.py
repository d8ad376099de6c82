"""The right answer passes; every planted mistake fails with a message that names it.

Answers and mistakes are written here as a learner would write them, not taken from the checkers.
"""

import numpy as np
from checker_cases import checker_tests

from ditr_lite.exercises import start as checks


def disparity_to_depth(d, fx, b):
    depth = np.zeros_like(d)
    depth[d > 0] = fx * b / d[d > 0]
    return depth


def rmse(pred, gt):
    valid = gt > 0
    return np.sqrt(np.mean((pred[valid] - gt[valid]) ** 2))


def compose(depth, optical, geometric, region):
    out = depth.copy()
    out[depth == 0] = geometric[depth == 0]
    out[region] = optical[region]
    return out


def unproject(u, v, z, camera):
    return (u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z


def shadow_width(near, far, baseline, fx):
    return fx * baseline / near - fx * baseline / far


RIGHT = {
    checks.check_disparity_to_depth: disparity_to_depth,
    checks.check_rmse: rmse,
    checks.check_compose: compose,
    checks.check_unproject: unproject,
    checks.check_shadow_width: shadow_width,
}


def compose_in_double(depth, optical, geometric, region):
    return compose(depth.astype(np.float64), optical, geometric, region)


def compose_rounding(depth, optical, geometric, region):
    return (np.rint(compose(depth, optical, geometric, region) * 1000) / 1000).astype(np.float32)


def compose_in_place(depth, optical, geometric, region):
    depth[region] = optical[region]
    depth[depth == 0] = geometric[depth == 0]
    return depth


MISTAKES = [
    (checks.check_disparity_to_depth, lambda d, fx, b: fx * b / d, "should become 0"),
    (checks.check_disparity_to_depth, lambda d, fx, b: 1e3 * disparity_to_depth(d, fx, b), "millimetres"),
    (checks.check_disparity_to_depth, lambda d, fx, b: np.maximum(d, 0) / (fx * b), "upside down"),
    (checks.check_disparity_to_depth, lambda d, fx, b: disparity_to_depth(d, fx, 1.0), "baseline"),
    (checks.check_disparity_to_depth, lambda d, fx, b: disparity_to_depth(d, b, 1.0), "focal length"),
    (
        checks.check_disparity_to_depth,
        lambda d, fx, b: np.divide(fx * b, d, out=np.zeros_like(d), where=d != 0),
        "negative disparity",
    ),
    (checks.check_rmse, lambda p, g: rmse(p, g) ** 2, "square root"),
    (checks.check_rmse, lambda p, g: np.sqrt(((p - g) ** 2).mean()), "missing ground truth"),
    (checks.check_rmse, lambda p, g: np.sqrt((((p - g) * (g > 0)) ** 2).mean()), "divided by all"),
    (checks.check_rmse, lambda p, g: np.abs(p - g)[g > 0].mean(), "mean absolute error"),
    (checks.check_rmse, lambda p, g: 1000 * rmse(p, g), "millimetres"),
    (checks.check_rmse, lambda p, g: np.linalg.norm((p - g)[g > 0]), "mean is missing"),
    (checks.check_rmse, lambda p, g: (p - g)[g > 0].std(), "standard deviation"),
    (checks.check_compose, lambda d, o, g, r: compose(d, g, o, r), "branches are swapped"),
    (checks.check_compose, lambda d, o, g, r: compose(d, o, g, ~r), "inverted"),
    (checks.check_compose, lambda d, o, g, r: np.where(d == 0, np.where(r, o, g), d), "readings inside"),
    (checks.check_compose, lambda d, o, g, r: np.where(r, o, g), "valid readings outside"),
    (checks.check_compose, lambda d, o, g, r: np.where(r, o, d), "stay 0"),
    (checks.check_compose, lambda d, o, g, r: compose(d, o, o, r), "from the optical branch"),
    (checks.check_compose, lambda d, o, g, r: np.where(d == 0, g, np.where(r, o, d)), "inside the region are filled"),
    (checks.check_compose, compose_in_double, "should be float32, got float64"),
    (checks.check_compose, compose_rounding, "values differ"),
    (checks.check_compose, compose_in_place, "changes its input"),
    (checks.check_unproject, lambda u, v, z, c: unproject(v, u, z, c), "u and v are swapped"),
    (checks.check_unproject, lambda u, v, z, c: np.array(unproject(u, v, z, c))[[1, 0, 2]], "x and y are swapped"),
    (checks.check_unproject, lambda u, v, z, c: (u * z / c.fx, v * z / c.fy, z), "principal point"),
    (checks.check_unproject, lambda u, v, z, c: ((u - c.cx) / c.fx, (v - c.cy) / c.fy, z), "depth is left out"),
    (checks.check_unproject, lambda u, v, z, c: ((u - c.cx) * z / c.fx, (v - c.cy) * z / c.fx, z), "both axes"),
    (checks.check_unproject, lambda u, v, z, c: unproject(u, v, 1000 * z, c), "millimetres"),
    (checks.check_unproject, lambda u, v, z, c: ((u - c.cx) * z / c.fx, (c.cy - v) * z / c.fy, z), "no minus"),
    (
        checks.check_unproject,
        lambda u, v, z, c: np.array(unproject(u, v, 1, c)) / np.linalg.norm(unproject(u, v, 1, c)) * z,
        "along the ray",
    ),
    (checks.check_shadow_width, lambda n, f, b, fx: shadow_width(f, n, b, fx), "negative"),
    (checks.check_shadow_width, lambda n, f, b, fx: shadow_width(n, f, 1000 * b, fx), "in millimetres"),
    (checks.check_shadow_width, lambda n, f, b, fx: shadow_width(n, f, b / 1000, fx), "metres already"),
    (checks.check_shadow_width, lambda n, f, b, fx: fx * b / (f - n), "inverse of their difference"),
    (checks.check_shadow_width, lambda n, f, b, fx: fx * b * (f - n), "1/z"),
    (checks.check_shadow_width, lambda n, f, b, fx: b / n - b / f, "focal length"),
    (checks.check_shadow_width, lambda n, f, b, fx: fx * b / n, "near surface alone"),
    (checks.check_shadow_width, lambda n, f, b, fx: fx * b / n + fx * b / f, "are added"),
]


(
    test_the_right_answer_passes,
    test_a_planted_mistake_is_named,
    test_a_stub_is_not_a_failure_of_the_notebook,
    test_every_checker_is_tested,
) = checker_tests(checks, RIGHT, MISTAKES)
