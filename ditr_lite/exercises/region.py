"""Checkers for the exercises on stage one: refinement, its two errors, its losses, its learning rate, its gradient."""

import math

import numpy as np
import torch

from .. import metrics
from ..config import RefineConfig
from ..region import CrossModalFusion, refine_region
from ..training.as_the_paper import paper_learning_rate
from ..training.finetune import soft_compose, soft_region
from .checker import Function, check


def _sigmoid(x):
    return 1 / (1 + np.exp(-x))


def check_growth(attempt: Function) -> bool:
    """Check ``attempt(dilate, iterations) -> pixels`` by which a region grows on each side (S2)."""

    def right(dilate, iterations):
        mask = np.zeros((1, 201), bool)
        mask[0, :101] = True
        return int(refine_region(mask, 0, dilate, iterations).sum() - mask.sum())

    mistakes = {
        "half the kernel lies on each side: (dilate - 1) / 2 an iteration": lambda d, n: d * n,
        "that is both sides together": lambda d, n: (d - 1) * n,
        "a 5 x 5 kernel reaches 2 pixels: its middle does not count": lambda d, n: (d + 1) // 2 * n,
        "each iteration grows what the one before has grown: multiply": lambda d, n: d // 2,
        "that is the side of the one kernel that does the same at once": lambda d, n: (d - 1) * n + 1,
    }
    return check("growth", attempt, right, [(5, 3), (3, 1), (7, 2), (3, 4)], mistakes, rtol=1e-9)


def check_miss_and_area(attempt: Function) -> bool:
    """Check ``attempt(found, true) -> (miss rate, area ratio)`` of two (H, W) bool masks, in shares, not per cent."""

    def right(found, true):
        return metrics.miss_rate(found, true), metrics.area_ratio(found, true)

    true = np.zeros((8, 10), bool)
    true[2:6, 2:7] = True
    found = np.roll(true, (1, 2), (0, 1))
    found[7] = True
    mistakes = {
        "the two are swapped: the miss rate comes first": lambda f, t: right(f, t)[::-1],
        "that is per cent; shares are wanted": lambda f, t: tuple(100 * x for x in right(f, t)),
        "the missed pixels are divided by the found area: divide by the true one": lambda f, t: (
            (t & ~f).sum() / f.sum(),
            right(f, t)[1],
        ),
        "those are false alarms: found, not true": lambda f, t: ((f & ~t).sum() / t.sum(), right(f, t)[1]),
        "that is the share that was found; the missed share is 1 minus it": lambda f, t: (
            1 - right(f, t)[0],
            right(f, t)[1],
        ),
        "the area ratio is upside down: found over true": lambda f, t: (right(f, t)[0], 1 / right(f, t)[1]),
        "the missed pixels are divided by the whole picture": lambda f, t: ((t & ~f).mean(), right(f, t)[1]),
    }
    return check("miss rate and area", attempt, right, [(found, true), (true[::-1], found)], mistakes)


def check_learning_rate(attempt: Function) -> bool:
    """Check ``attempt(epoch, epochs, peak, fall) -> rate``: half a cosine times an exponential (S3)."""

    def right(epoch, epochs, peak, fall):
        return paper_learning_rate(epoch, 0, epochs, peak, fall)

    mistakes = {
        "the exponential factor is missing": lambda e, n, p, f: right(e, n, p, 0),
        "the cosine factor is missing": lambda e, n, p, f: p * math.exp(-f * e / n),
        "the half is missing: at epoch 0 the rate is the peak": lambda e, n, p, f: 2 * right(e, n, p, f),
        "a whole period of the cosine comes back up: use pi, not 2 pi": lambda e, n, p, f: (
            p * (1 + math.cos(2 * math.pi * e / n)) / 2 * math.exp(-f * e / n)
        ),
        "the factors are multiplied, not added": lambda e, n, p, f: (
            p * ((1 + math.cos(math.pi * e / n)) / 2 + math.exp(-f * e / n)) / 2
        ),
        "`fall` stands in the place of ln 10: use it in the exponent": lambda e, n, p, f: right(e, n, p, math.log(10)),
        "the exponential must fall: its sign": lambda e, n, p, f: right(e, n, p, -f),
        "the exponential falls over all epochs, not in every one: divide by epochs": lambda e, n, p, f: (
            right(e, n, p, 0) * math.exp(-f * e)
        ),
        "the cosine is shifted by 1: without that the rate turns negative": lambda e, n, p, f: (
            p * math.cos(math.pi * e / n) * math.exp(-f * e / n)
        ),
    }
    return check("learning rate", attempt, right, [(3, 20, 0.1, 2.3), (11, 20, 0.01, 1.0)], mistakes)


def check_dice(attempt: Function) -> bool:
    """Check ``attempt(p, t) -> loss``: soft Dice, 1 - (2 sum(p t) + 1) / (sum(p + t) + 1)."""

    def right(p, t):
        return 1 - (2 * (p * t).sum() + 1) / ((p + t).sum() + 1)

    mistakes = {
        "that is the score; the loss is 1 minus it": lambda p, t: 1 - right(p, t),
        "the 2 is missing: the overlap stands in both masks": lambda p, t: (
            1 - ((p * t).sum() + 1) / ((p + t).sum() + 1)
        ),
        "the + 1 is missing: an absent class would divide by 0": lambda p, t: 1 - 2 * (p * t).sum() / (p + t).sum(),
        "that is intersection over union, not Dice": lambda p, t: 1 - ((p * t).sum() + 1) / ((p + t - p * t).sum() + 1),
        "the probability must not be thresholded: it would have no gradient": lambda p, t: right(p > 0.5, t),
        "means instead of sums: + 1 then outweighs the picture": lambda p, t: (
            1 - (2 * (p * t).mean() + 1) / ((p + t).mean() + 1)
        ),
    }
    rng = np.random.default_rng(2)
    p = rng.random((6, 7))
    t = (rng.random((6, 7)) < 0.3).astype(float)
    return check("Dice", attempt, right, [(p, t), (p**3, 1 - t)], mistakes)


def check_fusion(attempt: Function) -> bool:
    """Check ``attempt(rgb, depth, w_rgb, w_depth) -> fused``: the cross-modal gates at one pixel.

    Features are (C,), weights (C, C). ``w_rgb`` makes the gate that is applied to ``rgb`` and reads ``depth``.
    """

    def right(rgb, depth, w_rgb, w_depth):
        block = CrossModalFusion(len(rgb)).double()
        for conv, weight in ((block.gate_rgb, w_rgb), (block.gate_depth, w_depth)):
            conv.weight.data = torch.from_numpy(weight)[:, :, None, None]
            torch.nn.init.zeros_(conv.bias)
        with torch.no_grad():
            return block(*(torch.from_numpy(x)[None, :, None, None] for x in (rgb, depth)))[0, :, 0, 0].numpy()

    def gates(own_rgb, own_depth, gate=_sigmoid, join=lambda a, b: a + b):
        return lambda r, d, w, v: join(r * gate(w @ own_rgb(r, d)), d * gate(v @ own_depth(r, d)))

    def first(r, d):
        return r

    def second(r, d):
        return d

    mistakes = {
        "each gate reads its own modality: it should read the other one": gates(first, second),
        "the sigmoid is missing: a gate lies between 0 and 1": gates(second, first, gate=lambda x: x),
        "the gates are swapped: w_rgb is applied to rgb": lambda r, d, w, v: right(r, d, v, w),
        "there are no gates: that is plain addition": lambda r, d, w, v: r + d,
        "one gate and 1 minus it: each modality has a gate of its own": lambda r, d, w, v: (
            r * _sigmoid(w @ d) + d * (1 - _sigmoid(w @ d))
        ),
        "the two are added, not concatenated": gates(second, first, join=lambda a, b: np.concatenate([a, b])),
        "the weights are transposed: each output channel is a row": lambda r, d, w, v: right(
            r, d, w.T.copy(), v.T.copy()
        ),
        "both are halved: the gates need not sum to 1": lambda r, d, w, v: right(r, d, w, v) / 2,
    }
    rng = np.random.default_rng(2)
    cases = [(*rng.normal(size=(2, 4)), *rng.normal(size=(2, 4, 4))) for _ in range(2)]
    return check("cross-modal fusion", attempt, right, cases, mistakes)


def check_region_gradient(attempt: Function) -> bool:
    """Check ``attempt(m, optical, kept, truth) -> dL/dm`` of L = mean((m optical + (1 - m) kept - truth)^2), (N,)."""

    def right(m, optical, kept, truth):
        t = [torch.from_numpy(x.copy()) for x in (m, optical, kept, truth)]
        t[0].requires_grad_()
        loss = (soft_compose(t[0], t[2], torch.ones_like(t[2]), t[1], 0 * t[1]) - t[3]).square().mean()
        return torch.autograd.grad(loss, t[0])[0].numpy()

    def error(m, o, k, y):
        return m * o + (1 - m) * k - y

    mistakes = {
        "the sign of the inner derivative: m raises optical and lowers kept": lambda m, o, k, y: -right(m, o, k, y),
        "the inner derivative optical - kept is missing": lambda m, o, k, y: 2 * error(m, o, k, y) / m.size,
        "kept falls as m rises: the inner derivative is optical - kept": lambda m, o, k, y: (
            2 * error(m, o, k, y) * o / m.size
        ),
        "the 2 of the square is missing": lambda m, o, k, y: right(m, o, k, y) / 2,
        "the mean divides by N": lambda m, o, k, y: right(m, o, k, y) * m.size,
        "that is averaged over the pixels: every pixel has a derivative of its own": lambda m, o, k, y: right(
            m, o, k, y
        ).mean(),
    }
    rng = np.random.default_rng(2)
    cases = [(rng.random(6), *rng.uniform(0.4, 0.9, (3, 6))) for _ in range(2)]
    return check("gradient of the region", attempt, right, cases, mistakes)


def check_soft_refine(attempt: Function) -> bool:
    """Check ``attempt(p, steepness) -> m``, (H, W): soft threshold, soft 3x3 vote, 3x3 maximum; borders repeated."""

    def right(p, steepness):
        return soft_region(torch.from_numpy(p)[None, None], RefineConfig(3, 3, 1), steepness)[0, 0].numpy()

    def windows(x, border="edge"):
        return np.lib.stride_tricks.sliding_window_view(np.pad(x, 1, border), (3, 3))

    def step(x, k, middle=0.5):
        return _sigmoid(k * (x - middle))

    mistakes = {
        "the first threshold is missing": lambda p, k: windows(step(windows(p).mean((2, 3)), k)).max((2, 3)),
        "the vote is missing its threshold: a mean is no majority": lambda p, k: windows(
            windows(step(p, k)).mean((2, 3))
        ).max((2, 3)),
        "the vote is left out": lambda p, k: windows(step(p, k)).max((2, 3)),
        "the dilation is left out": lambda p, k: step(windows(step(p, k)).mean((2, 3)), k),
        "borders are repeated: cv2.blur mirrors them unless told borderType=cv2.BORDER_REPLICATE": lambda p, k: windows(
            step(windows(step(p, k), "reflect").mean((2, 3)), k)
        ).max((2, 3)),
        "borders are repeated: it is not 0 beyond them": lambda p, k: windows(
            step(windows(step(p, k), "constant").mean((2, 3)), k)
        ).max((2, 3)),
        "the dilation comes last; here it comes before the vote": lambda p, k: step(
            windows(windows(step(p, k)).max((2, 3))).mean((2, 3)), k
        ),
        "the threshold lies at 1/2, not at 0": lambda p, k: windows(
            step(windows(step(p, k, 0)).mean((2, 3)), k, 0)
        ).max((2, 3)),
        "that takes the minimum, which shrinks": lambda p, k: windows(step(windows(step(p, k)).mean((2, 3)), k)).min(
            (2, 3)
        ),
        "the hard threshold has no gradient: use the sigmoid": lambda p, k: refine_region(p > 0.5, 3, 3, 1) * 1.0,
        "the steepness is not used": lambda p, k: right(p, 1.0),
    }
    rng = np.random.default_rng(2)
    cases = [(rng.random((7, 8)), 8.0), (rng.random((6, 5)), 20.0)]
    return check("soft refinement", attempt, right, cases, mistakes)
