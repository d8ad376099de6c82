"""Can these numbers be? Tests that any table of depth scores must pass, from the numbers alone, rounding allowed for.

Three hold for every frame and therefore for every average that treats all its columns alike: RMSE >= MAE; the shares
d105 <= d110 <= d125; REL at least what the shares imply. One needs the parts of the image as well: the whole lies
between them. A table that breaks one is not wrong by that alone: it has averaged its columns in different ways, or
printed them under each other's names. Paper: Tables I to V.
"""

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np

from .tables import PARTS, Table

ROUNDING = (0.0005, 0.005)  # half of the last printed place: of metres and ratios, of per cent
TINY = 1e-9  # of binary fractions
SHARES = (("d105", 1.05), ("d110", 1.10), ("d125", 1.25))
LOWER_IS_BETTER = ("rmse", "mae", "rel")
Row = Mapping[str, float]


class Finding(NamedTuple):
    """One thing that cannot be: the row, the part of the image ("" for the only one), the test, the numbers."""

    row: str
    part: str
    test: str
    text: str


class Order(NamedTuple):
    """How well one order of columns explains a breakdown.

    Attributes:
        order: the metrics, left to right.
        possible: entries (method and part) with RMSE >= MAE, of ``entries``.
        between: entries (method and metric) whose whole lies between the parts, of ``pairs``.
        by_metric: the same per metric, each of as many as there are methods.
        misses: (method, metric) whose whole lies outside.
    """

    order: tuple[str, ...]
    possible: int
    entries: int
    between: int
    pairs: int
    by_metric: dict[str, int]
    misses: list[tuple[str, str]]


def audit_table(rows: Mapping[str, Row], rounding: tuple[float, float] = ROUNDING) -> list[Finding]:
    """Return what in a table of scores cannot be, if every column was averaged alike; an empty list is a clean bill.

    Args:
        rows: method -> {metric: number}, metrics rmse, mae, rel (metres, ratio), d105, d110, d125 (per cent), other
            entries are ignored; "geometric.rmse" is the RMSE of one part. ``tables.T1.records()`` is one, and so is
            {"ours": metrics.average(...)["optical"]}.
        rounding: half of the last printed place, of metres and ratios and of per cent; (0, 0) for exact numbers.

    Raises:
        ValueError: for no rows, or a number that is negative or not finite.
    """
    if not rows:
        raise ValueError("nothing to audit: give a mapping from method name to {metric: number}")
    half, half_share = rounding
    findings = []
    for name, row in rows.items():
        for part, v in _by_part(name, row).items():
            found = []
            if {"rmse", "mae"} <= set(v) and v["mae"] - v["rmse"] > 2 * half + TINY:
                found.append(("rmse >= mae", f"RMSE {v['rmse']:g} is below MAE {v['mae']:g}"))
            shares = [(key, v[key]) for key, _ in SHARES if key in v]
            for (low, a), (high, b) in zip(shares[:-1], shares[1:], strict=True):
                if a - b > 2 * half_share + TINY:
                    found.append(("shares rise", f"{low} {a:g} % is above {high} {b:g} %"))
            found += [("share <= 100 %", f"{key} is {x:g} %") for key, x in shares if x - half_share > 100 + TINY]
            if len(shares) == len(SHARES) and "rel" in v and not found:
                floor = rel_floor(*(x for _, x in shares), rounding=half_share)
                if v["rel"] + half < floor - TINY:
                    found.append(("rel >= bands", f"REL {v['rel']:g} is below {floor:.4f}, what the shares imply"))
            findings += [Finding(name, part, *f) for f in found]
    return findings


def rel_floor(d105: float, d110: float, d125: float, worded: bool = False, rounding: float = 0.0) -> float:
    """Return the least REL that shares of pixels, in per cent, allow: the sum of (share in a band x the band's floor).

    Paper: Sec. V-B. A pixel that fails the threshold t has |p - g| / g >= t - 1 under the paper's wording; under the
    field's definition, max(p/g, g/p) >= t, it may also be too near by the smaller 1 - 1/t.

    Args:
        d105: per cent; d110 and d125 likewise.
        d110: see d105.
        d125: see d105.
        worded: use the paper's wording instead of the field's definition.
        rounding: half of the last printed place of the shares, in per cent, used in their favour.
    """
    a, b, c = ((t - 1) if worded else (1 - 1 / t) for _, t in SHARES)
    floor = (d110 - d105) * a + (d125 - d110) * b + (100 - d125) * c
    return (floor - c * rounding) / 100  # the coefficients of the three shares are a, b - a, c - b: together c


def below_rel_floor(rows: Mapping[str, Row], worded: bool, rounding: tuple[float, float] = ROUNDING) -> list[str]:
    """Return the methods whose REL is below :func:`rel_floor`, by one or the other reading of delta."""
    return [
        name
        for name, v in rows.items()
        if v["rel"] + rounding[0] < rel_floor(*(v[key] for key, _ in SHARES), worded=worded, rounding=rounding[1])
    ]


def rank_orders(parts: Table, whole: Table, rounding: float = 0.0) -> list[Order]:
    """Try every order of the three columns of a breakdown and return them, the best explanation first.

    Two tests: RMSE >= MAE in every entry, and "the whole lies between its parts" for every method and metric. The
    second holds for pooled scores, and for means over images if one part is the harder one in all of them.

    Args:
        parts: a breakdown like T5.
        whole: the same methods on the whole image, like T1.
        rounding: half of the last printed place, used in favour of the table; 0 takes the numbers as printed.

    Raises:
        ValueError: when the tables have no method in common.
    """
    wholes = whole.records()
    common = [name for name in parts.rows if name in wholes]
    if not common:
        raise ValueError(f"{parts.name} and {whole.name} have no method in common")
    orders = []
    for order in permutations(LOWER_IS_BETTER):
        rows = parts.reordered(order).records()
        pairs = [(rows[n][f"{p}.rmse"], rows[n][f"{p}.mae"]) for n in parts.rows for p in PARTS]
        possible = sum(rmse + rounding >= mae - rounding for rmse, mae in pairs)
        misses = [
            (name, metric)
            for name in common
            for metric in LOWER_IS_BETTER
            if not _between(wholes[name][metric], [rows[name][f"{p}.{metric}"] for p in PARTS], 2 * rounding)
        ]
        by_metric = {m: len(common) - sum(metric == m for _, metric in misses) for m in LOWER_IS_BETTER}
        orders.append(Order(order, possible, len(pairs), sum(by_metric.values()), 3 * len(common), by_metric, misses))
    return sorted(orders, key=lambda o: -(o.possible / o.entries + o.between / o.pairs))


def implied_weight(
    whole: float, inside: float, outside: float, power: int = 1, rounding: float = 0.0
) -> tuple[float, float, float]:
    """Return (low, value, high): the weight, 0 to 1, of the inside pixels that turns two parts into the whole.

    whole^p = w inside^p + (1 - w) outside^p, with p = 1 for MAE and REL and p = 2 for RMSE.

    Args:
        whole: score of all pixels.
        inside: score of the part whose weight is sought.
        outside: score of the other part.
        power: p.
        rounding: half of the last printed place; low and high are the extremes over it, clipped to 0 to 1.

    Raises:
        ValueError: when the parts cannot be told apart.
    """
    if abs(inside - outside) <= 2 * rounding:
        raise ValueError(f"the parts {inside:g} and {outside:g} are equal up to rounding: any weight would do")
    signs = np.array(np.meshgrid(*[[-rounding, rounding]] * 3)).reshape(3, -1)
    w, i, o = (np.clip(x + s, 0, None) ** power for x, s in zip((whole, inside, outside), signs, strict=True))
    low, high = np.clip([((w - o) / (i - o)).min(), ((w - o) / (i - o)).max()], 0, 1)
    return float(low), (whole**power - outside**power) / (inside**power - outside**power), float(high)


def beaten_in(rows: Mapping[str, Row], name: str, metrics: Sequence[str] | None = None) -> dict[str, str]:
    """Return {metric: the method that is better} wherever ``name`` is not the best of the table; ties are no defeat.

    Raises:
        ValueError: when the table has no such row.
    """
    if name not in rows:
        raise ValueError(f"no row {name!r}; the table has {', '.join(rows)}")
    beaten = {}
    for metric in metrics or rows[name]:
        sign = 1 if metric.split(".")[-1] in LOWER_IS_BETTER else -1
        best = min(rows, key=lambda other: sign * rows[other][metric])
        if sign * rows[best][metric] < sign * rows[name][metric]:
            beaten[metric] = best
    return beaten


def _between(whole: float, parts: Sequence[float], slack: float) -> bool:
    return min(parts) - slack - TINY <= whole <= max(parts) + slack + TINY


def _by_part(name: str, row: Row) -> dict[str, dict[str, float]]:
    """Return {part: {metric: number}} of one row, the part "" for columns without one."""
    parts: dict[str, dict[str, float]] = {}
    for column, value in row.items():
        part, _, metric = column.rpartition(".")
        if metric in (*LOWER_IS_BETTER, *(key for key, _ in SHARES)):
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{name}, {column}: expected a number >= 0, got {value}; leave the entry out instead")
            parts.setdefault(part, {})[metric] = float(value)
    return parts
