"""The right answer passes; every planted mistake fails with a message that names it."""

import math

import numpy as np
from checker_cases import checker_tests

from ditr_lite.exercises import training as checks


def share(items, index, of):
    return np.split(items, of)[index]


def accumulated(x, y, w, turns):
    total = 0.0
    for a, b in zip(np.split(x, turns), np.split(y, turns), strict=True):
        total += np.mean(2 * (w * a - b) * a) / turns
    return total


def average(weights, decay, start):
    for w in weights:
        start += (1 - decay) * (w - start)
    return start


def memory(parameters, frame_bytes, batch, shares):
    return 20 * parameters + frame_bytes * batch // shares


def ring(parameters, processes, speed):
    piece = 4 * parameters / processes
    return 2 * (processes - 1) * piece / speed


def rate(epoch, epochs, peak):
    return peak * math.cos(math.pi * epoch / epochs / 2) ** 2 * math.exp(-math.log(10) * epoch / epochs)


RIGHT = {
    checks.check_share: share,
    checks.check_accumulated: accumulated,
    checks.check_average: average,
    checks.check_training_memory: memory,
    checks.check_allreduce: ring,
    checks.check_falling_rate: rate,
}


def shares(x, y, w, turns):
    return [np.mean(2 * (w * a - b) * a) for a, b in zip(np.split(x, turns), np.split(y, turns), strict=True)]


MISTAKES = [
    (checks.check_share, lambda x, k, n: x[k::n], "in one piece"),
    (checks.check_share, lambda x, k, n: x[: len(x) // n], "first part"),
    (checks.check_share, lambda x, k, n: x, "same work"),
    (checks.check_share, lambda x, k, n: x[k * n : (k + 1) * n], "over the number of parts"),
    (checks.check_accumulated, lambda x, y, w, n: sum(shares(x, y, w, n)), "not divided by the number of turns"),
    (checks.check_accumulated, lambda x, y, w, n: shares(x, y, w, n)[-1], "set to zero in between"),
    (checks.check_accumulated, lambda x, y, w, n: sum(shares(x, y, w, n)) / len(x), "not by the samples"),
    (checks.check_accumulated, lambda x, y, w, n: accumulated(x, y, w, n) / 2, "a 2 in front"),
    (checks.check_accumulated, lambda x, y, w, n: np.mean(2 * (w * x - y)), "inner derivative"),
    (checks.check_average, lambda w, d, s: average(w, 1 - d, s), "1 - decay to the new weight"),
    (checks.check_average, lambda w, d, s: average(w, d, 0.0), "not at 0"),
    (checks.check_average, lambda w, d, s: average(w[1:], d, w[0]), "not at the first weight"),
    (checks.check_average, lambda w, d, s: np.mean(w), "plain mean"),
    (checks.check_average, lambda w, d, s: average(w[::-1], d, s), "in reverse"),
    (checks.check_training_memory, lambda p, f, b, s: 4 * p + f * b // s, "only the weights"),
    (checks.check_training_memory, lambda p, f, b, s: 16 * p + f * b // s, "one copy is missing"),
    (checks.check_training_memory, lambda p, f, b, s: 5 * p + f * b // s, "4 bytes"),
    (checks.check_training_memory, lambda p, f, b, s: 20 * p + f * b, "its share of the batch"),
    (checks.check_training_memory, lambda p, f, b, s: 20 * p // s + f * b // s, "not shared out"),
    (checks.check_training_memory, lambda p, f, b, s: 20 * p, "autograd keeps"),
    (checks.check_allreduce, lambda p, n, v: ring(p, n, v) / 2, "go round twice"),
    (checks.check_allreduce, lambda p, n, v: ring(p, n, v) * n, "1 / N of the gradient"),
    (checks.check_allreduce, lambda p, n, v: ring(p, n, v) * 8, "speed is in bytes"),
    (checks.check_allreduce, lambda p, n, v: 8 * p / v, "not send to itself"),
    (
        checks.check_falling_rate,
        lambda e, n, a: a * (1 + math.cos(math.pi * e / n)) / 2,
        "exponential factor is missing",
    ),
    (checks.check_falling_rate, lambda e, n, a: a * 10 ** (-e / n), "cosine is missing"),
    (checks.check_falling_rate, lambda e, n, a: 2 * rate(e, n, a), "halve it"),
    (
        checks.check_falling_rate,
        lambda e, n, a: a * math.cos(math.pi * e / n / 2) * 10 ** (-e / n),
        "quarter of a cosine's period",
    ),
    (checks.check_falling_rate, lambda e, n, a: a * math.cos(math.pi * e / n) * 10 ** (-e / n), "from 1 to -1"),
    (checks.check_falling_rate, lambda e, n, a: rate(e, n, 1.0), "peak is missing"),
]


(
    test_the_right_answer_passes,
    test_a_planted_mistake_is_named,
    test_a_stub_is_not_a_failure_of_the_notebook,
    test_every_checker_is_tested,
) = checker_tests(checks, RIGHT, MISTAKES)
