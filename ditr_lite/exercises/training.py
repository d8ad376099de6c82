"""Checkers of the exercises on training at scale: shares, averages, rates, memory and traffic."""

import numpy as np

from .checker import Function, check


def check_share(attempt: Function) -> bool:
    """Check ``attempt(items, index, of) -> array``: part ``index`` of ``of`` equal parts, in order."""

    def right(items, index, of):
        size = len(items) // of
        return items[index * size : (index + 1) * size]

    mistakes = {
        "every process takes the first part: begin at index times the size": lambda x, k, n: x[: len(x) // n],
        "those are every n-th item; the parts should be in one piece": lambda x, k, n: x[k::n],
        "the size of a part is the number of items over the number of parts": lambda x, k, n: x[k * n : (k + 1) * n],
        "index counts from 0": lambda x, k, n: right(x, k - 1, n) if k else x[:0],
        "every process takes everything: then they all do the same work": lambda x, k, n: x,
    }
    cases = [(np.arange(12.0), 1, 4), (np.arange(12.0) ** 2, 2, 3), (np.arange(8.0), 0, 2)]
    return check("share of a batch", attempt, right, cases, mistakes)


def check_accumulated(attempt: Function) -> bool:
    """Check ``attempt(x, y, w, turns) -> float``: d/dw of the mean of (w x - y)^2, summed up over equal shares."""

    def right(x, y, w, turns):
        return float(np.mean(2 * (w * x - y) * x))

    def parts(x, y, w, turns):
        return [
            float(np.mean(2 * (w * a - b) * a)) for a, b in zip(np.split(x, turns), np.split(y, turns), strict=True)
        ]

    mistakes = {
        "the gradients are added but not divided by the number of turns": lambda x, y, w, n: sum(parts(x, y, w, n)),
        "only the last share counts: the gradient was set to zero in between": lambda x, y, w, n: parts(x, y, w, n)[-1],
        "only the first share counts": lambda x, y, w, n: parts(x, y, w, n)[0],
        "that is the sum over all samples; the loss is their mean": lambda x, y, w, n: right(x, y, w, n) * len(x),
        "the mean inside a share divides already: divide by the turns, not by the samples": lambda x, y, w, n: (
            sum(parts(x, y, w, n)) / len(x)
        ),
        "the derivative of a square has a 2 in front": lambda x, y, w, n: right(x, y, w, n) / 2,
        "the inner derivative is missing: multiply by x": lambda x, y, w, n: float(np.mean(2 * (w * x - y))),
    }
    rng = np.random.default_rng(10)
    x = rng.normal(1, 1, 12)
    cases = [(x, 3 * x + rng.normal(size=12), 0.5, 3), (x, x**2, -1.0, 4)]
    return check("gradient in turns", attempt, right, cases, mistakes)


def check_average(attempt: Function) -> bool:
    """Check ``attempt(weights, decay, start) -> float``: the moving average after all weights, begun at ``start``."""

    def right(weights, decay, start):
        average = start
        for w in weights:
            average = decay * average + (1 - decay) * w
        return float(average)

    mistakes = {
        "decay belongs to the average, 1 - decay to the new weight": lambda w, d, s: right(w, 1 - d, s),
        "the average begins at the start, not at 0": lambda w, d, s: right(w, d, 0.0),
        "the average begins at the start, not at the first weight": lambda w, d, s: right(w[1:], d, w[0]),
        "that is the plain mean": lambda w, d, s: float(np.mean(w)),
        "the last weight is left out": lambda w, d, s: right(w[:-1], d, s),
        "the newest weight comes last: they are taken in reverse": lambda w, d, s: right(w[::-1], d, s),
    }
    rng = np.random.default_rng(10)
    cases = [(rng.normal(2, 1, 9).tolist(), 0.9, 1.0), (rng.normal(size=30).tolist(), 0.98, -3.0)]
    return check("moving average", attempt, right, cases, mistakes)


def check_training_memory(attempt: Function) -> bool:
    """Check ``attempt(parameters, frame_bytes, batch, shares) -> bytes`` of training with AdamW and an average.

    Float32 throughout; ``frame_bytes`` is what autograd keeps for a frame.
    """

    def right(parameters, frame_bytes, batch, shares):
        return 4 * 5 * parameters + batch // shares * frame_bytes

    mistakes = {
        "only the weights are counted, not gradients, moments and average": lambda p, f, b, s: 4 * p + b // s * f,
        "one copy is missing of weights, gradients, two moments and the average": lambda p, f, b, s: (
            16 * p + b // s * f
        ),
        "a float32 number has 4 bytes": lambda p, f, b, s: 5 * p + b // s * f,
        "a process holds its share of the batch at a time, not all of it": lambda p, f, b, s: 20 * p + b * f,
        "the weights are not shared out: every process has all copies": lambda p, f, b, s: 20 * p // s + b // s * f,
        "what autograd keeps for the frames is missing": lambda p, f, b, s: 20 * p,
    }
    cases = [(4_239_140, 18_000_000, 16, 4), (1_000_001, 5_000_000, 8, 2)]
    return check("memory of a training process", attempt, right, cases, mistakes, rtol=1e-9)


def check_allreduce(attempt: Function) -> bool:
    """Check ``attempt(parameters, processes, bytes_per_s) -> s`` of a ring all-reduce of float32 gradients.

    Each process sends 2 (N - 1) / N of the gradient: N - 1 pieces while they are summed, as many while they are told.
    """

    def right(p, n, speed):
        return 2 * (n - 1) / n * 4 * p / speed

    mistakes = {
        "the pieces go round twice: once to be summed, once to be told": lambda p, n, v: right(p, n, v) / 2,
        "a float32 number has 4 bytes": lambda p, n, v: right(p, n, v) / 4,
        "that is 32 bits a number; the speed is in bytes": lambda p, n, v: right(p, n, v) * 8,
        "a piece is 1 / N of the gradient": lambda p, n, v: right(p, n, v) * n,
        "a process does not send to itself: N - 1 pieces": lambda p, n, v: 8 * p / v,
        "that is how many a second": lambda p, n, v: 1 / right(p, n, v),
    }
    cases = [(4_239_140, 2, 1e9), (16_410_755, 8, 1.25e9)]
    return check("time of an all-reduce", attempt, right, cases, mistakes)


def check_falling_rate(attempt: Function) -> bool:
    """Check ``attempt(epoch, epochs, peak) -> rate``: half a cosine times an exponential that ends at a tenth."""

    def right(epoch, epochs, peak):
        p = epoch / epochs
        return peak * (1 + np.cos(np.pi * p)) / 2 * 10.0**-p

    mistakes = {
        "the exponential factor is missing": lambda e, n, a: right(e, n, a) * 10.0 ** (e / n),
        "the cosine is missing": lambda e, n, a: a * 10.0 ** (-e / n),
        "1 + cos goes from 2 to 0: halve it": lambda e, n, a: 2 * right(e, n, a),
        "the exponential falls to 1/e there, not to a tenth": lambda e, n, a: (
            a * (1 + np.cos(np.pi * e / n)) / 2 * np.exp(-e / n)
        ),
        "half a cosine: pi times the share of the way, not 2 pi": lambda e, n, a: (
            a * (1 + np.cos(2 * np.pi * e / n)) / 2 * 10.0 ** (-e / n)
        ),
        "that is a quarter of a cosine's period; from its top to its bottom is half: (1 + cos(pi p)) / 2": (
            lambda e, n, a: a * np.cos(np.pi * e / n / 2) * 10.0 ** (-e / n)
        ),
        "the cosine alone falls from 1 to -1: add 1 and halve it": lambda e, n, a: (
            a * np.cos(np.pi * e / n) * 10.0 ** (-e / n)
        ),
        "the peak is missing": lambda e, n, a: right(e, n, 1.0),
    }
    cases = [(50, 200, 0.01), (130, 200, 0.01), (0, 7, 2.0)]
    return check("rate of the paper's stage one", attempt, right, cases, mistakes)
