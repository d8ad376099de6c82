import numpy as np
import pytest

from ditr_lite import uncertainty as un


@pytest.fixture(scope="module")
def gaussian():
    rng = np.random.default_rng(0)
    std = rng.uniform(0.002, 0.05, 40_000)
    return std * rng.normal(size=std.size), std


def test_an_edge_of_averages_flies_and_a_sharp_one_does_not():
    gt = np.full((20, 30), 0.8)
    gt[:, :15] = 0.6
    assert un.flying_pixels(gt, gt) == 0
    blurred = gt.copy()
    blurred[:, 14:16] = 0.7
    edge = 6 * 20  # a 7-pixel window sees the step from three pixels on either side
    assert un.flying_pixels(blurred, gt) == pytest.approx(2 * 20 / edge)
    shifted = np.roll(gt, 1, axis=1)  # wrong, but on one of the two surfaces
    assert un.flying_pixels(shifted, gt) == 0
    assert un.flying_pixels(gt + 0.05, gt) < 0.6 and np.isnan(un.flying_pixels(gt, np.full_like(gt, 0.7)))


def test_flying_pixels_are_looked_for_in_the_mask_and_where_truth_is_known():
    gt = np.full((20, 30), 0.8)
    gt[:, :15] = 0.6
    pred = np.where(gt > 0.7, 0.7, gt)
    upper = np.zeros(gt.shape, bool)
    upper[:10] = True
    half_known = np.where(upper, gt, 0)
    assert un.flying_pixels(pred, gt, upper) == un.flying_pixels(pred, half_known) == pytest.approx(0.5)


def test_honest_errors_cover_what_they_should(gaussian):
    for _, due, seen in un.reliability(*gaussian):
        assert seen == pytest.approx(due, abs=0.01)
    assert un.coverage(gaussian[0], gaussian[1] / 2) == pytest.approx(un.coverage(*gaussian, 0.5))


def test_keeping_the_surest_first_lowers_the_risk(gaussian):
    rows = un.risk_coverage(*gaussian)
    shares, risks, best = zip(*rows, strict=True)
    assert shares[-1] == 1 and risks[-1] == pytest.approx(best[-1]) and len(rows) == 20
    assert all(np.diff(risks) > 0) and all(b <= r + 1e-12 for b, r in zip(best, risks, strict=True))
    blind = un.risk_coverage(gaussian[0], np.ones_like(gaussian[1]))
    assert blind[0][1] == pytest.approx(blind[-1][1], rel=0.1)


def test_crps_is_least_for_the_true_spread(gaussian):
    error, std = gaussian
    scores = [un.gaussian_crps(error, k * std) for k in (0.5, 0.9, 1.0, 1.1, 2.0)]
    assert np.argmin(scores) == 2
    assert un.gaussian_crps(np.array([0.3]), np.array([1e-9])) == pytest.approx(0.3)  # sure of one value: its MAE


def test_the_fit_finds_the_constants_that_made_the_errors():
    rng = np.random.default_rng(1)
    depth, spread = rng.uniform(0.4, 1.2, 30_000), rng.uniform(0, 0.02, 30_000)
    error = np.hypot(0.01 * depth, 2.5 * spread) * rng.normal(size=depth.size)
    base, factor = un.fit_error(error, spread, depth)
    assert base == pytest.approx(0.01, rel=0.05) and factor == pytest.approx(2.5, rel=0.05)


@pytest.mark.parametrize("function", [un.coverage, un.risk_coverage, un.gaussian_crps])
def test_arrays_that_do_not_fit_are_refused(function):
    for pair in ((np.ones(3), np.ones(4)), (np.ones(0), np.ones(0)), (np.ones((2, 2)), np.ones((2, 2)))):
        with pytest.raises(ValueError, match="two arrays"):
            function(*pair)
