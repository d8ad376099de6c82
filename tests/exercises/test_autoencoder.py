"""The right answer passes; every planted mistake fails with a message that names it.

Answers and mistakes are written here as a learner would write them, not taken from the checkers.
"""

import numpy as np
from checker_cases import checker_tests

from ditr_lite.exercises import autoencoder as checks


def conv_size(n, kernel, stride, padding):
    return len(range(-padding, n + padding - kernel + 1, stride))  # every place where the kernel can start


def rate(codes, factor):
    return np.log2(codes) / (factor * factor)


def nearest(vectors, codebook):
    return np.array([min(range(len(codebook)), key=lambda k: np.linalg.norm(v - codebook[k])) for v in vectors])


def straight_through(z, e, y):
    return 2 * (e - y)


def commitment(z, e, beta):
    return beta * 2 * (z - e) / z.size, 2 * (e - z) / z.size


def moving_average(count, total, vectors, index, decay):
    codes = []
    for k in range(len(count)):
        mine = vectors[index == k]
        n = decay * count[k] + (1 - decay) * len(mine)
        codes.append((decay * total[k] + (1 - decay) * mine.sum(axis=0)) / n)
    return np.array(codes)


def perplexity(counts):
    p = [c / sum(counts) for c in counts if c]
    return np.prod([x**-x for x in p])


def calibrate(z):
    flat = np.moveaxis(z, 1, 0).reshape(z.shape[1], -1)
    return flat.mean(1), 1 / np.sqrt(((flat - flat.mean(1)[:, None]) ** 2).sum(1) / (flat.shape[1] - 1))


def units(depth, low, high):
    n = []
    for d in depth:
        u = np.log(d / (low * high) ** 0.5) / (0.5 * np.log(high / low))
        if u > 1:
            u = 1 + np.log(u)
        elif u < -1:
            u = -1 - np.log(-u)
        n.append(u)
    return np.array(n)


RIGHT = {
    checks.check_units: units,
    checks.check_conv_size: conv_size,
    checks.check_rate: rate,
    checks.check_nearest: nearest,
    checks.check_straight_through: straight_through,
    checks.check_commitment: commitment,
    checks.check_moving_average: moving_average,
    checks.check_perplexity: perplexity,
    checks.check_calibrate: calibrate,
}


def pulls(on_z, on_e):
    """The commitment exercise with other weights on its two gradients."""
    return lambda z, e, beta: (on_z(beta) * 2 * (z - e) / z.size, on_e(beta) * 2 * (e - z) / z.size)


def averages(rule):
    """The moving average with another rule for one code: past count and total, batch's count and sum, decay."""

    def attempt(count, total, vectors, index, decay):
        mine = [vectors[index == k] for k in range(len(count))]
        rows = zip(count, total, mine, strict=True)
        return np.array([rule(n, m, len(v), v.sum(axis=0), decay) for n, m, v in rows])

    return attempt


def added_by_index(count, total, vectors, index, decay):
    """The moving average with ``+=`` on repeated indices, of which numpy does only one."""
    count, total = decay * count, decay * total
    count[index] += 1 - decay
    total[index] += (1 - decay) * vectors
    return total / count[:, None]


def summed_by_index(count, total, vectors, index, decay):
    """The same with counts from ``bincount``: only the sums lose vectors."""
    total = decay * total
    total[index] += (1 - decay) * vectors
    return total / (decay * count + (1 - decay) * np.bincount(index))[:, None]


def squared(v, b):
    return np.array([[((x - y) ** 2).sum() for y in b] for x in v])


def entropy(c):
    p = c[c > 0] / c.sum()
    return -np.sum(p * np.log(p))


def nan_entropy(c):
    p = c / c.sum()
    return np.exp(-np.sum(p * np.log(p)))


def bend(u, add=1):
    """Compress what lies beyond -1 and 1."""
    return [x if abs(x) <= 1 else np.sign(x) * (add + np.log(abs(x))) for x in u]


def straight(d, a, b):
    return np.log(d**2 / (a * b)) / np.log(b / a)


def linear(d, a, b):
    return (2 * d - a - b) / (b - a)


def without_modulus(u):
    return np.where(abs(u) > 1, np.sign(u) * (1 + np.log(u)), u)


MISTAKES = [
    (checks.check_units, straight, "compressed once more"),
    (checks.check_units, lambda d, a, b: np.minimum(np.maximum(straight(d, a, b), -1), 1), "clipped"),
    (checks.check_units, linear, "linear in depth:"),
    (checks.check_units, lambda d, a, b: bend(linear(d, a, b)), "linear in depth, compressed"),
    (checks.check_units, lambda d, a, b: bend(2 * np.log(2 * d / (a + b)) / np.log(b / a)), "not the mean"),
    (checks.check_units, lambda d, a, b: bend(straight(d, a, b) / 2), "half of ln"),
    (checks.check_units, lambda d, a, b: np.where(d < a, -units(d, a, b), units(d, a, b)), "sign is lost"),
    (checks.check_units, lambda d, a, b: bend(straight(d, a, b), 0), "1 is missing"),
    (checks.check_units, lambda d, a, b: -units(d, a, b), "reversed"),
    (checks.check_units, lambda d, a, b: without_modulus(straight(d, a, b)), "has no logarithm"),
    (checks.check_units, lambda d, a, b: np.minimum(straight(d, a, b), units(d, a, b)), "on both sides"),
    (checks.check_conv_size, lambda n, k, s, p: (n + 2 * p - k) // s, "+ 1 is missing"),
    (checks.check_conv_size, lambda n, k, s, p: (n + p - k) // s + 1, "both sides"),
    (checks.check_conv_size, lambda n, k, s, p: (n + 2 * p) // s + 1, "subtract it"),
    (checks.check_conv_size, lambda n, k, s, p: -(-(n + 2 * p - k) // s) + 1, "round down"),
    (checks.check_conv_size, lambda n, k, s, p: n + 2 * p - k + 1, "stride is missing"),
    (checks.check_conv_size, lambda n, k, s, p: n // s, "for even n"),
    (checks.check_rate, lambda k, f: np.log2(k) / f, "not factor"),
    (checks.check_rate, lambda k, f: np.log2(k), "bits of a cell"),
    (checks.check_rate, lambda k, f: np.log(k) / f**2, "base 2"),
    (checks.check_rate, lambda k, f: k / f**2, "not K"),
    (checks.check_nearest, lambda v, b: np.argmax(v @ b.T, axis=1), "largest dot product"),
    (checks.check_nearest, lambda v, b: squared(v, b).argmax(1), "farthest"),
    (checks.check_nearest, lambda v, b: squared(v, b).argmin(0), "over the vectors"),
    (checks.check_nearest, lambda v, b: squared(v[:, :1], b[:, :1]).argmin(1), "first channel"),
    (checks.check_nearest, lambda v, b: (np.square(b).sum(1) - v @ b.T).argmin(1), "-2 a.b"),
    (checks.check_nearest, lambda v, b: (v.sum(1)[:, None] - b.sum(1)[None]).argmin(1), "squared"),
    (checks.check_nearest, lambda v, b: b[nearest(v, b)], "not the code"),
    (checks.check_straight_through, lambda z, e, y: np.zeros_like(z), "staircase"),
    (checks.check_straight_through, lambda z, e, y: 2 * (z - y), "slope is taken at e"),
    (checks.check_straight_through, lambda z, e, y: e - y, "factor 2"),
    (checks.check_straight_through, lambda z, e, y: 2 * (y - e), "not the gradient"),
    (checks.check_straight_through, lambda z, e, y: 2 * (z - e), "commitment"),
    (checks.check_straight_through, lambda z, e, y: 2 * (e - y) / e.size, "not a mean"),
    (checks.check_commitment, pulls(lambda b: 1, lambda b: b), "wrong term"),
    (checks.check_commitment, pulls(lambda b: 1, lambda b: 1), "beta is missing"),
    (checks.check_commitment, pulls(lambda b: b, lambda b: b), "one term only"),
    (checks.check_commitment, pulls(lambda b: 1 + b, lambda b: 1 + b), "stopped gradients"),
    (checks.check_commitment, pulls(lambda b: b, lambda b: -1), "sign on the code"),
    (checks.check_commitment, pulls(lambda b: -b, lambda b: -1), "not the gradient"),
    (checks.check_commitment, lambda z, e, b: (b * (z - e) / z.size, (e - z) / z.size), "factor 2"),
    (checks.check_commitment, lambda z, e, b: (2 * b * (z - e) / len(z), 2 * (e - z) / len(z)), "not by N"),
    (checks.check_commitment, lambda z, e, b: commitment(z, e, b)[::-1], "the order is turned"),
    (checks.check_commitment, lambda z, e, b: (2 * b * (z - e), 2 * (e - z)), "sums"),
    (checks.check_commitment, lambda z, e, b: b * 2 * (z - e) / z.size, "shape"),
    (checks.check_moving_average, lambda n, m, v, i, d: moving_average(n, m, v, i, 1 - d), "decay weighs the past"),
    (checks.check_moving_average, averages(lambda n, m, h, s, d: d * m + (1 - d) * s), "not divided"),
    (checks.check_moving_average, averages(lambda n, m, h, s, d: s / h), "only the batch"),
    (checks.check_moving_average, averages(lambda n, m, h, s, d: d * m / n + (1 - d) * s / h), "averages means"),
    (checks.check_moving_average, averages(lambda n, m, h, s, d: (d * m + (1 - d) * s) / n), "count is not moved"),
    (checks.check_moving_average, averages(lambda n, m, h, s, d: (m + s) / (n + h)), "without decay"),
    (checks.check_moving_average, added_by_index, "adds only one of several"),
    (checks.check_moving_average, summed_by_index, "last vector only"),
    (checks.check_perplexity, entropy, "take its exponential"),
    (checks.check_perplexity, lambda c: np.exp(-entropy(c)), "sign is turned"),
    (checks.check_perplexity, lambda c: np.e ** (entropy(c) / np.log(2)), "one base"),
    (checks.check_perplexity, nan_entropy, "0 log 0"),
    (checks.check_perplexity, np.count_nonzero, "in use"),
    (checks.check_perplexity, lambda c: np.exp(-sum(x * np.log(x) for x in c if x)), "sum first"),
    (checks.check_perplexity, lambda c: perplexity(c) / len(c), "share of K"),
    (checks.check_calibrate, lambda z: (calibrate(z)[0], 1 / calibrate(z)[1]), "1 / standard deviation"),
    (checks.check_calibrate, lambda z: (calibrate(z)[0], calibrate(z)[1] ** 2), "variance"),
    (checks.check_calibrate, lambda z: (z.mean((0, 2, 3)), 1 / z.std((0, 2, 3))), "n - 1"),
    (checks.check_calibrate, lambda z: np.outer([z.mean(), 1 / z.std(ddof=1)], np.ones(z.shape[1])), "each channel"),
    (checks.check_calibrate, lambda z: (-calibrate(z)[0], calibrate(z)[1]), "no minus"),
    (checks.check_calibrate, lambda z: calibrate(z[:1]), "share one"),
    (checks.check_calibrate, lambda z: calibrate(z)[::-1], "comes second"),
]


(
    test_the_right_answer_passes,
    test_a_planted_mistake_is_named,
    test_a_stub_is_not_a_failure_of_the_notebook,
    test_every_checker_is_tested,
) = checker_tests(checks, RIGHT, MISTAKES)
