"""Checkers of the exercises on the autoencoder: each prints a check mark, or a cross with the reason, and never raises.

Exercises work in numpy on a few vectors (N, C) and a codebook (K, C). The right answers come from ``autoencoder``,
``conditioning`` and ``floor``, which the pipeline and the committed figures use.
"""

import math

import numpy as np
import torch

from ..autoencoder import VectorQuantizer, VQAutoencoder
from ..conditioning import Bounds
from ..config import AutoencoderConfig
from ..studies.floor import perplexity
from .checker import Function, check

RNG = np.random.default_rng(7)
CODES, OTHER_CODES = 3 * RNG.normal(size=(5, 2)), 3 * RNG.normal(size=(4, 3))  # of unlike length: |b|^2 matters
VECTORS, OTHER = 3 * RNG.normal(size=(9, 2)), 3 * RNG.normal(size=(6, 3))


def quantizer(codebook: np.ndarray, **settings) -> VectorQuantizer:
    """Return a float64 quantiser that has this codebook (K, C), in training mode, none of its codes idle."""
    vq = VectorQuantizer(*codebook.shape, **settings).double()
    vq.codebook.copy_(torch.from_numpy(codebook))
    vq.idle.zero_()
    return vq


def check_conv_size(attempt: Function) -> bool:
    """Check ``attempt(n, kernel, stride, padding) -> m``, the length that a convolution makes of length n.

    Whole numbers in and out.
    """

    def right(n, kernel, stride, padding):
        conv = torch.nn.Conv1d(1, 1, kernel, stride, padding)
        return conv(torch.zeros(1, 1, n)).shape[-1]

    mistakes = {
        "the + 1 is missing: the first place counts too": lambda n, k, s, p: (n + 2 * p - k) // s,
        "padding is added on both sides: 2 * padding": lambda n, k, s, p: (n + p - k) // s + 1,
        "the kernel does not fit over the border: subtract it": lambda n, k, s, p: (n + 2 * p) // s + 1,
        "round down: a step that does not fit is not made": lambda n, k, s, p: math.ceil((n + 2 * p - k) / s) + 1,
        "the stride is missing": lambda n, k, s, p: n + 2 * p - k + 1,
        "that holds for even n with kernel 3 and padding 1 only": lambda n, k, s, p: n // s,
    }
    return check("size after a convolution", attempt, right, [(64, 3, 2, 1), (63, 3, 2, 1), (30, 5, 3, 0)], mistakes)


def check_rate(attempt: Function) -> bool:
    """Check ``attempt(codes, factor) -> bits per pixel`` of an image stored as one code's index per latent cell."""

    def right(codes, factor):
        return math.log2(codes) / factor**2

    mistakes = {
        "a cell covers factor x factor pixels, not factor": lambda k, f: math.log2(k) / f,
        "that is the number of bits of a cell: divide by its pixels": lambda k, f: math.log2(k),
        "bits are logarithms to base 2": lambda k, f: math.log(k) / f**2,
        "an index among K codes takes log2(K) bits, not K": lambda k, f: k / f**2,
    }
    return check("bits per pixel", attempt, right, [(2048, 4), (8192, 8), (64, 2)], mistakes)


def check_units(attempt: Function) -> bool:
    """Check ``attempt(depth (N,), low, high) -> (N,)``: metres to network units, logarithmic, compressed beyond."""

    def right(depth, low, high):
        return Bounds(low, high).normalise(depth)

    def plain(depth, low, high):  # without the compression
        return (np.log(depth) - np.log(low * high) / 2) * 2 / np.log(high / low)

    def compressed(u, add=1.0):
        return np.where(abs(u) > 1, np.sign(u) * (add + np.log(np.maximum(abs(u), 1))), u)

    mistakes = {
        "beyond the bounds u is compressed once more: sign(u) (1 + ln |u|)": plain,
        "the map is clipped, so it cannot be inverted": lambda d, a, b: np.clip(plain(d, a, b), -1, 1),
        "that is linear in depth: take logarithms first": lambda d, a, b: 2 * (d - a) / (b - a) - 1,
        "that is linear in depth, compressed: take logarithms first": lambda d, a, b: compressed(
            2 * (d - a) / (b - a) - 1
        ),
        "the middle m is sqrt(low high), not the mean of the two": lambda d, a, b: compressed(
            (np.log(d) - np.log((a + b) / 2)) * 2 / np.log(b / a)
        ),
        "h is half of ln(high / low)": lambda d, a, b: compressed(plain(d, a, b) / 2),
        "the sign is lost: below the bounds n is negative": lambda d, a, b: np.where(
            abs(plain(d, a, b)) > 1, abs(right(d, a, b)), plain(d, a, b)
        ),
        "a negative u has no logarithm: take that of |u|": lambda d, a, b: np.where(
            plain(d, a, b) < -1, np.nan, right(d, a, b)
        ),
        "u is compressed on both sides, below -1 too": lambda d, a, b: np.minimum(plain(d, a, b), right(d, a, b)),
        "the 1 is missing, so the map jumps at the bounds": lambda d, a, b: compressed(plain(d, a, b), 0.0),
        "the sign is reversed: low becomes -1": lambda d, a, b: -right(d, a, b),
    }
    depth = np.array([0.2, 0.5, 0.7, 0.85, 1.0, 1.3, 4.0, 10.0])
    return check("network units", attempt, right, [(depth, 0.6, 1.2), (2 * depth[::-1], 0.9, 4.0)], mistakes)


def check_nearest(attempt: Function) -> bool:
    """Check ``attempt(vectors (N, C), codebook (K, C)) -> (N,)`` indices of the nearest codes (Euclidean)."""

    def right(vectors, codebook):
        return quantizer(codebook).nearest(torch.from_numpy(vectors)).numpy()

    def distances(v, b):
        return ((v[:, None] - b[None]) ** 2).sum(axis=2)  # (N, K)

    mistakes = {
        "that is the code of the largest dot product: long codes win unfairly": lambda v, b: (v @ b.T).argmax(axis=1),
        "that is the farthest code: argmin, not argmax": lambda v, b: distances(v, b).argmax(axis=1),
        "the minimum runs over the vectors; every vector wants a code": lambda v, b: distances(v, b).argmin(axis=0),
        "only the first channel is compared": lambda v, b: distances(v[:, :1], b[:, :1]).argmin(axis=1),
        "|a - b|^2 has the product twice: -2 a.b": lambda v, b: ((b**2).sum(axis=1) - v @ b.T).argmin(axis=1),
        "differences must be squared (or made positive) before they are added": lambda v, b: (
            (v[:, None] - b[None]).sum(axis=2).argmin(axis=1)
        ),
        "return the index of the code, not the code": lambda v, b: b[distances(v, b).argmin(axis=1)],
    }
    return check("nearest code", attempt, right, [(VECTORS, CODES), (OTHER, OTHER_CODES)], mistakes)


def check_straight_through(attempt: Function) -> bool:
    """Check ``attempt(z (N, C), e (N, C), y (N, C)) -> (N, C)``: what reaches z of the decoder's loss sum((z_q - y)^2).

    ``e`` are the codes nearest to ``z``.
    """

    def right(z, e, y):
        z, e, y = (torch.from_numpy(a) for a in (z, e, y))
        z.requires_grad_()
        ((z + (e - z).detach() - y) ** 2).sum().backward()
        return z.grad.numpy()

    mistakes = {
        "zero is the true gradient of the staircase; straight-through pretends it is the identity": lambda z, e, y: (
            0 * z
        ),
        "the loss sees the code, not z: its slope is taken at e": lambda z, e, y: 2 * (z - y),
        "the derivative of a square has a factor 2": lambda z, e, y: e - y,
        "the sign is turned: that is the step, not the gradient": lambda z, e, y: 2 * (y - e),
        "that is the gradient of the commitment, which ties z to its code": lambda z, e, y: 2 * (z - e),
        "the loss is a sum, not a mean": lambda z, e, y: 2 * (e - y) / z.size,
    }
    rng = np.random.default_rng(7)
    cases = [tuple(rng.normal(size=(3, *shape))) for shape in ((4, 2), (3, 3))]
    return check("straight-through gradient", attempt, right, cases, mistakes)


def check_commitment(attempt: Function) -> bool:
    """Check ``attempt(z (N, C), e (N, C), beta) -> (gradient on z, gradient on e)`` of codebook loss and commitment.

    The loss is mean((sg(z) - e)^2) + beta mean((z - sg(e))^2), means over all N C numbers (van den Oord et al., Eq. 3).
    Arrays; two results, the gradient on z first.
    """

    def right(z, e, beta):
        z, e = (torch.from_numpy(a).requires_grad_() for a in (z, e))
        loss = (z.detach() - e).square().mean() + beta * (z - e.detach()).square().mean()
        loss.backward()
        return np.stack([z.grad.numpy(), e.grad.numpy()])

    def wrong(on_z, on_e):
        return lambda z, e, beta: np.stack([on_z(beta) * 2 * (z - e) / z.size, on_e(beta) * 2 * (e - z) / z.size])

    mistakes = {
        "beta is on the wrong term: it weighs what pulls the encoder, z": wrong(lambda b: 1, lambda b: b),
        "beta is missing": wrong(lambda b: 1, lambda b: 1),
        "beta weighs one term only": wrong(lambda b: b, lambda b: b),
        "the stopped gradients are forgotten: each side would feel both terms": wrong(lambda b: 1 + b, lambda b: 1 + b),
        "the sign on the code is turned: e is pulled towards z": wrong(lambda b: b, lambda b: -1),
        "the signs are turned: that is the step, not the gradient": wrong(lambda b: -b, lambda b: -1),
        "the derivative of a square has a factor 2": wrong(lambda b: b / 2, lambda b: 1 / 2),
        "the order is turned: the gradient on z comes first, then that on e": lambda z, e, b: right(z, e, b)[::-1],
        "the mean is over all numbers: divide by N C, not by N": lambda z, e, b: right(z, e, b) * z.shape[1],
        "these are sums; the loss is a mean": lambda z, e, b: right(z, e, b) * z.size,
    }
    rng = np.random.default_rng(7)
    cases = [(*rng.normal(size=(2, 4, 2)), 0.25), (*rng.normal(size=(2, 3, 3)), 0.6)]
    return check("commitment", attempt, right, cases, mistakes)


def check_moving_average(attempt: Function) -> bool:
    """Check ``attempt(count (K,), total (K, C), vectors (N, C), index (N,), decay) -> (K, C)``, the moved codes.

    All are arrays, ``decay`` a number. All codes are chosen at least once, some several times; ``index`` says by whom.
    A code is its moving total over its moving count.
    """

    def right(count, total, vectors, index, decay):
        vq = quantizer(total / count[:, None], decay=decay)
        vq.count.copy_(torch.from_numpy(count))
        vq.total.copy_(torch.from_numpy(total))
        vq.follow(torch.from_numpy(vectors), torch.from_numpy(index))
        return vq.codebook.numpy()

    def hits(count, vectors, index):
        one_hot = np.eye(len(count))[index]  # (N, K)
        return one_hot.sum(axis=0), one_hot.T @ vectors

    def wrong(change):
        return lambda n, m, v, i, d: change(n[:, None], m, hits(n, v, i)[0][:, None], hits(n, v, i)[1], d)

    def buffered(count, total, vectors, index, decay, count_too=True):  # what a[index] += does with repeated indices
        sums, hit = np.zeros(total.shape), np.zeros(len(count))
        sums[index] += vectors
        hit[index] += 1
        if not count_too:
            hit = hits(count, vectors, index)[0]
        return (decay * total + (1 - decay) * sums) / (decay * count + (1 - decay) * hit)[:, None]

    mistakes = {
        "a[index] += v adds only one of several vectors of a code: np.add.at, or a sum over a mask": buffered,
        "a[index] += v keeps a code's last vector only: np.add.at, or a sum over a mask": lambda n, m, v, i, d: (
            buffered(n, m, v, i, d, count_too=False)
        ),
        "decay weighs the past, 1 - decay the batch": wrong(
            lambda n, m, h, s, d: ((1 - d) * m + d * s) / ((1 - d) * n + d * h)
        ),
        "the total is not divided by the count": wrong(lambda n, m, h, s, d: d * m + (1 - d) * s),
        "only the batch's mean is used, not the past": wrong(lambda n, m, h, s, d: s / h),
        "that averages means: a code chosen once would weigh as much as one chosen often": wrong(
            lambda n, m, h, s, d: d * m / n + (1 - d) * s / h
        ),
        "the count is not moved, only the total": wrong(lambda n, m, h, s, d: (d * m + (1 - d) * s) / n),
        "past and batch are added without decay": wrong(lambda n, m, h, s, d: (m + s) / (n + h)),
    }
    index, other = np.array([0, 1, 1, 2, 0, 3, 4, 4, 4]), np.array([0, 1, 2, 3, 3, 3])
    cases = [
        (np.array([1.0, 2, 0.5, 3, 1]), 2 * CODES, VECTORS, index, 0.9),
        (np.array([4.0, 1, 2, 0.3]), OTHER_CODES, OTHER, other, 0.6),
    ]
    return check("moving average", attempt, right, cases, mistakes)


def check_perplexity(attempt: Function) -> bool:
    """Check ``attempt(counts (K,)) -> float``: exp of the entropy of how often each code was chosen; 0 log 0 = 0."""

    def entropy(counts):
        p = counts[counts > 0] / counts.sum()
        return -(p * np.log(p)).sum()

    mistakes = {
        "that is the entropy: take its exponential": entropy,
        "the sign is turned: entropy is - sum p log p": lambda c: np.exp(-entropy(c)),
        "logarithm and power need one base": lambda c: np.exp(entropy(c) / math.log(2)),
        "0 log 0 is 0: leave unused codes out": lambda c: math.nan if (c == 0).any() else perplexity(c),
        "that is the number of codes in use, however seldom": lambda c: (c > 0).sum(),
        "divide the counts by their sum first": lambda c: np.exp(-(c[c > 0] * np.log(c[c > 0])).sum()),
        "the perplexity itself is wanted, not its share of K": lambda c: perplexity(c) / len(c),
    }
    cases = [(np.array([4.0, 4, 0, 4]),), (np.array([1.0, 2, 3, 0, 10]),)]
    return check("perplexity", attempt, perplexity, cases, mistakes)


def check_calibrate(attempt: Function) -> bool:
    """Check ``attempt(z (B, C, h, w)) -> (2, C)``: shift and scale with which (z - shift) * scale is standardised.

    The standard deviation has n - 1 in the denominator, as torch's.
    """

    def right(z):
        model = VQAutoencoder(AutoencoderConfig(latent_channels=z.shape[1], codes=2, width=1)).double()
        model.calibrate(torch.from_numpy(z))
        return np.stack([model.latent_shift.flatten().numpy(), model.latent_scale.flatten().numpy()])

    def per_channel(z, scale, axis=(0, 2, 3)):
        return np.stack([z.mean(axis=axis), scale(z)])

    def deviation(z):
        return z.std(axis=(0, 2, 3), ddof=1)

    mistakes = {
        "the scale multiplies: it is 1 / standard deviation": lambda z: per_channel(z, deviation),
        "divide by the standard deviation, not by the variance": lambda z: per_channel(
            z, lambda z: 1 / deviation(z) ** 2
        ),
        "n - 1, not n, in the standard deviation": lambda z: per_channel(z, lambda z: 1 / z.std(axis=(0, 2, 3))),
        "each channel has its own mean and standard deviation": lambda z: np.stack(
            [np.full(z.shape[1], z.mean()), np.full(z.shape[1], 1 / z.std(ddof=1))]
        ),
        "the shift is subtracted: no minus": lambda z: per_channel(z, lambda z: 1 / deviation(z)) * [[-1], [1]],
        "the frames of a batch share one shift and scale": lambda z: np.stack(
            [z[0].mean(axis=(1, 2)), 1 / z[0].std(axis=(1, 2), ddof=1)]
        ),
        "scale comes second: the shift is the mean": lambda z: per_channel(z, lambda z: 1 / deviation(z))[::-1],
    }
    offset, spread = np.array([1.0, -2, 5])[:, None, None], np.array([0.3, 2, 4])[:, None, None]
    rng = np.random.default_rng(7)
    cases = [(offset + spread * rng.normal(size=(2, 3, 4, 4)),), (rng.normal(3, 2, size=(1, 2, 3, 5)),)]
    return check("calibration", attempt, right, cases, mistakes)
