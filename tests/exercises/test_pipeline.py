"""The right answer passes; every planted mistake fails with a message that names it."""

import numpy as np
import torch
from checker_cases import checker_tests

from ditr_lite import conditioning, pipeline
from ditr_lite.evaluation.costs import count_flops
from ditr_lite.exercises import pipeline as checks


def scaled(depth, low, high):
    middle, half = np.sqrt(low * high), np.sqrt(high / low)
    return np.log(np.where(depth > 0, depth, middle) / middle) / np.log(half)


def normalise(depth, low, high):
    u = scaled(depth, low, high)
    beyond = np.abs(u) > 1
    u[beyond] = np.sign(u[beyond]) * (1 + np.log(np.abs(u[beyond])))
    return u


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
    checks.check_normalise: normalise,
    checks.check_given: given,
    checks.check_spread: spread,
    checks.check_conv_flops: conv_flops,
}


def read_only(formula):
    return lambda d, low, high: np.where(d > 0, formula(d, low, high), 0.0)


def straight(depth, low, high):
    return 2 * (depth - low) / (high - low) - 1


def squeezed(u):
    return np.where(np.abs(u) > 1, np.sign(u) * (1 + np.log(np.maximum(np.abs(u), 1))), u)


def about_the_mean(depth, low, high):
    return squeezed((np.log(np.where(depth > 0, depth, 1)) - np.log((low + high) / 2)) / (np.log(high / low) / 2))


def missing_left(depth, low, high):
    return squeezed((np.log(np.where(depth > 0, depth, 1)) - np.log(low * high) / 2) / (np.log(high / low) / 2))


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
    (checks.check_normalise, read_only(straight), "take the logarithm of depth"),
    (checks.check_normalise, read_only(lambda *a: squeezed(straight(*a))), "take the logarithm first"),
    (checks.check_normalise, scaled, "is not compressed"),
    (checks.check_normalise, lambda *a: np.clip(scaled(*a), -1, 1), "is clipped"),
    (checks.check_normalise, lambda *a: normalise(*a) - np.trunc(np.clip(scaled(*a), -1, 1)), "jumps"),
    (checks.check_normalise, lambda *a: np.where(scaled(*a) < 0, scaled(*a), normalise(*a)), "near strays"),
    (checks.check_normalise, missing_left, "should become 0"),
    (checks.check_normalise, read_only(lambda *a: (normalise(*a) + 1) / 2), "[0, 1]"),
    (checks.check_normalise, lambda *a: -normalise(*a), "sign"),
    (checks.check_normalise, lambda *a: squeezed(scaled(*a) / 2), "half range"),
    (checks.check_normalise, read_only(about_the_mean), "geometric mean"),
    (checks.check_normalise, lambda d, low, high: normalise(d, low, high).ravel(), "shape"),
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


def test_the_frame_of_reference_is_the_systems():
    depth = np.array([[0.0, 0.5, 0.62, 0.7], [0.8, 0.9, 9.0, 0.1]])
    bounds = conditioning.depth_bounds(depth)
    np.testing.assert_allclose(normalise(depth, bounds.low, bounds.high), bounds.normalise(depth), atol=1e-9)


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
