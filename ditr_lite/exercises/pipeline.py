"""Checkers for the exercises on the whole pipeline: normalised depth, what is known, what samples say, what it costs."""

import numpy as np

from .checker import Function, check


def check_normalise(attempt: Function) -> bool:
    """Check ``attempt(depth, low, high) -> depth_n``: log depth, low at -1 and high at 1, compressed beyond, 0 missing.

    With u the scaled logarithm it is u where abs(u) <= 1 and sign(u) (1 + ln abs(u)) beyond, as in
    ``conditioning.Bounds``.
    """

    def scaled(d, low, high):
        read = np.where(d > 0, d, 1.0)
        return (np.log(read) - np.log(low * high) / 2) / (np.log(high / low) / 2)

    def compressed(u):
        return np.where(np.abs(u) > 1, np.sign(u) * (1 + np.log(np.maximum(np.abs(u), 1))), u)

    def right(d, low, high):
        return np.where(d > 0, compressed(scaled(d, low, high)), 0.0)

    def jumping(u):
        return np.where(np.abs(u) > 1, np.sign(u) * np.log(np.maximum(np.abs(u), 1)), u)

    def linear(d, low, high):
        return 2 * (d - low) / (high - low) - 1

    rng = np.random.default_rng(3)
    depth = rng.uniform(0.5, 0.9, (5, 7))
    depth[0, :3], depth[2, 4], depth[4, 0] = 0, 6.0, 0.1  # missing; a room behind; a stray before
    mistakes = {
        "that is a straight line in metres: take the logarithm of depth": lambda d, a, b: np.where(
            d > 0, linear(d, a, b), 0.0
        ),
        "a straight line in metres, compressed: take the logarithm first": lambda d, a, b: np.where(
            d > 0, compressed(linear(d, a, b)), 0.0
        ),
        "what lies beyond the bounds is not compressed: a room would take up many units": lambda d, a, b: np.where(
            d > 0, scaled(d, a, b), 0.0
        ),
        "what lies beyond the bounds is clipped: it cannot be inverted": lambda d, a, b: np.where(
            d > 0, np.clip(scaled(d, a, b), -1, 1), 0.0
        ),
        "beyond the bounds the map jumps: it is 1 + ln(abs(u)), which is 1 at abs(u) = 1": lambda d, a, b: np.where(
            d > 0, jumping(scaled(d, a, b)), 0.0
        ),
        "only the far side is compressed; near strays need it, too": lambda d, a, b: np.where(
            d > 0, np.where(scaled(d, a, b) > 0, right(d, a, b), scaled(d, a, b)), 0.0
        ),
        "missing pixels (0) should become 0": lambda d, a, b: compressed(scaled(d, a, b)),
        "that maps to [0, 1]; low should become -1 and high 1": lambda d, a, b: np.where(
            d > 0, (right(d, a, b) + 1) / 2, 0.0
        ),
        "the sign is reversed: low should become -1": lambda d, a, b: -right(d, a, b),
        "the half range is ln(high / low) / 2: low becomes -1/2 with the whole": lambda d, a, b: np.where(
            d > 0, compressed(scaled(d, a, b) / 2), 0.0
        ),
        "the middle is the geometric mean, sqrt(low high), not the mean": lambda d, a, b: np.where(
            d > 0,
            compressed(scaled(d, a, b) + (np.log(a * b) / 2 - np.log((a + b) / 2)) / (np.log(b / a) / 2)),
            0.0,
        ),
    }
    cases = [(depth, 0.45, 0.95), (depth.T, 0.6, 0.8)]
    return check("normalisation", attempt, right, cases, mistakes, rtol=1e-5)


def check_given(attempt: Function) -> bool:
    """Check ``attempt(depth, region) -> (known, evidence)``, two (H, W) bool masks.

    ``known`` are the readings that count as depth, valid and outside the region (S9, mask times depth). ``evidence``
    are the readings inside it, which may be looked at and not believed.
    """

    def right(depth, region):
        return (depth > 0) & ~region, (depth > 0) & region

    rng = np.random.default_rng(6)
    depth = rng.uniform(0.4, 0.9, (6, 8)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = 0
    region = np.zeros(depth.shape, dtype=bool)
    region[1:4, 2:7] = True
    mistakes = {
        "the two masks are swapped: known comes first": lambda d, r: right(d, r)[::-1],
        "readings inside the region count as known: the wrong depth of the glass leaks in": lambda d, r: (
            d > 0,
            (d > 0) & r,
        ),
        "missing pixels (0) count as known depth": lambda d, r: (~r, (d > 0) & r),
        "missing pixels (0) count as evidence": lambda d, r: ((d > 0) & ~r, r),
        "missing pixels (0) count as readings, in both masks": lambda d, r: (~r, r),
        "evidence lies inside the region only": lambda d, r: ((d > 0) & ~r, d > 0),
        "known needs both, valid *and* outside the region": lambda d, r: ((d > 0) | ~r, (d > 0) & r),
        "valid means greater than 0: the comparison is the wrong way round": lambda d, r: ((d == 0) & ~r, (d == 0) & r),
    }
    return check("known and evidence", attempt, right, [(depth, region), (depth.T, region.T)], mistakes, rtol=0)


def check_spread(attempt: Function) -> bool:
    """Check ``attempt(depth, optical, geometric, region) -> (mean, std)``, both (H, W) metres, from S composed samples.

    ``optical`` and ``geometric`` are (S, H, W). Each sample is composed; ``mean`` is the average of the results and
    ``std`` their standard deviation with S - 1 in the denominator, 0 where depth was kept.
    """

    def composed(d, o, g, r):
        return np.stack([np.where(r, a, np.where(d > 0, d, b)) for a, b in zip(o, g, strict=True)]).astype(np.float64)

    def right(d, o, g, r):
        drawn = composed(d, o, g, r)
        kept = (d > 0) & ~r
        return np.where(kept, d, drawn.mean(0)), np.where(kept, 0, drawn.std(0, ddof=1))

    rng = np.random.default_rng(8)
    depth = rng.uniform(0.4, 0.9, (6, 8)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = 0
    region = np.zeros(depth.shape, dtype=bool)
    region[2:5, 2:6] = True
    optical, geometric = rng.uniform(0.4, 0.9, (2, 4, 6, 8)).astype(
        np.float32
    )  # four: the mean of equal numbers is exact
    mistakes = {
        "mean and std are swapped: mean comes first": lambda d, o, g, r: right(d, o, g, r)[::-1],
        "the spread of S samples divides by S - 1, not S: ddof=1": lambda d, o, g, r: (
            right(d, o, g, r)[0],
            composed(d, o, g, r).std(0),
        ),
        "that is the variance: take its root, so that it is in metres": lambda d, o, g, r: (
            right(d, o, g, r)[0],
            right(d, o, g, r)[1] ** 2,
        ),
        "the spread is in millimetres; metres are wanted": lambda d, o, g, r: (
            right(d, o, g, r)[0],
            1000 * right(d, o, g, r)[1],
        ),
        "kept readings have no spread: compose each sample first, then take the spread": lambda d, o, g, r: (
            right(d, o, g, r)[0],
            np.where(r, o.std(0, ddof=1), g.std(0, ddof=1)),
        ),
        "that is the first sample; average over all": lambda d, o, g, r: (
            composed(d, o, g, r)[0],
            right(d, o, g, r)[1],
        ),
        "the average runs over the image, not over the samples: axis 0": lambda d, o, g, r: (
            composed(d, o, g, r).mean(),
            composed(d, o, g, r).std(ddof=1),
        ),
        "the two branches are swapped": lambda d, o, g, r: right(d, g, o, r),
        "the region is inverted": lambda d, o, g, r: right(d, o, g, ~r),
        "valid readings outside the region are replaced; they must stay": lambda d, o, g, r: right(0 * d, o, g, r),
    }

    return check("mean and spread", attempt, right, [(depth, optical, geometric, region)], mistakes, rtol=1e-4)


def check_conv_flops(attempt: Function) -> bool:
    """Check ``attempt(channels_in, channels_out, kernel, height, width, stride)``: operations of a convolution.

    A multiply-add is two operations; height and width are those of the input, padded so that stride 1 keeps them and
    stride s divides them by s; the bias is not counted.
    """

    def right(cin, cout, k, h, w, s):
        return 2 * cin * cout * k * k * (h // s) * (w // s)

    cases = [(3, 8, 3, 24, 32, 1), (32, 64, 3, 48, 64, 2), (16, 4, 1, 12, 20, 1), (8, 8, 5, 30, 40, 2)]
    mistakes = {
        "a multiply-add is two operations: twice as many": lambda *a: right(*a) // 2,
        "that is four operations a multiply-add; it is two": lambda *a: 2 * right(*a),
        "the kernel is square: its side counts twice": lambda *a: right(*a) // a[2],
        "every output channel looks at every input channel: the product of both": lambda cin, cout, k, h, w, s: right(
            1, cout, k, h, w, s
        ),
        "one such sum for every output channel": lambda cin, cout, k, h, w, s: right(cin, 1, k, h, w, s),
        "channels multiply, they do not add": lambda cin, cout, k, h, w, s: right(cin + cout, 1, k, h, w, s),
        "a stride leaves fewer places to compute: divide both sides by it": lambda cin, cout, k, h, w, s: right(
            cin, cout, k, h, w, 1
        ),
        "the stride divides height *and* width": lambda cin, cout, k, h, w, s: s * right(cin, cout, k, h, w, s),
        "those are the weights of the convolution; each works at every place of the output": lambda *a: (
            right(*a[:3], 1, 1, 1) // 2
        ),
        "one operation more for the bias: it is not counted here": lambda cin, cout, k, h, w, s: (
            right(cin, cout, k, h, w, s) + cout * (h // s) * (w // s)
        ),
        "that is in GFLOPs; give operations": lambda *a: right(*a) / 1e9,
    }
    return check("operations of a convolution", attempt, right, cases, mistakes, rtol=1e-9)
