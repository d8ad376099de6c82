"""Does the system know where it is wrong? Coverage, reliability and risk against coverage of a stated error.

RMSE asks only for the mean. These scores ask whether the stated error is the true one, and whether it puts bad pixels
last. Not in the paper.
"""

from collections.abc import Sequence
from math import erf, pi, sqrt

import numpy as np
from scipy.optimize import minimize
from scipy.stats import norm


def coverage(error: np.ndarray, std: np.ndarray, times: float = 1.0) -> float:
    """Return the share of errors no larger than ``times`` the stated standard deviation.

    Args:
        error: (N,) metres, signed or not.
        std: (N,) metres.
        times: 1 should cover 68 % of Gaussian errors, 2 95 %.

    Raises:
        ValueError: for arrays of different shape, or empty ones.
    """
    error, std = _pair(error, std)
    return float((np.abs(error) <= times * std).mean())


def reliability(
    error: np.ndarray, std: np.ndarray, times: Sequence[float] = (0.25, 0.5, 1, 1.5, 2, 3)
) -> list[tuple[float, float, float]]:
    """Return (times, share expected of Gaussian errors, share observed) for several multiples of the stated error."""
    return [(float(k), erf(k / sqrt(2)), coverage(error, std, k)) for k in times]


def risk_coverage(error: np.ndarray, std: np.ndarray, points: int = 20) -> list[tuple[float, float, float]]:
    """Return (share kept, RMSE of the kept, RMSE of the best choice), keeping the pixels of least stated error first.

    The best choice would sort by the error itself. A stated error that knows nothing gives a level curve.

    Returns:
        ``points`` rows, from 1 / points to 1; metres.
    """
    error, std = _pair(error, std)
    orders = [np.argsort(key, kind="stable") for key in (std, np.abs(error))]
    sums = [np.cumsum(np.square(error[order], dtype=np.float64)) for order in orders]
    rows = []
    for k in range(1, points + 1):
        count = max(1, round(len(error) * k / points))
        rows.append((k / points, *(float(np.sqrt(s[count - 1] / count)) for s in sums)))
    return rows


def gaussian_crps(error: np.ndarray, std: np.ndarray) -> float:
    """Return the mean CRPS of a Gaussian about the prediction, in metres (Gneiting and Raftery 2007, Sec. 4.2)."""
    error, std = _pair(error, std)
    z = error / std
    return float((std * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / sqrt(pi))).mean())


def fit_error(error: np.ndarray, spread: np.ndarray, depth: np.ndarray) -> tuple[float, float]:
    """Fit (base, factor) of sqrt((base depth)^2 + (factor spread)^2), see ``config.StdConfig``, by least CRPS.

    CRPS, not likelihood: a few gross errors would stretch a Gaussian's likelihood until it fitted nobody.

    Args:
        error: (N,) metres.
        spread: (N,) metres, over samples.
        depth: (N,) metres.
    """
    error, spread = _pair(error, spread)

    def cost(logs: np.ndarray) -> float:
        base, factor = np.exp(logs)
        return gaussian_crps(error, np.hypot(base * depth, factor * spread))

    found = minimize(cost, np.log([0.02, 2.0]), method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-8})
    base, factor = np.exp(found.x)
    return float(base), float(factor)


def _pair(error: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    error, std = np.asarray(error), np.asarray(std)
    if error.shape != std.shape or error.ndim != 1 or not error.size:
        raise ValueError(f"expected two arrays (N,) with N >= 1, got {error.shape} and {std.shape}")
    return error, std
