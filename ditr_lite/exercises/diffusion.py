"""Checkers of the exercises on diffusion: each prints a check mark, or a cross with the reason, and never raises.

Exercises work in numpy on single numbers or short arrays, with alpha-bar given as a number, so that nothing but the
formula is left to get wrong. The right answers come from ``diffusion``, the file that the pipeline samples with.
"""

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .. import diffusion
from ..schedule import NoiseSchedule
from .checker import Function, check

CLEAN, NOISY = np.random.default_rng(4).normal(0, 1.3, (2, 8))  # float64 (8,), any numbers will do


def schedule_of(*alpha_bars: float) -> NoiseSchedule:
    """Return the schedule that has these alpha-bars at t = 0, 1, ..., least noisy first."""
    before = torch.tensor([1.0, *alpha_bars[:-1]], dtype=torch.float64)
    return NoiseSchedule(1 - torch.tensor(alpha_bars, dtype=torch.float64) / before)


def _tensors(t: int, *arrays) -> tuple[Tensor, ...]:
    data = [torch.atleast_1d(torch.as_tensor(a, dtype=torch.float64)) for a in arrays]
    return (*data, torch.full((len(data[0]),), t))


def check_q_sample(attempt: Function) -> bool:
    """Check ``attempt(x0, eps, alpha_bar) -> x_t``: Eq. 7 as it must be, sqrt(abar) x0 + sqrt(1 - abar) eps."""

    def right(x0, eps, a):
        x0, eps, t = _tensors(0, x0, eps)
        return diffusion.q_sample(x0, t, eps, schedule_of(a)).numpy()

    mistakes = {
        "that is Eq. 7 as printed: only noise, whatever the step": lambda x, e, a: e,
        "both square roots are missing: that mixes variances, not standard deviations": lambda x, e, a: (
            a * x + (1 - a) * e
        ),
        "the square root on the signal is missing": lambda x, e, a: a * x + (1 - a) ** 0.5 * e,
        "the square root on the noise is missing": lambda x, e, a: a**0.5 * x + (1 - a) * e,
        "signal and noise are swapped": lambda x, e, a: right(e, x, a),
        "the noise level is sqrt(1 - abar), not 1 - sqrt(abar)": lambda x, e, a: a**0.5 * x + (1 - a**0.5) * e,
        "the noise is not scaled: at small t there is hardly any": lambda x, e, a: a**0.5 * x + e,
        "the noise is subtracted": lambda x, e, a: right(x, -e, a),
    }
    return check("forward process", attempt, right, [(CLEAN, NOISY, 0.81), (NOISY, CLEAN, 0.2)], mistakes)


def check_eps_from_x0(attempt: Function) -> bool:
    """Check ``attempt(x_t, x0, alpha_bar) -> eps``: Eq. 9 with the division that the paper leaves out."""

    def right(x_t, x0, a):
        x_t, x0, t = _tensors(0, x_t, x0)
        return diffusion.eps_from_x0(x_t, t, x0, schedule_of(a)).numpy()

    mistakes = {
        "that is Eq. 9 as printed: divide by the noise level sqrt(1 - abar)": lambda x, y, a: x - a**0.5 * y,
        "divide by the standard deviation sqrt(1 - abar), not by the variance": lambda x, y, a: (
            (x - a**0.5 * y) / (1 - a)
        ),
        "the square root on the signal is missing": lambda x, y, a: (x - a * y) / (1 - a) ** 0.5,
        "the signal is added; it must be taken away": lambda x, y, a: (x + a**0.5 * y) / (1 - a) ** 0.5,
        "x0 must be scaled by sqrt(abar) before it is taken away": lambda x, y, a: (x - y) / (1 - a) ** 0.5,
        "that solves for x0, with x0 in the place of the noise": lambda x, y, a: (x - (1 - a) ** 0.5 * y) / a**0.5,
    }
    return check("noise from data", attempt, right, [(NOISY, CLEAN, 0.81), (CLEAN, NOISY, 0.2)], mistakes)


def check_posterior(attempt: Function) -> bool:
    """Check ``attempt(x0, x_t, alpha_bar, alpha_bar_prev) -> (mean, variance)`` of q(x_{t-1} given x_t, x0).

    Four numbers in, two out, the mean first.
    """

    def right(x0, x_t, a, prev):
        x0, x_t, t = _tensors(1, x0, x_t)
        found = diffusion.posterior_mean_variance(x0, x_t, t, schedule_of(prev, a))
        return np.array([float(x) for x in found])

    def parts(a, prev):
        beta = 1 - a / prev
        return prev**0.5 * beta / (1 - a), (1 - beta) ** 0.5 * (1 - prev) / (1 - a), beta * (1 - prev) / (1 - a)

    def wrong(change):
        def attempt(x0, x_t, a, prev):
            on_x0, on_x_t, variance = change(a, prev, *parts(a, prev))
            return on_x0 * x0 + on_x_t * x_t, variance

        return attempt

    mistakes = {
        "the order is turned: the mean comes first, then the variance": lambda x, y, a, p: right(x, y, a, p)[::-1],
        "the variance is a standard deviation: no square root": wrong(lambda a, p, u, w, v: (u, w, v**0.5)),
        "the variance is beta itself: it lacks (1 - abar_prev) / (1 - abar)": wrong(
            lambda a, p, u, w, v: (u, w, 1 - a / p)
        ),
        "the square root of abar_prev is missing": wrong(lambda a, p, u, w, v: (u * p**0.5, w, v)),
        "x0 is weighted with abar of t; the mean is at t - 1": wrong(lambda a, p, u, w, v: (u * (a / p) ** 0.5, w, v)),
        "the square root of alpha is missing": wrong(lambda a, p, u, w, v: (u, w * (a / p) ** 0.5, v)),
        "the factor of x_t has alpha of one step, abar / abar_prev, not abar": wrong(
            lambda a, p, u, w, v: (u, w * p**0.5, v)
        ),
        "x0 and x_t are swapped": lambda x, y, a, p: right(y, x, a, p),
        "alpha_bar and alpha_bar_prev are swapped": wrong(lambda a, p, u, w, v: parts(p, a)),
        "beta is 1 - abar / abar_prev, not 1 - abar": wrong(
            lambda a, p, u, w, v: (p**0.5, a**0.5 * (1 - p) / (1 - a), 1 - p)
        ),
    }
    return check("posterior", attempt, right, [(0.7, -0.4, 0.5, 0.6), (-1.1, 0.3, 0.81, 0.9)], mistakes)


def check_gaussian_denoiser(attempt: Function) -> bool:
    """Check ``attempt(x_t, s, alpha_bar) -> E[x0 given x_t]`` for data from N(0, s^2)."""

    def right(x, s, a):
        return a**0.5 * s**2 / (a * s**2 + 1 - a) * x

    mistakes = {
        "s is a standard deviation: square it": lambda x, s, a: right(x, s**0.5, a),
        "the square root of abar is missing in the numerator": lambda x, s, a: right(x, s, a) * a**0.5,
        "the variance of x_t is missing in the denominator": lambda x, s, a: a**0.5 * s**2 * x,
        "that only undoes the scaling of the signal; the noise must be shrunk away": lambda x, s, a: x / a**0.5,
        "the noise is missing in the variance of x_t, abar s^2 + (1 - abar)": lambda x, s, a: (
            x * s**2 / (a**0.5 * s**2)
        ),
        "the variance of x_t is abar s^2 + (1 - abar): abar is missing": lambda x, s, a: (
            a**0.5 * s**2 / (s**2 + 1 - a) * x
        ),
        "that is the denoiser of N(0, 1): s is not used": lambda x, s, a: right(x, 1, a),
    }
    return check("exact denoiser", attempt, right, [(NOISY, 0.5, 0.81), (CLEAN, 1.7, 0.2)], mistakes)


def check_ddim_step(attempt: Function) -> bool:
    """Check ``attempt(x_t, pred_x0, alpha_bar, alpha_bar_prev) -> x_prev``: the deterministic jump (eta = 0)."""

    def right(x_t, x0, a, prev):
        x_t, x0, t = _tensors(1, x_t, x0)
        return diffusion.ddim_step(x_t, t, t - 1, x0, schedule_of(prev, a)).numpy()

    def eps(x, y, a):
        return (x - a**0.5 * y) / (1 - a) ** 0.5

    mistakes = {
        "the noise lacks its division by sqrt(1 - abar) (Eq. 9 as printed)": lambda x, y, a, p: (
            p**0.5 * y + (1 - p) ** 0.5 * (x - a**0.5 * y)
        ),
        "it stays at t: mix with alpha_bar_prev": lambda x, y, a, p: x,
        "alpha_bar and alpha_bar_prev are swapped": lambda x, y, a, p: a**0.5 * y + (1 - a) ** 0.5 * eps(x, y, p),
        "that is the posterior mean (DDPM); DDIM keeps the noise and lowers its level": lambda x, y, a, p: (
            p**0.5 * (1 - a / p) / (1 - a) * y + (a / p) ** 0.5 * (1 - p) / (1 - a) * x
        ),
        "the square roots of alpha_bar_prev are missing": lambda x, y, a, p: p * y + (1 - p) * eps(x, y, a),
        "the noise is not mixed in again: that returns the signal alone": lambda x, y, a, p: p**0.5 * y,
        "the noise is subtracted": lambda x, y, a, p: p**0.5 * y - (1 - p) ** 0.5 * eps(x, y, a),
        "that is pred_x0 itself: a jump to t_prev, not to the clean end": lambda x, y, a, p: y,
    }
    return check("DDIM step", attempt, right, [(NOISY, CLEAN, 0.2, 0.5), (CLEAN, NOISY, 0.5, 0.81)], mistakes)


def check_timesteps(attempt: Function) -> bool:
    """Check ``attempt(timesteps, steps) -> list of t``, noisiest first, evenly spaced, starting at timesteps - 1.

    Whole numbers. Where ``timesteps`` is no multiple of ``steps``, a place between two steps is rounded to the nearest;
    a half is not asked for.
    """

    def right(total, steps):
        return diffusion.timesteps_for(NoiseSchedule(torch.full((total,), 0.01, dtype=torch.float64)), steps)

    mistakes = {
        "off by one: t counts from 0, so the noisiest step is timesteps - 1": lambda n, k: [t + 1 for t in right(n, k)],
        "cut off instead of rounded: int() goes down, round() to the nearest": lambda n, k: [
            int(n * i / k) - 1 for i in range(k, 0, -1)
        ],
        "least noisy first; the sampler starts at the noisiest": lambda n, k: right(n, k)[::-1],
        "'leading' spacing: it starts below timesteps - 1, though the start is pure noise": lambda n, k: [
            round(n * i / k) for i in range(k - 1, -1, -1)
        ],
        "'linspace' spacing: the last jump, to the clean end, is shorter than the others": lambda n, k: (
            np.linspace(n - 1, 0, k).round().astype(int)
        ),
    }
    return check("timesteps", attempt, right, [(1000, 4), (1000, 10), (100, 50), (1000, 7)], mistakes, rtol=1e-9)


def check_ddim_variance(attempt: Function) -> bool:
    """Check ``attempt(s, alpha_bars) -> variance`` of what DDIM makes of N(0, 1) noise when the data is N(0, s^2).

    ``alpha_bars`` runs from the noisiest step to 1, the clean end. The reference runs the sampler itself: with the
    exact denoiser it multiplies its start by a number, whose square is the variance.
    """

    def right(s, alpha_bars):
        schedule = schedule_of(*list(alpha_bars)[-2::-1])

        def denoise(x, t):
            a = schedule.alphas_cumprod[t]
            return a.sqrt() * s**2 / (a * s**2 + 1 - a) * x

        one = torch.ones(1, dtype=torch.float64)
        return float(diffusion.sample(denoise, (1,), schedule, schedule.timesteps, x_T=one)) ** 2

    def by_angles(s, alpha_bars, power=2, tangent=None, start=None):
        phi = [math.atan2((1 - a) ** 0.5, a**0.5 * s) if tangent is None else tangent(a, s) for a in alpha_bars]
        product = math.prod(math.cos(p - q) ** power for p, q in zip(phi[:-1], phi[1:], strict=True))
        a = alpha_bars[0]
        return (s**2 / (a * s**2 + 1 - a) if start is None else start(s, a)) * product

    mistakes = {
        "that is the factor on x or its standard deviation: square the cosines": lambda s, b: by_angles(s, b, power=1),
        "that is a standard deviation; the variance is wanted": lambda s, b: right(s, b) ** 0.5,
        "s is missing in the angle: tan(phi) = sqrt(1 - abar) / (sqrt(abar) s)": lambda s, b: by_angles(
            s, b, tangent=lambda a, s: math.atan2((1 - a) ** 0.5, a**0.5)
        ),
        "the square roots are missing in the angle": lambda s, b: by_angles(
            s, b, tangent=lambda a, s: math.atan2(1 - a, a * s)
        ),
        "the start has variance 1, not V_T: divide by abar_T s^2 + 1 - abar_T": lambda s, b: by_angles(
            s, b, start=lambda s, a: s**2
        ),
        "the factor s^2 is missing: at the clean end V = s^2": lambda s, b: by_angles(
            s, b, start=lambda s, a: 1 / (a * s**2 + 1 - a)
        ),
        "that is the variance of the data: a few long jumps shrink it": lambda s, b: s**2,
        "one jump is missing: the last one goes to the clean end, abar = 1": lambda s, b: by_angles(s, b[:-1]),
    }
    cases = [(0.5, [0.1, 0.4, 0.8, 1.0]), (1.6, [0.02, 0.3, 1.0])]
    return check("variance of DDIM", attempt, right, cases, mistakes)


def check_attention(attempt: Function) -> bool:
    """Check ``attempt(query (N, d), key (M, d), value (M, c)) -> (N, c)``: one head, softmax(Q K^T / sqrt(d)) V."""

    def right(q, k, v):
        return F.scaled_dot_product_attention(*(torch.from_numpy(x)[None] for x in (q, k, v)))[0].numpy()

    def softmax(x, axis=1):
        return np.exp(x) / np.exp(x).sum(axis, keepdims=True)

    draw = np.random.default_rng(5)
    case = tuple(draw.normal(size=shape) for shape in ((5, 4), (5, 4), (5, 4)))
    other = tuple(draw.normal(size=shape) for shape in ((3, 6), (7, 6), (7, 2)))
    mistakes = {
        "the division by sqrt(d) is missing": lambda q, k, v: softmax(q @ k.T) @ v,
        "divide by sqrt(d), not by d": lambda q, k, v: softmax(q @ k.T / q.shape[1]) @ v,
        "the softmax runs over the queries; each query's weights must sum to 1": lambda q, k, v: (
            softmax(q @ k.T / q.shape[1] ** 0.5, axis=0) @ v
        ),
        "the softmax runs over all weights at once; each query's weights must sum to 1: axis": lambda q, k, v: (
            softmax(q @ k.T / q.shape[1] ** 0.5, axis=(0, 1)) @ v
        ),
        "the softmax is missing": lambda q, k, v: q @ k.T / q.shape[1] ** 0.5 @ v,
        "the division is by the number of keys, not by their width d": lambda q, k, v: (
            softmax(q @ k.T / len(k) ** 0.5) @ v
        ),
        "the weights are not normalised: divide by their sum": lambda q, k, v: np.exp(q @ k.T / q.shape[1] ** 0.5) @ v,
    }
    return check("attention", attempt, right, [case, other], mistakes)
