"""Checkers of the exercises on one's own camera: units, intrinsics, alignment, and how two kinds of sensor err."""

from types import SimpleNamespace

import numpy as np

from ..camera import Camera
from ..units import clean_depth
from .checker import Function, check

RNG = np.random.default_rng(9)
RAW = RNG.integers(200, 3000, (4, 6)).astype(np.uint16)
RAW[0, :2], RAW[3, 5] = 0, 65535


def check_to_metres(attempt: Function) -> bool:
    """Check ``attempt(raw, scale) -> (H, W) float32 metres``: uint16 units to metres, 0 and 65535 being no reading.

    ``raw`` is (H, W) uint16 and must not change; ``scale`` is a Python float, metres per unit.
    """

    def right(raw, scale):
        return np.where((raw == 0) | (raw == 65535), 0, raw * scale).astype(np.float32)

    mistakes = {
        "the unit is not applied: multiply by the scale": lambda raw, scale: right(raw, 1.0),
        "divide by the scale? A reading of 1 is `scale` metres: multiply": lambda raw, scale: np.where(
            right(raw, scale) > 0, raw / scale, 0
        ).astype(np.float32),
        "the result is in millimetres, whatever the camera: use the scale that is given": lambda raw, scale: right(
            raw, 0.001
        ),
        "65535 is a code for 'no reading', not a distance: set it to 0": lambda raw, scale: (raw * scale).astype(
            np.float32
        ),
        "missing readings became NaN; 0 means missing here": lambda raw, scale: np.where(
            right(raw, scale) > 0, right(raw, scale), np.nan
        ).astype(np.float32),
        "it overflowed: make the numbers floating-point before you multiply": lambda raw, scale: (
            (raw * np.uint16(round(scale * 1e4))) / np.float32(1e4)
        ).astype(np.float32),
    }
    cases = [(RAW, 0.001), (RAW, 0.00025), (RAW, 0.0001)]
    return check("to metres", attempt, right, cases, mistakes, dtype=True)


def check_resized_camera(attempt: Function) -> bool:
    """Check ``attempt(camera, width, height) -> (fx, fy, cx, cy)`` of the picture resized to width x height."""

    def right(c, width, height):
        new = Camera(c.fx, c.fy, c.cx, c.cy, c.width, c.height).resized(width, height)
        return new.fx, new.fy, new.cx, new.cy

    def scales(c, width, height):
        return width / c.width, height / c.height

    def plain(c, width, height):
        sx, sy = scales(c, width, height)
        return c.fx * sx, c.fy * sy, c.cx * sx, c.cy * sy

    mistakes = {
        "pixel centres are whole numbers, so the picture begins at -0.5: add 0.5, scale, take 0.5 away": plain,
        "the signs are exchanged: add 0.5, scale, take 0.5 away": lambda c, w, h: (
            *right(c, w, h)[:2],
            (c.cx - 0.5) * w / c.width + 0.5,
            (c.cy - 0.5) * h / c.height + 0.5,
        ),
        "the half pixel is added but not taken away again": lambda c, w, h: (
            *right(c, w, h)[:2],
            *(x + 0.5 for x in right(c, w, h)[2:]),
        ),
        "the focal length scales with the picture, too": lambda c, w, h: (c.fx, c.fy, *right(c, w, h)[2:]),
        "x goes with the width and y with the height: they are swapped": lambda c, w, h: right(
            SimpleNamespace(fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy, width=c.height, height=c.width), w, h
        ),
        "the scale is upside down: new size over old": lambda c, w, h: (
            c.fx * c.width / w,
            c.fy * c.height / h,
            (c.cx + 0.5) * c.width / w - 0.5,
            (c.cy + 0.5) * c.height / h - 0.5,
        ),
        "one scale for both axes: width and height were not scaled alike": lambda c, w, h: right(
            c, w, round(c.height * w / c.width)
        ),
        "the principal point is not always the middle of the picture": lambda c, w, h: (
            *right(c, w, h)[:2],
            (w - 1) / 2,
            (h - 1) / 2,
        ),
    }
    cases = [(Camera(610.0, 612.0, 322.5, 236.0, 640, 480), 320, 180)]
    cases.append((Camera(921.0, 921.0, 642.0, 359.0, 1280, 720), 256, 288))
    return check("camera of a resized picture", attempt, right, cases, mistakes)


def check_align(attempt: Function) -> bool:
    """Check ``attempt(u, v, z, depth_camera, colour_camera, t) -> (u, v, z)`` in the colour picture.

    Both cameras look the same way; ``t`` (3,) metres is added to a point's coordinates in the depth camera's frame to
    give those in the colour camera's.
    """

    def right(u, v, z, a, b, t):
        x, y = (u - a.cx) * z / a.fx + t[0], (v - a.cy) * z / a.fy + t[1]
        z = z + t[2]
        return b.fx * x / z + b.cx, b.fy * y / z + b.cy, z

    mistakes = {
        "the shift between the cameras is missing": lambda u, v, z, a, b, t: right(u, v, z, a, b, 0 * t),
        "the shift has the wrong sign": lambda u, v, z, a, b, t: right(u, v, z, a, b, -t),
        "it uses the depth camera's intrinsics for both pictures": lambda u, v, z, a, b, t: right(u, v, z, a, a, t),
        "it uses the colour camera's intrinsics for both pictures": lambda u, v, z, a, b, t: right(u, v, z, b, b, t),
        "the two cameras are swapped": lambda u, v, z, a, b, t: right(u, v, z, b, a, t),
        "z changes by t[2], too: divide by the new one, and return it": lambda u, v, z, a, b, t: right(
            u, v, z, a, b, t * [1, 1, 0]
        ),
        "divide by the new z, that in the colour camera's frame": lambda u, v, z, a, b, t: (
            b.fx * ((u - a.cx) * z / a.fx + t[0]) / z + b.cx,
            b.fy * ((v - a.cy) * z / a.fy + t[1]) / z + b.cy,
            z + t[2],
        ),
        "the shift is in millimetres; metres are wanted": lambda u, v, z, a, b, t: right(u, v, z, a, b, 1000 * t),
        "u is the column and goes with x, v the row and goes with y: they are swapped": lambda u, v, z, a, b, t: right(
            v, u, z, a, b, t
        ),
        "only the picture's middle was moved: a pixel's shift depends on its depth": lambda u, v, z, a, b, t: (
            u - a.cx + b.cx,
            v - a.cy + b.cy,
            z + t[2],
        ),
    }
    depth_camera = Camera(380.0, 382.0, 318.0, 241.0, 640, 480)
    colour_camera = Camera(612.0, 610.0, 325.5, 236.0, 640, 480)
    cases = [(100.0, 400.0, 0.6, depth_camera, colour_camera, np.array([0.015, -0.001, 0.003]))]
    cases.append((500.0, 120.0, 1.7, colour_camera, depth_camera, np.array([-0.03, 0.002, -0.004])))
    return check("depth into the colour picture", attempt, right, cases, mistakes)


def check_stereo_noise(attempt: Function) -> bool:
    """Check ``attempt(z, fx, baseline_m, disparity_px) -> metres``: what an error in disparity does to z.

    All are numbers. The size of the error is meant, without a sign, to first order: the derivative times the error.
    """

    def right(z, fx, baseline, error):
        return z**2 * error / (fx * baseline)

    mistakes = {
        "noise grows with the square of the distance": lambda z, f, b, e: z * e / (f * b),
        "that is the disparity f B / z, not what its error does": lambda z, f, b, e: f * b / z,
        "the baseline is missing: dimensions must come out as metres": lambda z, f, b, e: z**2 * e / f,
        "the focal length is missing: the error is in pixels": lambda z, f, b, e: z**2 * e / b,
        "a longer baseline gives less noise: divide by it": lambda z, f, b, e: z**2 * e * b / f,
        "the result is in millimetres; metres are wanted": lambda z, f, b, e: 1000 * right(z, f, b, e),
        "that is the variance": lambda z, f, b, e: right(z, f, b, e) ** 2,
        "the size is wanted: leave the minus sign of the derivative out": lambda z, f, b, e: -right(z, f, b, e),
        "that is the exact difference; to first order it is the derivative times the error": lambda z, f, b, e: (
            f * b / (f * b / z - e) - z
        ),
    }
    cases = [(0.6, 450.0, 0.05, 0.1), (3.0, 450.0, 0.05, 0.1), (1.5, 670.0, 0.055, 0.2)]
    return check("stereo noise", attempt, right, cases, mistakes)


def check_through_glass(attempt: Function) -> bool:
    """Check ``attempt(behind_m, glass_m, ior) -> metres`` that a clock reports for a surface seen through glass.

    ``behind_m`` is the distance of that surface, ``glass_m`` the part of the way, once, that runs inside glass.
    """

    def right(behind, glass, ior):
        return behind + (ior - 1) * glass

    mistakes = {
        "out and back are both slower, but the camera halves the time: count the glass once": lambda d, g, n: (
            d + 2 * (n - 1) * g
        ),
        "the glass is part of the way already: only (n - 1) times it comes on top": lambda d, g, n: d + n * g,
        "light is slower in glass, so the surface reads farther": lambda d, g, n: d - (n - 1) * g,
        "in glass light takes n times as long, not 1 / n": lambda d, g, n: d + (1 / n - 1) * g,
        "only the way inside the glass is slower": lambda d, g, n: n * d,
        "the glass delays the light; that is the bare distance": lambda d, g, n: d,
        "the way back is delayed as well: half of both delays is the whole of one": lambda d, g, n: d + (n - 1) * g / 2,
        "the camera takes half of the way out and back": lambda d, g, n: 2 * right(d, g, n),
        "that is the delay alone: add it to the distance": lambda d, g, n: (n - 1) * g,
    }
    cases = [(0.7, 0.012, 1.5), (1.2, 0.004, 1.33)]
    return check("through glass", attempt, right, cases, mistakes)


def check_fill_share(attempt: Function) -> bool:
    """Check ``attempt(raw, completed, region) -> (kept, inside, holes)``, three shares of all pixels, in this order.

    ``kept``: readings outside the region that were returned as they were; ``inside``: pixels of the region, whatever
    their value; ``holes``: pixels outside it without a reading. Readings outside that changed count in none of them.
    """

    def right(raw, completed, region):
        kept = ~region & (raw > 0) & (completed == raw)
        return kept.mean(), region.mean(), (~region & (raw == 0)).mean()

    region = np.zeros((8, 10), bool)
    region[2:5, 3:8] = True
    rng = np.random.default_rng(9)
    raw = clean_depth(rng.uniform(0.4, 0.9, region.shape))
    raw[rng.random(raw.shape) < 0.3] = 0
    completed = np.where(region | (raw == 0), np.float32(0.55), raw)
    completed[3, 3:6] = raw[3, 3:6] = np.float32(0.62)  # estimated anew, with the same result
    adjusted = completed.copy()
    adjusted[6, :4] += np.float32(0.01) * (raw[6, :4] > 0)  # readings outside that were allowed to change
    mistakes = {
        "a pixel inside the region is not kept, even where its value did not change": lambda r, c, m: (
            ((r > 0) & (c == r)).mean(),
            *right(r, c, m)[1:],
        ),
        "readings outside that have changed are not kept: compare with `completed`": lambda r, c, m: (
            (~m & (r > 0)).mean(),
            *right(r, c, m)[1:],
        ),
        "the order is kept, inside, holes": lambda r, c, m: right(r, c, m)[::-1],
        "missing pixels count as kept": lambda r, c, m: ((~m).mean(), m.mean(), (~m & (r == 0)).mean()),
        "holes inside the region belong to the region": lambda r, c, m: (right(r, c, m)[0], m.mean(), (r == 0).mean()),
        "those are per cent; shares are wanted": lambda r, c, m: tuple(100 * x for x in right(r, c, m)),
        "those are pixel counts; divide by the number of pixels": lambda r, c, m: tuple(
            x * r.size for x in right(r, c, m)
        ),
        "readings inside the region are not kept: they are estimated again": lambda r, c, m: (
            (r > 0).mean(),
            m.mean(),
            (~m & (r == 0)).mean(),
        ),
        "the region is inverted": lambda r, c, m: right(r, c, ~m),
        "each is a share of all pixels, not of the readings": lambda r, c, m: (
            right(r, c, m)[0] / (r > 0).mean(),
            *right(r, c, m)[1:],
        ),
        "each is a share of all pixels, not of those outside the region": lambda r, c, m: (
            right(r, c, m)[0] / (~m).mean(),
            m.mean(),
            right(r, c, m)[2] / (~m).mean(),
        ),
    }
    cases = [(raw, completed, region), (raw, adjusted, region)]
    return check("what happened to the pixels", attempt, right, cases, mistakes)
