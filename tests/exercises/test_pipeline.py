"""The right answer passes; every planted mistake fails with a message that names it."""

import numpy as np
import torch
from checker_cases import checker_tests

from ditr_lite import conditioning, pipeline, windows
from ditr_lite.evaluation.costs import count_flops
from ditr_lite.exercises import pipeline as checks


def square(box, shape):
    top, left, bottom, right = box
    side = min(int(max(2 * (bottom - top), 2 * (right - left), max(shape) // 5)), max(shape))
    top = max(0, min((top + bottom - side) // 2, shape[0] - side))
    return top, max(0, min((left + right - side) // 2, shape[1] - side)), side


def given(depth, region):
    known = depth > 0
    known[region] = False
    evidence = np.zeros_like(region)
    evidence[region] = depth[region] > 0
    return known, evidence


def spread(depth, optical, geometric, region):
    drawn = np.where(region, optical, np.where(depth > 0, depth, geometric))
    return drawn.mean(axis=0), drawn.std(axis=0, ddof=1)


def conv_flops(channels_in, channels_out, kernel, height, width, stride):
    places = (height // stride) * (width // stride)
    return 2 * places * channels_out * channels_in * kernel**2


RIGHT = {
    checks.check_square: square,
    checks.check_given: given,
    checks.check_spread: spread,
    checks.check_conv_flops: conv_flops,
}


def unmoved(box, shape):
    side = square(box, shape)[2]
    return (box[0] + box[2] - side) // 2, (box[1] + box[3] - side) // 2, side


def unbounded(box, shape):
    side = max(2 * (box[2] - box[0]), 2 * (box[3] - box[1]), max(shape) // 5)
    return *(max(0, min((box[k] + box[k + 2] - side) // 2, shape[k] - side)) for k in (0, 1)), side


def square_with(side):
    return lambda box, shape: moved(box, shape, min(side(box[2] - box[0], box[3] - box[1], shape), max(shape)))


def moved(box, shape, side):
    starts = [(box[k] + box[k + 2] - side) // 2 for k in (0, 1)]
    return (*(max(0, min(start, n - side)) for start, n in zip(starts, shape, strict=True)), side)


def given_with(known=None, evidence=None):
    def attempt(depth, region):
        right = given(depth, region)
        return known(depth, region) if known else right[0], evidence(depth, region) if evidence else right[1]

    return attempt


def spread_of_branches(depth, optical, geometric, region):
    branches = np.where(region, optical, geometric)
    return spread(depth, optical, geometric, region)[0], branches.std(axis=0, ddof=1)


def given_in_place(depth, region):
    depth[region] = 0
    return depth > 0, region


MISTAKES = [
    (checks.check_square, unmoved, "move it"),
    (checks.check_square, square_with(lambda h, w, s: max(2 * min(h, w), max(s) // 5)), "*longer* side of the box"),
    (checks.check_square, square_with(lambda h, w, s: max(2 * h, max(s) // 5)), "a wide blob would not fit"),
    (checks.check_square, square_with(lambda h, w, s: max(2 * w, max(s) // 5)), "a tall blob would not fit"),
    (checks.check_square, square_with(lambda h, w, s: max(h, w, max(s) // 5)), "no room around"),
    (checks.check_square, square_with(lambda h, w, s: 2 * max(h, w)), "at least a fifth"),
    (checks.check_square, square_with(lambda h, w, s: max(2 * h, 2 * w, min(s) // 5)), "not of the shorter"),
    (
        checks.check_square,
        lambda b, s: moved((*b[:2], *(np.array(b[:2]) + square(b, s)[2])), s, square(b, s)[2]),
        "middle",
    ),
    (checks.check_square, lambda b, s: (*square(b, s)[1::-1], square(b, s)[2]), "swapped"),
    (checks.check_square, lambda b, s: (square(b, s)[2], *square(b, s)[:2]), "the order is"),
    (
        checks.check_square,
        lambda b, s: (*square(b, s)[:2], *np.add(square(b, s)[:2], square(b, s)[2])),
        "ends of the square",
    ),
    (checks.check_square, unbounded, "at most the frame's longer side"),
    (checks.check_square, lambda b, s: square(b, s)[2], "shape"),
    (checks.check_given, lambda d, r: given(d, r)[::-1], "swapped"),
    (checks.check_given, lambda d, r: given(d, ~r), "swapped"),
    (checks.check_given, given_with(known=lambda d, r: d > 0), "leaks in"),
    (checks.check_given, given_with(known=lambda d, r: ~r), "count as known depth"),
    (checks.check_given, given_with(evidence=lambda d, r: r.copy()), "count as evidence"),
    (checks.check_given, lambda d, r: (~r, r.copy()), "in both masks"),
    (checks.check_given, given_with(evidence=lambda d, r: d > 0), "inside the region only"),
    (checks.check_given, given_with(known=lambda d, r: (d > 0) | ~r), "needs both"),
    (checks.check_given, lambda d, r: given((d == 0).astype(d.dtype), r), "wrong way round"),
    (checks.check_given, lambda d, r: np.stack(given(d, r)).astype(np.float32), "should be bool"),
    (checks.check_given, lambda d, r: given(d, r)[0], "shape"),
    (checks.check_given, given_in_place, "changes its input"),
    (checks.check_spread, lambda *case: spread(*case)[::-1], "mean and std are swapped"),
    (checks.check_spread, lambda *case: (spread(*case)[0], spread(*case)[1] * (3 / 4) ** 0.5), "ddof=1"),
    (checks.check_spread, lambda *case: (spread(*case)[0], spread(*case)[1] ** 2), "variance"),
    (checks.check_spread, lambda *case: (spread(*case)[0], 1000 * spread(*case)[1]), "millimetres"),
    (checks.check_spread, spread_of_branches, "compose each sample first"),
    (checks.check_spread, lambda d, o, g, r: (spread(d, o[:1], g[:1], r)[0], spread(d, o, g, r)[1]), "first sample"),
    (checks.check_spread, lambda d, o, g, r: spread(d, g, o, r), "branches are swapped"),
    (checks.check_spread, lambda d, o, g, r: spread(d, o, g, ~r), "inverted"),
    (checks.check_spread, lambda d, o, g, r: spread(np.zeros_like(d), o, g, r), "must stay"),
    (
        checks.check_spread,
        lambda d, o, g, r: (np.median(np.where(r, o, np.where(d > 0, d, g)), axis=0), spread(d, o, g, r)[1]),
        "median",
    ),
    (checks.check_spread, lambda *case: (spread(*case)[0], spread(*case)[1] / 2), "uncertainty of the mean"),
    (checks.check_spread, lambda *case: tuple(m.mean() for m in spread(*case)), "shape"),
    (checks.check_spread, lambda *case: spread(*case)[0], "shape (2, 6, 8)"),
    (checks.check_conv_flops, lambda i, o, k, h, w, s: i * o * k**2 * (h // s) * (w // s), "twice as many"),
    (checks.check_conv_flops, lambda i, o, k, h, w, s: 4 * i * o * k**2 * (h // s) * (w // s), "four operations"),
    (checks.check_conv_flops, lambda i, o, k, h, w, s: 2 * i * o * k * (h // s) * (w // s), "side counts twice"),
    (checks.check_conv_flops, lambda i, o, k, h, w, s: 2 * o * k**2 * (h // s) * (w // s), "every input channel"),
    (checks.check_conv_flops, lambda i, o, k, h, w, s: 2 * i * k**2 * (h // s) * (w // s), "every output channel"),
    (checks.check_conv_flops, lambda i, o, k, h, w, s: 2 * (i + o) * k**2 * (h // s) * (w // s), "do not add"),
    (checks.check_conv_flops, lambda i, o, k, h, w, s: 2 * i * o * k**2 * h * w, "fewer places"),
    (checks.check_conv_flops, lambda i, o, k, h, w, s: 2 * i * o * k**2 * h * w // s, "height *and* width"),
    (checks.check_conv_flops, lambda i, o, k, h, w, s: i * o * k**2, "weights of the convolution"),
    (checks.check_conv_flops, lambda i, o, k, h, w, s: (2 * i * k**2 + 1) * o * (h // s) * (w // s), "bias"),
    (
        checks.check_conv_flops,
        lambda i, o, k, h, w, s: 2 * i * o * k**2 * (1 + (h - k) // s) * (1 + (w - k) // s),
        "is padded",
    ),
    (checks.check_conv_flops, lambda *case: conv_flops(*case) / 1e9, "give operations"),
    (checks.check_conv_flops, lambda i, o, k, h, w, s: conv_flops(i, o, k, h + 2, w, s), "expected"),
]


(
    test_the_right_answer_passes,
    test_a_planted_mistake_is_named,
    test_a_stub_is_not_a_failure_of_the_notebook,
    test_every_checker_is_tested,
) = checker_tests(checks, RIGHT, MISTAKES)


def test_counting_by_hand_agrees_with_the_counter():
    for case in ((3, 8, 3, 24, 32, 1), (8, 4, 3, 24, 32, 2), (8, 8, 1, 12, 20, 1)):
        channels_in, channels_out, kernel, height, width, stride = case
        conv = torch.nn.Conv2d(channels_in, channels_out, kernel, stride, padding=kernel // 2)
        assert conv_flops(*case) == count_flops(conv, torch.zeros(1, channels_in, height, width))


def test_the_window_of_a_blob_is_the_systems():
    for box, shape in [((40, 60, 60, 90), (200, 300)), ((10, 100, 50, 120), (200, 300)), ((3, 0, 9, 4), (100, 150))]:
        assert windows.square(np.array(box), shape) == windows.Window(*square(box, shape))


def test_the_exercises_are_what_the_pipeline_does():
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((8, 8)) < 0.3, 0, rng.uniform(0.5, 0.9, (8, 8))).astype(np.float32)
    region = rng.random((8, 8)) < 0.4
    depth_t, valid, mask = (torch.from_numpy(m)[None, None].float() for m in (depth, depth > 0, region))
    blank = torch.zeros(1, 3, 8, 8)
    image, _, _ = conditioning.condition(blank, depth_t, valid, mask, blank[:, :1])
    known, evidence = (image[0, conditioning.CHANNELS.index(name)].numpy() > 0 for name in ("known", "trusted"))
    assert (given(depth, region)[0] == known).all() and (given(depth, region)[1] == evidence).all()

    optical, geometric = rng.uniform(0.5, 0.9, (2, 3, 8, 8)).astype(np.float32)
    drawn = np.stack([pipeline.compose(depth, o, g, region) for o, g in zip(optical, geometric, strict=True)])
    mean, std = spread(depth, optical, geometric, region)
    np.testing.assert_allclose(mean, pipeline.compose(depth, optical.mean(0), geometric.mean(0), region), rtol=1e-6)
    np.testing.assert_array_equal(std, drawn.std(0, ddof=1))
