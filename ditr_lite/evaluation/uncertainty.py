"""Does the system know where it is wrong? Coverage, reliability and risk against coverage of a stated error.

RMSE asks only for the mean. These scores ask whether the stated error is the true one, and whether it puts bad pixels
last. Not in the paper.
"""

from collections.abc import Mapping, Sequence
from math import erf, pi, sqrt
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar, nnls
from scipy.special import logsumexp
from scipy.stats import norm

from ..data import Sample

KEPT = "kept"  # readings that were not painted
HELD_OUT = ("test", "rooms")  # splits that nothing is fitted on
GARBAGE = 0.25  # a reading off by a larger share of its depth is a stray


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


def coverages(
    error: np.ndarray, std: np.ndarray, times: Sequence[float] = (0.25, 0.5, 1, 1.5, 2, 3)
) -> list[tuple[float, float, float]]:
    """Return (times, share expected of Gaussian errors, share observed) for several multiples of the stated error."""
    return [(float(k), erf(k / sqrt(2)), coverage(error, std, k)) for k in times]


def reliability(spread: np.ndarray, error: np.ndarray, bins: int = 8) -> np.ndarray:
    """Return (2, bins): root mean square spread and error of bins of equal count, smallest spread first.

    Calibrated draws have both alike in every bin. Pixels that do not fill the last bin are left out.

    Raises:
        ValueError: for lists of different lengths, or fewer pixels than bins.
    """
    if spread.shape != error.shape or bins < 1 or spread.size < bins:
        raise ValueError(f"expected spread and error of the same pixels, at least {bins}: {spread.shape} {error.shape}")
    order = np.argsort(spread, kind="stable")[: spread.size // bins * bins]
    return np.sqrt((np.stack([spread, error])[:, order].reshape(2, bins, -1) ** 2).mean(axis=2))


def risk_coverage(error: np.ndarray, std: np.ndarray, points: int = 20) -> list[tuple[float, float, float]]:
    """Return (share kept, RMSE of the kept, RMSE of the best choice), keeping the pixels of least stated error first.

    The best choice would sort by the error itself. A stated error that knows nothing gives a level curve.

    Returns:
        ``points`` rows, from 1 / points to 1; metres.
    """
    shares = [k / points for k in range(1, points + 1)]
    curves = (risk(key, error, shares) for key in (std, np.abs(error)))
    return list(zip(shares, *(curve.tolist() for curve in curves), strict=True))


def risk(score: np.ndarray, error: np.ndarray, kept: Sequence[float]) -> np.ndarray:
    """Return the RMSE of what is left when the pixels with the largest ``score`` are dropped, per share ``kept``.

    With the stated error as score: what doubt is worth. With ``|error|``: the best that any doubt could be worth.

    Raises:
        ValueError: for arrays of different shape, or empty ones.
    """
    error, score = _pair(error, score)
    square = error[np.argsort(score, kind="stable")].astype(np.float64) ** 2
    running = np.cumsum(square) / np.arange(1, len(square) + 1)
    return np.sqrt(running[[max(1, round(share * len(square))) - 1 for share in kept]])


def honesty(expected: float, real: float) -> str:
    """Return in words how an expected error compares with the real one: within a factor of 1.4 it is about right."""
    if expected * 1.4 < real:
        return "too sure"
    return "too unsure" if expected > 1.4 * real else "about right"


def gaussian_crps(error: np.ndarray, std: np.ndarray) -> float:
    """Return the mean CRPS of a Gaussian about the prediction, in metres (Gneiting and Raftery 2007, Sec. 4.2)."""
    error, std = _pair(error, std)
    z = error / std
    return float((std * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / sqrt(pi))).mean())


def check_fitted_on(splits: Sequence[str]) -> None:
    """Refuse to fit constants on scenes that are there to test them.

    Raises:
        ValueError: for the test splits.
    """
    if held := [name for name in splits if name in HELD_OUT]:
        raise ValueError(f"{held[0]} is held out: fit on validation scenes, e.g. val rooms_val, and check on it")


def kinds_of_pixels(region: np.ndarray, depth: np.ndarray) -> dict[str, np.ndarray]:
    """Return which pixels each branch painted and which were kept: "optical", "geometric" and "kept", (H, W) bool.

    Args:
        region: (H, W) bool, as the system used it.
        depth: (H, W) raw metres, 0 = missing.
    """
    read = depth > 0
    return {"optical": region, "geometric": ~region & ~read, KEPT: ~region & read}


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


def fit_kept(error: np.ndarray, depth: np.ndarray, doubt: np.ndarray) -> tuple[float, float]:
    """Fit (kept, missed) of depth * sqrt(kept^2 + p missed^2), see ``config.StdConfig``, of readings that were kept.

    Least squares of the squared relative error against 1 and p, neither being negative: what a reading is off on plain
    surfaces, and what more on glass that stage one has missed. Readings off by more than :data:`GARBAGE` of their
    depth say nothing about either and are left out.

    Args:
        error: (N,) metres.
        depth: (N,) metres.
        doubt: (N,) in [0, 1], stage one's probability of glass.
    """
    error, depth = _pair(error, depth)
    error, doubt = _pair(error, doubt)
    square = (error / depth).astype(np.float64) ** 2
    sound = square < GARBAGE**2
    square, doubt = square[sound], doubt[sound].astype(np.float64)
    found, _ = nnls(np.stack([np.ones_like(square), doubt], axis=1), square)
    return float(np.sqrt(found[0])), float(np.sqrt(found[1]))


def fit_temperature(log_probability: np.ndarray, true: np.ndarray) -> float:
    """Return the temperature by which stage one's logits must be divided so that its probability means what it says.

    One scalar, the least cross-entropy of the two classes merged (Guo et al. 2017, Sec. 4.2).

    Args:
        log_probability: (C, N) logarithms of the classes' probabilities at temperature 1, the background first.
        true: (N,) bool, transparent or reflective.

    Raises:
        ValueError: for arrays that do not fit together, or fewer than two classes.
    """
    logs, true = np.asarray(log_probability, np.float64), np.asarray(true)
    if logs.ndim != 2 or len(logs) < 2 or true.shape != logs.shape[1:] or not true.size:
        raise ValueError(f"expected (C, N) of at least 2 classes and (N,) with N >= 1, got {logs.shape}, {true.shape}")

    def cross_entropy(log: float) -> float:
        scaled = logs * np.exp(-log)
        chosen = np.where(true, logsumexp(scaled[1:], axis=0), scaled[0])
        return float((logsumexp(scaled, axis=0) - chosen).mean())

    return float(np.exp(minimize_scalar(cross_entropy, bounds=(-2.0, 3.0), method="bounded").x))


def spread_and_error(drawn: Sequence[np.ndarray], samples: Sequence[Sample]) -> tuple[np.ndarray, np.ndarray]:
    """Return the spread (N,) of the draws and the signed error (N,) of their mean, metres, of all region pixels."""
    parts = []
    for members, sample in zip(drawn, samples, strict=True):
        known = sample.region & (sample.depth_gt > 0)
        parts.append((members.std(axis=0, ddof=1)[known], (members.mean(axis=0) - sample.depth_gt)[known]))
    spread, error = (np.concatenate(values) for values in zip(*parts, strict=True))
    return spread, error


def _pair(error: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    error, std = np.asarray(error), np.asarray(std)
    if error.shape != std.shape or error.ndim != 1 or not error.size:
        raise ValueError(f"expected two arrays (N,) with N >= 1, got {error.shape} and {std.shape}")
    return error, std


def coverage_columns(report: Mapping[str, Any]) -> dict[str, list[float] | list[str]]:
    """Return the columns of a table: how many per cent of the errors lie within how many stated standard deviations.

    Args:
        report: the committed results called ``calibration``.
    """
    columns: dict[str, list] = {}
    for place in report["calibrated"]:
        for how in _stated(report, place):
            times, due, seen = zip(*report[how][place]["reliability"], strict=True)
            columns.setdefault("within", [f"{k:g} std" for k in times])
            columns.setdefault("Gaussian", [100 * share for share in due])
            columns[f"{place}, {how.removesuffix(' alone')}"] = [100 * share for share in seen]
    return columns


def risk_curves(report: Mapping[str, Any]) -> dict[str, dict[str, tuple]]:
    """Return kind of pixel -> name of a curve -> shares of the surest pixels, and their RMSE in metres.

    Args:
        report: the committed results called ``calibration``.
    """
    curves: dict[str, dict[str, tuple]] = {}
    for place in report["calibrated"]:
        curves[place] = {}
        for how in _stated(report, place):
            share, risk, best = zip(*report[how][place]["risk_coverage"], strict=True)
            curves[place][how] = share, risk
        curves[place]["oracle"] = share, best
    return curves


def _stated(report: Mapping[str, Any], place: str) -> list[str]:
    """Return which statements there are of a kind of pixel; where readings are kept, samples do not differ."""
    return ["calibrated"] if place == KEPT else ["spread alone", "calibrated"]
