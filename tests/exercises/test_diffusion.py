"""The right answer passes; every planted mistake fails with a message that names it.

Answers and mistakes are written here as a learner would write them, not taken from the checkers.
"""

import numpy as np
import pytest
from checker_cases import checker_tests

from ditr_lite.exercises import diffusion as checks


def q_sample(x0, eps, abar):
    return np.sqrt(abar) * x0 + np.sqrt(1 - abar) * eps


def eps_from_x0(x_t, x0, abar):
    return (x_t - np.sqrt(abar) * x0) / np.sqrt(1 - abar)


def posterior(x0, x_t, abar, abar_prev):
    # Bayes' rule: precisions add, means are weighed by them
    alpha, beta = abar / abar_prev, 1 - abar / abar_prev
    precision = alpha / beta + 1 / (1 - abar_prev)
    return (np.sqrt(alpha) * x_t / beta + np.sqrt(abar_prev) * x0 / (1 - abar_prev)) / precision, 1 / precision


def gaussian_denoiser(x_t, s, abar):
    gain = np.sqrt(abar) * s**2 / (abar * s**2 + 1 - abar)
    return gain * x_t


def ddim_step(x_t, pred_x0, abar, abar_prev):
    return q_sample(pred_x0, eps_from_x0(x_t, pred_x0, abar), abar_prev)


def timesteps(total, steps):
    return [round(total * k / steps) - 1 for k in range(1, steps + 1)][::-1]


def ddim_variance(s, alpha_bars):
    variance = 1.0
    for a, prev in zip(alpha_bars[:-1], alpha_bars[1:], strict=True):
        gain = (np.sqrt(prev * a) * s**2 + np.sqrt((1 - prev) * (1 - a))) / (a * s**2 + 1 - a)
        variance *= gain**2
    return variance


def attention(query, key, value):
    out = np.zeros((len(query), value.shape[1]))
    for i, q in enumerate(query):
        weights = np.exp([q @ k / np.sqrt(len(q)) for k in key])
        out[i] = weights @ value / weights.sum()
    return out


RIGHT = {
    checks.check_q_sample: q_sample,
    checks.check_eps_from_x0: eps_from_x0,
    checks.check_posterior: posterior,
    checks.check_gaussian_denoiser: gaussian_denoiser,
    checks.check_ddim_step: ddim_step,
    checks.check_timesteps: timesteps,
    checks.check_ddim_variance: ddim_variance,
    checks.check_attention: attention,
}


def posterior_with(change):
    return lambda x0, x_t, a, p: change(*posterior(x0, x_t, a, p), x0, x_t, a, p)


def posterior_from(on_x0, on_x_t):
    """The posterior with the two coefficients given as functions of (abar, abar_prev)."""
    return lambda x0, x_t, a, p: (on_x0(a, p) * x0 + on_x_t(a, p) * x_t, posterior(x0, x_t, a, p)[1])


def on_x0(a, p):
    return np.sqrt(p) * (1 - a / p) / (1 - a)


def on_x_t(a, p):
    return np.sqrt(a / p) * (1 - p) / (1 - a)


def printed_ddim(x_t, pred_x0, a, p):
    return np.sqrt(p) * pred_x0 + np.sqrt(1 - p) * (x_t - np.sqrt(a) * pred_x0)


def angles(s, abars, tangent):
    phi = np.array([np.arctan(tangent(a, s)) if a > 0 else np.pi / 2 for a in abars])
    return s**2 / (abars[0] * s**2 + 1 - abars[0]) * np.prod(np.cos(np.diff(phi)) ** 2)


def tangent(a, s):
    return np.sqrt(1 - a) / (np.sqrt(a) * s)


def softmax(scores, axis):
    return np.exp(scores) / np.exp(scores).sum(axis=axis, keepdims=True)


MISTAKES = [
    (checks.check_q_sample, lambda x, e, a: 1.0 * e, "as printed"),
    (checks.check_q_sample, lambda x, e, a: a * x + (1 - a) * e, "both square roots"),
    (checks.check_q_sample, lambda x, e, a: a * x + np.sqrt(1 - a) * e, "on the signal is missing"),
    (checks.check_q_sample, lambda x, e, a: np.sqrt(a) * x + (1 - a) * e, "on the noise is missing"),
    (checks.check_q_sample, lambda x, e, a: np.sqrt(a) * e + np.sqrt(1 - a) * x, "swapped"),
    (checks.check_q_sample, lambda x, e, a: np.sqrt(a) * x + (1 - np.sqrt(a)) * e, "not 1 - sqrt(abar)"),
    (checks.check_q_sample, lambda x, e, a: np.sqrt(a) * x + e, "not scaled"),
    (checks.check_q_sample, lambda x, e, a: np.sqrt(a) * x - np.sqrt(1 - a) * e, "subtracted"),
    (checks.check_q_sample, lambda x, e, a: q_sample(x, e, a).sum(), "shape"),
    (checks.check_eps_from_x0, lambda x, y, a: x - np.sqrt(a) * y, "as printed"),
    (checks.check_eps_from_x0, lambda x, y, a: (x - np.sqrt(a) * y) / (1 - a), "not by the variance"),
    (checks.check_eps_from_x0, lambda x, y, a: (x - a * y) / np.sqrt(1 - a), "on the signal is missing"),
    (checks.check_eps_from_x0, lambda x, y, a: (x + np.sqrt(a) * y) / np.sqrt(1 - a), "is added"),
    (checks.check_eps_from_x0, lambda x, y, a: (x - y) / np.sqrt(1 - a), "must be scaled"),
    (checks.check_eps_from_x0, lambda x, y, a: (x - np.sqrt(1 - a) * y) / np.sqrt(a), "solves for x0"),
    (checks.check_posterior, posterior_with(lambda m, v, *_: (v, m)), "the order is turned"),
    (checks.check_posterior, posterior_with(lambda m, v, *_: (m, np.sqrt(v))), "no square root"),
    (checks.check_posterior, posterior_with(lambda m, v, x0, x_t, a, p: (m, 1 - a / p)), "beta itself"),
    (checks.check_posterior, posterior_from(lambda a, p: np.sqrt(p) * on_x0(a, p), on_x_t), "abar_prev is missing"),
    (checks.check_posterior, posterior_from(lambda a, p: np.sqrt(a / p) * on_x0(a, p), on_x_t), "abar of t"),
    (checks.check_posterior, posterior_from(on_x0, lambda a, p: a / p * (1 - p) / (1 - a)), "alpha is missing"),
    (checks.check_posterior, posterior_from(on_x0, lambda a, p: np.sqrt(a) * (1 - p) / (1 - a)), "alpha of one step"),
    (checks.check_posterior, lambda x0, x_t, a, p: posterior(x_t, x0, a, p), "x0 and x_t are swapped"),
    (checks.check_posterior, lambda x0, x_t, a, p: posterior_swapped(x0, x_t, a, p), "alpha_bar_prev are swapped"),
    (
        checks.check_posterior,
        lambda x0, x_t, a, p: (np.sqrt(p) * x0 + np.sqrt(a) * (1 - p) / (1 - a) * x_t, 1 - p),
        "not 1 - abar",
    ),
    (checks.check_gaussian_denoiser, lambda x, s, a: x * np.sqrt(a) * s / (a * s + 1 - a), "square it"),
    (checks.check_gaussian_denoiser, lambda x, s, a: x * a * s**2 / (a * s**2 + 1 - a), "numerator"),
    (checks.check_gaussian_denoiser, lambda x, s, a: x * np.sqrt(a) * s**2, "denominator"),
    (checks.check_gaussian_denoiser, lambda x, s, a: x / np.sqrt(a), "shrunk away"),
    (checks.check_gaussian_denoiser, lambda x, s, a: x * np.sqrt(a) * s**2 / (s**2 + 1 - a), "abar is missing"),
    (checks.check_gaussian_denoiser, lambda x, s, a: x * np.sqrt(a), "s is not used"),
    (checks.check_ddim_step, printed_ddim, "Eq. 9 as printed"),
    (checks.check_ddim_step, lambda x, y, a, p: ddim_step(x, y, a, a), "stays at t"),
    (checks.check_ddim_step, lambda x, y, a, p: posterior(y, x, a, p)[0], "posterior mean"),
    (checks.check_ddim_step, lambda x, y, a, p: p * y + (1 - p) * eps_from_x0(x, y, a), "square roots"),
    (checks.check_ddim_step, lambda x, y, a, p: np.sqrt(p) * y, "signal alone"),
    (checks.check_ddim_step, lambda x, y, a, p: q_sample(y, -eps_from_x0(x, y, a), p), "subtracted"),
    (checks.check_ddim_step, lambda x, y, a, p: 1.0 * y, "pred_x0 itself"),
    (checks.check_ddim_step, lambda x, y, a, p: q_sample(y, eps_from_x0(x, y, p), a), "are swapped"),
    (checks.check_timesteps, lambda n, k: [t + 1 for t in timesteps(n, k)], "off by one"),
    (checks.check_timesteps, lambda n, k: [n * j // k - 1 for j in range(k, 0, -1)], "cut off instead of rounded"),
    (checks.check_timesteps, lambda n, k: sorted(timesteps(n, k)), "least noisy first"),
    (checks.check_timesteps, lambda n, k: [round(n * j / k) for j in range(k)][::-1], "leading"),
    (checks.check_timesteps, lambda n, k: [round(t) for t in np.linspace(n - 1, 0, k)], "linspace"),
    (checks.check_timesteps, lambda n, k: timesteps(n, k + 1), "shape"),
    (
        checks.check_ddim_variance,
        lambda s, b: s**2 / (b[0] * s**2 + 1 - b[0]) * plain_cosines(s, b),
        "square the cosines",
    ),
    (checks.check_ddim_variance, lambda s, b: np.sqrt(ddim_variance(s, b)), "standard deviation"),
    (checks.check_ddim_variance, lambda s, b: angles(s, b, lambda a, s: tangent(a, 1)), "s is missing in the angle"),
    (checks.check_ddim_variance, lambda s, b: angles(s, b, lambda a, s: (1 - a) / (a * s)), "roots are missing"),
    (
        checks.check_ddim_variance,
        lambda s, b: ddim_variance(s, b) * (b[0] * s**2 + 1 - b[0]),
        "the start has variance 1",
    ),
    (checks.check_ddim_variance, lambda s, b: ddim_variance(s, b) / s**2, "s^2 is missing"),
    (checks.check_ddim_variance, lambda s, b: s**2, "variance of the data"),
    (checks.check_ddim_variance, lambda s, b: angles(s, b[:-1], tangent), "one jump is missing"),
    (checks.check_attention, lambda q, k, v: softmax(q @ k.T, 1) @ v, "sqrt(d) is missing"),
    (checks.check_attention, lambda q, k, v: softmax(q @ k.T / k.shape[1], 1) @ v, "not by d"),
    (checks.check_attention, lambda q, k, v: softmax(q @ k.T / np.sqrt(k.shape[1]), 0) @ v, "over the queries"),
    (checks.check_attention, lambda q, k, v: q @ k.T @ v / np.sqrt(k.shape[1]), "softmax is missing"),
    (checks.check_attention, lambda q, k, v: softmax(q @ k.T / np.sqrt(len(k)), 1) @ v, "number of keys"),
    (checks.check_attention, lambda q, k, v: softmax(q @ k.T / np.sqrt(k.shape[1]), (0, 1)) @ v, "over all weights"),
    (checks.check_attention, lambda q, k, v: np.exp(q @ k.T / np.sqrt(k.shape[1])) @ v, "not normalised"),
    (checks.check_attention, lambda q, k, v: attention(q, k, k), "values differ"),
]


def posterior_swapped(x0, x_t, a, p):
    a, p = p, a
    beta = 1 - a / p
    return on_x0(a, p) * x0 + np.sqrt(1 - beta) * (1 - p) / (1 - a) * x_t, beta * (1 - p) / (1 - a)


def plain_cosines(s, abars):
    phi = np.arctan([tangent(a, s) for a in abars])
    return np.prod(np.cos(np.diff(phi)))


(
    test_the_right_answer_passes,
    test_a_planted_mistake_is_named,
    test_a_stub_is_not_a_failure_of_the_notebook,
    test_every_checker_is_tested,
) = checker_tests(checks, RIGHT, MISTAKES)


@pytest.mark.parametrize("abars", [(0.9, 0.5, 0.1), (0.3,)])
def test_a_schedule_can_be_made_of_alpha_bars(abars):
    assert checks.schedule_of(*abars).alphas_cumprod.tolist() == pytest.approx(abars, rel=1e-12)
