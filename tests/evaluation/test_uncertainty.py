import numpy as np
import pytest

from ditr_lite.evaluation import uncertainty as un


@pytest.fixture(scope="module")
def gaussian():
    rng = np.random.default_rng(0)
    std = rng.uniform(0.002, 0.05, 40_000)
    return std * rng.normal(size=std.size), std


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
