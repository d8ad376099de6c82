"""Checkers of the exercises on depth loss: each prints a check mark, or a cross with the reason, and never raises."""

import numpy as np

from ..camera import shadow_width_px
from ..loss_types import label, partition
from ..studies.loss_estimate import confusion
from .checker import Function, check


def check_match(attempt: Function) -> bool:
    """Check ``attempt(left, right, row, column, half, largest) -> int``, the disparity of one pixel by block matching.

    The window of ``2 * half + 1`` pixels a side around (row, column) of ``left``, (H, W) uint8, is compared with the
    windows of ``right`` that lie 0 to ``largest`` columns further left, both included; the smallest sum of absolute
    differences wins (squared ones decide alike), of equal ones the smallest disparity.
    """

    def right_answer(*case, **how):
        return int(_costs(*case, **how).argmin())

    def instead(**how):
        return lambda *case: right_answer(*case, **how)

    def with_window(change):
        return lambda *c: right_answer(*c[:4], change(c[4]), c[5])

    def last_of_equals(*case):
        return case[5] - int(_costs(*case)[::-1].argmin())

    def row_alone(left, right, row, column, half, largest):
        return right_answer(left[row][None], right[row][None], 0, column, half, largest)

    cases = _matching_cases()
    mistakes = {
        "disparity 0 takes part: count from 0, range(largest + 1)": lambda *c: 1 + int(_costs(*c)[1:].argmin()),
        "of equal costs the smallest disparity counts: compare with <, not with <=": last_of_equals,
        "one row is not enough: the window is 2 * half + 1 rows high, too": row_alone,
        "`largest` is a disparity, too: range(largest) stops one before it, write range(largest + 1)": lambda *c: (
            right_answer(*c[:5], c[5] - 1)
        ),
        "the window is too large: it reaches `half` pixels to each side, 2 * half + 1 is its whole side": with_window(
            lambda h: 2 * h
        ),
        "the window misses its last row and column: a slice ends before its second number, + half + 1": instead(end=0),
        "uint8 differences wrap around (2 - 3 = 255): convert to float or int first": instead(
            cost=lambda a, b: np.abs(a - b).sum()
        ),
        "the match lies further left in the right image: column - d, not column + d": instead(step=1),
        "that is the worst match: the smallest cost wins": lambda *c: int(_costs(*c).argmax()),
        "that is the smallest cost itself; the disparity is where it occurs": lambda *c: _costs(*c).min(),
        "that is the column of the match; the disparity is the shift": lambda *c: c[3] - right_answer(*c),
        "one pixel is not enough: compare the whole window": with_window(lambda h: 0),
        "disparities start at 0: the result is one too large": lambda *c: right_answer(*c) + 1,
        "the differences cancel: take absolute values before the sum": instead(
            cost=lambda a, b: (a.astype(float) - b).sum()
        ),
    }
    return check("block matching", attempt, right_answer, cases, mistakes)


def _absolute(a: np.ndarray, b: np.ndarray) -> float:
    return np.abs(a.astype(float) - b).sum()


def _costs(left, right, row, column, half, largest, step=-1, end=1, cost=_absolute) -> np.ndarray:
    """Return the cost of every disparity, (largest + 1,); the last three are what a mistake may have otherwise."""
    rows, columns = slice(row - half, row + half + end), np.arange(column - half, column + half + end)
    return np.array([cost(left[rows, columns], right[rows, columns + step * d]) for d in range(largest + 1)])


def _matching_cases() -> list[tuple]:
    """Return arguments of the block matching: shifts from 0 to the largest, a tie, and what the window decides."""
    rng = np.random.default_rng(3)
    cases = []
    for d in (0, 5, 9, 16):
        left = rng.integers(0, 256, (24, 60)).astype(np.uint8)
        cases.append((left, _shifted(left, d, 60, rng), 12, 34, 3, 16))
    # only the window itself lies 4 columns further left, all around it 13
    left = rng.integers(0, 256, (24, 70)).astype(np.uint8)
    right = _shifted(left, 13, 60, rng)
    right[9:16, 34 - 4 - 3 : 34 - 4 + 4] = left[9:16, 31:38]
    cases.append((left, right, 12, 34, 3, 16))
    # all but the window's last row and column is found at 2 as well
    right = _shifted(left, 6, 0, rng)
    right[11:13, 34 - 2 - 1 : 34 - 2 + 1] = left[11:13, 33:35]
    cases.append((left, right, 12, 34, 1, 9))
    # the window's middle row is found at 1 as well
    right = _shifted(left, 6, 0, rng)
    right[12, 34 - 1 - 2 : 34 - 1 + 3] = left[12, 32:37]
    cases.append((left, right, 12, 34, 2, 9))
    # the whole window is found at 3 and at 10
    right = _shifted(left, 10, 0, rng)
    right[10:15, 34 - 3 - 2 : 34 - 3 + 3] = left[10:15, 32:37]
    cases.append((left, right, 12, 34, 2, 12))
    return cases


def _shifted(left: np.ndarray, d: int, noise: int, rng: np.random.Generator) -> np.ndarray:
    """Return a right picture in which what lies in column u of ``left`` lies in column u - d, with noise."""
    image = rng.integers(0, 256, left.shape)
    image[:, : left.shape[1] - d] = left[:, d:]
    return np.clip(image + rng.integers(-noise, noise + 1, left.shape), 0, 255).astype(np.uint8)


def check_refract(attempt: Function) -> bool:
    """Check ``attempt(angle_deg, n_from, n_to) -> angle_deg``, Snell's law; NaN where all light is reflected."""

    def right(angle, n_from, n_to):
        return np.rad2deg(np.arcsin(n_from / n_to * np.sin(np.deg2rad(angle))))

    mistakes = {
        "the indices are swapped: n_from sin(angle_from) = n_to sin(angle_to)": lambda a, n, m: right(a, m, n),
        "the result is in radians; degrees are wanted": lambda a, n, m: np.deg2rad(right(a, n, m)),
        "NumPy's sine takes radians: convert the angle first": lambda a, n, m: np.rad2deg(
            np.arcsin(n / m * np.sin(np.float64(a)))
        ),
        "the sines are left out: that holds for small angles only": lambda a, n, m: n / m * np.asarray(a),
        "that is the sine; its arcsine is the angle": lambda a, n, m: n / m * np.sin(np.deg2rad(a)),
        "that is the mirrored ray: it leaves at the angle at which it came": lambda a, n, m: np.asarray(a) * 1.0,
        "beyond the critical angle no ray leaves: NaN there, not 90 degrees": lambda a, n, m: np.rad2deg(
            np.arcsin(np.minimum(n / m * np.sin(np.deg2rad(a)), 1))
        ),
    }
    angles = np.array([0.0, 20.0, 50.0, 80.0])
    return check("refraction", attempt, right, [(angles, 1.0, 1.5), (angles, 1.5, 1.0)], mistakes)


def check_label(attempt: Function) -> bool:
    """Check ``attempt(depth, depth_gt, region) -> codes``, 0 to 5 as in ``LossType``; all truth is known here.

    Wrong means off by more than 10 mm *and* by more than 2 % of the truth, that is by more than the larger of the two.
    """

    def made(d, g, r, limit):
        wrong = np.abs(d - g) > limit(g)
        return np.where(d == 0, 2, wrong) + 3 * r

    def larger(g):
        return np.maximum(0.010, 0.02 * g)

    def right(d, g, r):
        return label(d, g, r).astype(int)

    mistakes = {
        "missing pixels (0) are called wrong: test for them first": lambda d, g, r: (np.abs(d - g) > larger(g)) + 3 * r,
        "both thresholds must be passed, so the larger one counts": lambda d, g, r: made(
            d, g, r, lambda g: np.minimum(0.010, 0.02 * g)
        ),
        "the 2 % are left out": lambda d, g, r: made(d, g, r, lambda g: 0.010),
        "the 2 % are of the true depth, not of the reading": lambda d, g, r: made(d, g, r, lambda g: larger(d)),
        "the 10 mm are left out": lambda d, g, r: made(d, g, r, lambda g: 0.02 * g),
        "nothing is ever wrong: in metres 10 mm is 0.010, as a share 2 % is 0.02": lambda d, g, r: made(
            d, g, r, lambda g: np.maximum(10, g)
        ),
        "too near is wrong as well: take the absolute difference": lambda d, g, r: (
            np.where(d == 0, 2, d - g > larger(g)) + 3 * r
        ),
        "inside and outside are swapped: inside the region codes start at 3": lambda d, g, r: made(d, g, ~r, larger),
        "wrong is 1 and missing 2": lambda d, g, r: np.array([0, 2, 1])[made(d, g, r, larger) % 3] + 3 * r,
        "the region is left out": lambda d, g, r: made(d, g, 0 * r, larger),
    }
    rng = np.random.default_rng(5)
    truth = rng.uniform(0.2, 1.5, (16, 20)).astype(np.float32)
    error = rng.choice([0.002, 0.007, 0.013, 0.022, 0.05], truth.shape) * rng.choice([-1, 1], truth.shape)
    error[::5, ::3] = 0.4  # far behind, as through glass
    depth = np.where(rng.random(truth.shape) < 0.2, 0, truth + error).astype(np.float32)
    region = rng.random(truth.shape) < 0.4
    return check("loss types", attempt, right, [(depth, truth, region)], mistakes)


def check_partition(attempt: Function) -> bool:
    """Check ``attempt(depth, region) -> (depth_op, depth_geo)``, the right halves of Eq. 1 and 2; 0 is nothing."""

    def right(d, r):
        parts = partition(np.zeros((*d.shape, 3), np.uint8), d, r)
        return parts.depth_op, parts.depth_geo

    def zero(keep, d):
        return np.where(keep, d, 0)

    mistakes = {
        "the two parts are swapped: the optical one lies inside the region": lambda d, r: right(d, r)[::-1],
        "the optical part holds everything: the parts overlap, against Eq. 2": lambda d, r: (d, zero(~r, d)),
        "the geometric part holds everything: the parts overlap, against Eq. 2": lambda d, r: (zero(r, d), d),
        "both parts are the same": lambda d, r: (zero(r, d), zero(r, d)),
        "those are masks; depth is wanted": lambda d, r: (1.0 * r, 1.0 * ~r),
        "the parts are cut short: keep the shape and put 0 elsewhere": lambda d, r: (d[r], d[~r]),
    }
    rng = np.random.default_rng(7)
    depth = rng.uniform(0.4, 0.9, (6, 8)).astype(np.float32)
    region = rng.random(depth.shape) < 0.5
    return check("partition", attempt, right, [(depth, region)], mistakes)


def check_smallest_offset(attempt: Function) -> bool:
    """Check ``attempt(z_near, z_far, fx, width_px) -> metres``: which offset casts a shadow this many pixels wide."""

    def right(near, far, fx, width):
        return width / shadow_width_px(near, far, 1.0, fx)

    mistakes = {
        "the fraction is upside down": lambda n, f, x, w: 1 / right(n, f, x, w),
        "that is millimetres; metres are wanted": lambda n, f, x, w: 1000 * right(n, f, x, w),
        "that is negative: the nearer surface moves further": lambda n, f, x, w: -right(n, f, x, w),
        "the focal length is left out": lambda n, f, x, w: right(n, f, 1, w),
        "take the difference of the inverse depths, not the inverse of their difference": lambda n, f, x, w: (
            w * (f - n) / x
        ),
        "shifts go with 1/z: take the difference of the inverse depths": lambda n, f, x, w: w / (x * (f - n)),
        "that is the shift of the near surface alone; subtract the far one's": lambda n, f, x, w: w * n / x,
        "that is the width of the shadow, not the offset": lambda n, f, x, w: x * w * (1 / n - 1 / f),
    }
    return check("offset of a shadow", attempt, right, [(0.5, 0.8, 600.0, 3.0), (0.4, 1.2, 260.0, 1.0)], mistakes)


def check_precision_recall(attempt: Function) -> bool:
    """Check ``attempt(truth, guess) -> (precision, recall)`` of two (H, W) bool maps of the same kind of pixel."""

    def right(truth, guess):
        (_, alarms), (misses, hits) = confusion(1 * truth, 1 * guess, range(2))
        return hits / (hits + alarms), hits / (hits + misses)

    mistakes = {
        "the two are swapped: precision asks how many of the *guessed* pixels are true": lambda t, g: right(t, g)[::-1],
        "divide by the guessed or the true pixels, not by all": lambda t, g: (np.mean(t & g), np.mean(t & g)),
        "that is the share of pixels that agree; most are plainly neither": lambda t, g: (
            np.mean(t == g),
            np.mean(t == g),
        ),
        "those are the shares of pixels guessed and true; count the hits": lambda t, g: (g.mean(), t.mean()),
        "that is in per cent; shares of 1 are wanted": lambda t, g: tuple(100 * k for k in right(t, g)),
        "that is intersection over union": lambda t, g: ((t & g).sum() / (t | g).sum(),) * 2,
        "those are scores of the other class: count where both are True": lambda t, g: right(~t, ~g),
    }
    rng = np.random.default_rng(11)
    truth, noise = rng.random((20, 30)) < 0.2, rng.random((20, 30)) < 0.15
    return check("precision and recall", attempt, right, [(truth, truth ^ noise)], mistakes)
