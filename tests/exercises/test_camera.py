"""The right answer passes; every planted mistake fails with a message that names it."""

import numpy as np
from checker_cases import checker_tests

from ditr_lite.exercises import camera as checks


def to_metres(raw, scale):
    metres = raw.astype(np.float64) * scale
    metres[raw == 65535] = 0
    return metres.astype(np.float32)


def resized(c, width, height):
    sx, sy = width / c.width, height / c.height
    return c.fx * sx, c.fy * sy, (c.cx + 0.5) * sx - 0.5, (c.cy + 0.5) * sy - 0.5


def align(u, v, z, a, b, t):
    point = np.array([(u - a.cx) * z / a.fx, (v - a.cy) * z / a.fy, z]) + t
    return b.fx * point[0] / point[2] + b.cx, b.fy * point[1] / point[2] + b.cy, point[2]


def noise(z, fx, baseline, error):
    return error * z * z / fx / baseline


def glass(behind, thick, ior):
    return behind - thick + ior * thick


def shares(raw, completed, region):
    kept = (completed == raw) & (raw > 0) & ~region
    return kept.mean(), region.mean(), ((raw == 0) & ~region).mean()


RIGHT = {
    checks.check_to_metres: to_metres,
    checks.check_resized_camera: resized,
    checks.check_align: align,
    checks.check_stereo_noise: noise,
    checks.check_through_glass: glass,
    checks.check_fill_share: shares,
}


def in_place(raw, scale):
    raw[raw == 65535] = 0
    return (raw * scale).astype(np.float32)


MISTAKES = [
    (checks.check_to_metres, lambda r, s: (r * s).astype(np.float32), "65535 is a code"),
    (checks.check_to_metres, lambda r, s: to_metres(r, 1), "multiply by the scale"),
    (checks.check_to_metres, lambda r, s: to_metres(r, 0.001), "whatever the camera"),
    (checks.check_to_metres, lambda r, s: to_metres(r, 1 / s), "`scale` metres"),
    (checks.check_to_metres, lambda r, s: np.where(to_metres(r, s) > 0, to_metres(r, s), np.nan), "NaN"),
    (checks.check_to_metres, in_place, "changes its input"),
    (checks.check_to_metres, lambda r, s: to_metres(r, s).astype(np.float64), "should be float32, got float64"),
    (checks.check_to_metres, lambda r, s: np.where(r == 65535, 0, r * s), "should be float32, got float64"),
    (checks.check_to_metres, lambda r, s: to_metres(r, s)[None], "shape"),
    (checks.check_resized_camera, lambda c, w, h: tuple(x * w / c.width for x in (c.fx, c.fy, c.cx, c.cy)), "differ"),
    (
        checks.check_resized_camera,
        lambda c, w, h: (c.fx * w / c.width, c.fy * h / c.height, c.cx * w / c.width, c.cy * h / c.height),
        "begins at -0.5",
    ),
    (
        checks.check_resized_camera,
        lambda c, w, h: (*resized(c, w, h)[:2], (c.cx - 0.5) * w / c.width + 0.5, (c.cy - 0.5) * h / c.height + 0.5),
        "signs are exchanged",
    ),
    (checks.check_resized_camera, lambda c, w, h: (c.fx, c.fy, *resized(c, w, h)[2:]), "focal length scales"),
    (checks.check_resized_camera, lambda c, w, h: resized(c, w, c.height * w / c.width), "one scale"),
    (checks.check_resized_camera, lambda c, w, h: (*resized(c, w, h)[:2], w / 2 - 0.5, h / 2 - 0.5), "middle"),
    (
        checks.check_resized_camera,
        lambda c, w, h: (*resized(c, w, h)[:2], resized(c, w, h)[2] + 0.5, resized(c, w, h)[3] + 0.5),
        "not taken away",
    ),
    (checks.check_align, lambda u, v, z, a, b, t: align(u, v, z, a, b, 0 * t), "is missing"),
    (checks.check_align, lambda u, v, z, a, b, t: align(u, v, z, a, b, -t), "wrong sign"),
    (checks.check_align, lambda u, v, z, a, b, t: align(u, v, z, a, a, t), "depth camera's intrinsics"),
    (checks.check_align, lambda u, v, z, a, b, t: align(u, v, z, b, b, t), "colour camera's intrinsics"),
    (checks.check_align, lambda u, v, z, a, b, t: align(u, v, z, b, a, t), "swapped"),
    (checks.check_align, lambda u, v, z, a, b, t: align(u, v, z, a, b, t * [1, 1, 0]), "z changes by t[2]"),
    (checks.check_align, lambda u, v, z, a, b, t: align(u, v, z, a, b, 1000 * t), "millimetres"),
    (checks.check_align, lambda u, v, z, a, b, t: align(v, u, z, a, b, t), "u is the column"),
    (checks.check_align, lambda u, v, z, a, b, t: (u - a.cx + b.cx, v - a.cy + b.cy, z + t[2]), "depends on its depth"),
    (checks.check_stereo_noise, lambda z, f, b, e: z * e / (f * b), "square of the distance"),
    (checks.check_stereo_noise, lambda z, f, b, e: f * b / z, "disparity f B / z"),
    (checks.check_stereo_noise, lambda z, f, b, e: z**2 * e / f, "baseline is missing"),
    (checks.check_stereo_noise, lambda z, f, b, e: z**2 * e / b, "focal length is missing"),
    (checks.check_stereo_noise, lambda z, f, b, e: z**2 * e * b / f, "longer baseline"),
    (checks.check_stereo_noise, lambda z, f, b, e: 1000 * noise(z, f, b, e), "millimetres"),
    (checks.check_stereo_noise, lambda z, f, b, e: -noise(z, f, b, e), "minus sign"),
    (checks.check_stereo_noise, lambda z, f, b, e: f * b / (f * b / z - e) - z, "exact difference"),
    (checks.check_stereo_noise, lambda z, f, b, e: noise(z, f, b, e) ** 2, "variance"),
    (checks.check_through_glass, lambda d, g, n: d + 2 * (n - 1) * g, "halves the time"),
    (checks.check_through_glass, lambda d, g, n: d + n * g, "(n - 1)"),
    (checks.check_through_glass, lambda d, g, n: d - (n - 1) * g, "reads farther"),
    (checks.check_through_glass, lambda d, g, n: n * d, "only the way inside"),
    (checks.check_through_glass, lambda d, g, n: d - g + g / n, "not 1 / n"),
    (checks.check_through_glass, lambda d, g, n: d + (n - 1) * g / 2, "the way back is delayed"),
    (checks.check_through_glass, lambda d, g, n: 2 * (d - g) + 2 * n * g, "half of the way out and back"),
    (checks.check_through_glass, lambda d, g, n: d, "bare distance"),
    (checks.check_through_glass, lambda d, g, n: (n - 1) * g, "delay alone"),
    (checks.check_fill_share, lambda r, c, m: (shares(r, c, m)[0], m.mean(), (r == 0).mean()), "belong to the region"),
    (checks.check_fill_share, lambda r, c, m: ((~m).mean(), *shares(r, c, m)[1:]), "missing pixels count"),
    (checks.check_fill_share, lambda r, c, m: tuple(100 * x for x in shares(r, c, m)), "per cent"),
    (checks.check_fill_share, lambda r, c, m: tuple(80 * x for x in shares(r, c, m)), "pixel counts"),
    (checks.check_fill_share, lambda r, c, m: ((r > 0).mean(), *shares(r, c, m)[1:]), "not kept"),
    (checks.check_fill_share, lambda r, c, m: shares(r, c, ~m), "inverted"),
    (checks.check_fill_share, lambda r, c, m: ((c == r).mean(), *shares(r, c, m)[1:]), "even where its value"),
    (
        checks.check_fill_share,
        lambda r, c, m: ((~m & (r > 0)).mean(), *shares(r, c, m)[1:]),
        "compare with `completed`",
    ),
    (
        checks.check_fill_share,
        lambda r, c, m: (shares(r, c, m)[0] * r.size / (r > 0).sum(), *shares(r, c, m)[1:]),
        "not of the readings",
    ),
    (
        checks.check_fill_share,
        lambda r, c, m: ((c == r)[~m & (r > 0)].sum() / (~m).sum(), m.mean(), (r == 0)[~m].mean()),
        "not of those outside",
    ),
    (checks.check_fill_share, lambda r, c, m: shares(r, c, m)[::-1], "the order is"),
]


(
    test_the_right_answer_passes,
    test_a_planted_mistake_is_named,
    test_a_stub_is_not_a_failure_of_the_notebook,
    test_every_checker_is_tested,
) = checker_tests(checks, RIGHT, MISTAKES)
