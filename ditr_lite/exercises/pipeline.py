"""Checkers for the exercises on the whole pipeline: windows, what is known, what samples say, what it costs."""

from functools import partial

import numpy as np

from .checker import Function, check


def check_square(attempt: Function) -> bool:
    """Check ``attempt(box, shape) -> (top, left, side)``: the window of a blob, as ``windows.square`` gives it.

    ``box`` is (top, left, bottom, right) with exclusive ends, ``shape`` (H, W). The side is twice the longer side of
    the box, at least a fifth of the frame's longer side and at most that side; the square has the box in its middle
    and is moved into the frame. In all cases it fits there, and no rounding is needed: all three numbers are whole.
    """

    def wish(box, shape, margin=2, least=0.2, of_box=max, of_frame=max):
        return round(max(margin * of_box(box[2] - box[0], box[3] - box[1]), least * of_frame(shape)))

    def side_of(box, shape, **settings):
        return min(wish(box, shape, **settings), max(shape))

    def corner(box, side):
        return np.array([(box[0] + box[2] - side) // 2, (box[1] + box[3] - side) // 2])

    def right(box, shape, side=None):
        side = side_of(box, shape) if side is None else side
        top, left = np.clip(corner(box, side), 0, np.array(shape) - side)
        return np.array([top, left, side])

    def with_side(find):
        return lambda box, shape: right(box, shape, min(find(box, shape), max(shape)))

    def unbounded(box, shape):
        side = wish(box, shape)
        return np.array([*np.maximum(np.minimum(corner(box, side), np.array(shape) - side), 0), side])

    def about(middle):
        def attempt(box, shape):
            side = side_of(box, shape)
            return np.array([*np.clip(middle(np.array(box), side), 0, np.array(shape) - side), side])

        return attempt

    cases = [
        ((40, 60, 60, 130), (200, 300)),  # wide
        ((10, 100, 90, 130), (200, 300)),  # tall, near the upper border
        ((180, 280, 190, 292), (200, 300)),  # small, in a corner: the least side counts
        ((40, 20, 120, 260), (300, 300)),  # wider than half the frame: the largest side counts
    ]
    mistakes = {
        "it must lie in the frame: move it, without changing its side": lambda b, s: np.array(
            [*corner(b, side_of(b, s)), side_of(b, s)]
        ),
        "the side is twice the *longer* side of the box": with_side(partial(wish, of_box=min)),
        "the side is twice the box's height: a wide blob would not fit": with_side(
            partial(wish, of_box=lambda height, width: height)
        ),
        "the side is twice the box's width: a tall blob would not fit": with_side(
            partial(wish, of_box=lambda height, width: width)
        ),
        "there is no room around the blob: the side is twice that of the box": with_side(partial(wish, margin=1)),
        "the side is at least a fifth of the frame's longer side": with_side(partial(wish, least=0)),
        "the side is at most the frame's longer side": unbounded,
        "a fifth of the frame's *longer* side, not of the shorter": with_side(partial(wish, of_frame=min)),
        "the box should lie in the middle, not in the upper left corner": about(lambda b, side: b[:2]),
        "rows and columns are swapped": lambda b, s: right(b, s)[[1, 0, 2]],
        "the order is top, left, side": lambda b, s: right(b, s)[[2, 0, 1]],
        "that are the ends of the square; top, left and side are wanted": lambda b, s: np.array(
            [*right(b, s)[:2], *(right(b, s)[:2] + right(b, s)[2])]
        ),
    }
    return check("window of a blob", attempt, right, cases, mistakes, rtol=1e-9)


def check_given(attempt: Function) -> bool:
    """Check ``attempt(depth, region) -> (known, evidence)``, two (H, W) bool masks.

    ``known`` are the readings that count as depth, valid and outside the region (our reading of mask times depth);
    ``evidence`` are the readings inside it, which may be looked at and not believed.
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
        "that is the median over the samples; the mean is wanted": lambda d, o, g, r: (
            np.median(composed(d, o, g, r), axis=0),
            right(d, o, g, r)[1],
        ),
        "that is the uncertainty of the mean: do not divide the spread by the root of S": lambda d, o, g, r: (
            right(d, o, g, r)[0],
            right(d, o, g, r)[1] / np.sqrt(len(o)),
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

    All are whole numbers. A multiply-add is two operations; height and width are those of the input, padded so that
    stride 1 keeps them and stride s, by which both can be divided, divides them by s; the bias is not counted.
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
        "the input is padded: stride 1 keeps height and width": lambda cin, cout, k, h, w, s: (
            2 * cin * cout * k * k * ((h - k) // s + 1) * ((w - k) // s + 1)
        ),
        "that is in GFLOPs; give operations": lambda *a: right(*a) / 1e9,
    }
    return check("operations of a convolution", attempt, right, cases, mistakes, rtol=1e-9)
