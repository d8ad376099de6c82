import numpy as np
import pytest

from ditr_lite.data import Sample
from ditr_lite.evaluation import uncertainty as un


@pytest.fixture(scope="module")
def gaussian():
    rng = np.random.default_rng(0)
    std = rng.uniform(0.002, 0.05, 40_000)
    return std * rng.normal(size=std.size), std


def test_honest_errors_cover_what_they_should(gaussian):
    for _, due, seen in un.coverages(*gaussian):
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


def test_calibrated_draws_are_found_calibrated():
    rng = np.random.default_rng(1)
    spread = rng.uniform(0.005, 0.05, 80_003)
    expected, observed = un.reliability(spread, rng.normal(0, spread))
    np.testing.assert_allclose(observed, expected, rtol=0.05)
    assert (np.diff(expected) > 0).all()
    np.testing.assert_allclose(un.reliability(spread, 3 * spread)[1], 3 * un.reliability(spread, spread)[0])
    with pytest.raises(ValueError, match="same pixels"):
        un.reliability(spread, spread[1:])


def test_dropping_what_is_doubted_lowers_the_error_of_the_rest():
    error = np.array([0.01, -0.04, 0.02, 0.03])
    np.testing.assert_allclose(un.risk(np.abs(error), error, (0.25, 0.5, 1)), [0.01, np.sqrt(2.5e-4), np.sqrt(7.5e-4)])
    np.testing.assert_allclose(un.risk(-np.abs(error), error, (0.25,)), [0.04])


def test_spread_and_error_are_those_of_the_regions_pixels():
    truth, region = np.full((64, 96), 0.6, np.float32), np.zeros((64, 96), bool)
    region[:10] = True
    sample = Sample("s", np.zeros((64, 96, 3), np.uint8), truth, truth, region)
    members = np.stack([truth + 0.01, truth + 0.03])
    spread, error = un.spread_and_error([members] * 2, [sample, sample])
    assert spread.shape == error.shape == (2 * 960,)
    np.testing.assert_allclose(spread, 0.02 / np.sqrt(2), rtol=1e-4)
    np.testing.assert_allclose(error, 0.02, rtol=1e-4)


def test_the_curve_of_risk_has_the_values_of_its_two_scores(gaussian):
    error, std = gaussian
    shares, risks, best = np.array(un.risk_coverage(error, std, points=4)).T
    np.testing.assert_allclose(risks, un.risk(std, error, shares))
    np.testing.assert_allclose(best, un.risk(np.abs(error), error, shares))


def test_the_fit_of_kept_readings_finds_what_missed_glass_costs():
    rng = np.random.default_rng(2)
    depth, doubt = rng.uniform(0.4, 2.0, 60_000), rng.beta(0.3, 2, 60_000)
    missed = rng.random(depth.size) < doubt  # the probability means what it says
    error = depth * np.where(missed, 0.08, 0.004) * rng.normal(size=depth.size)
    kept, glass = un.fit_kept(error, depth, doubt)
    assert kept == pytest.approx(0.004, rel=0.5) and glass == pytest.approx(np.sqrt(0.08**2 - 0.004**2), rel=0.05)
    assert un.fit_kept(0.01 * depth, depth, doubt) == pytest.approx((0.01, 0), abs=1e-6)  # never negative


@pytest.mark.parametrize("temperature", [0.5, 1.0, 2.5])
def test_the_temperature_that_made_probabilities_overconfident_is_found(temperature):
    rng = np.random.default_rng(3)
    logits = rng.normal(0, 2, (3, 40_000))
    honest = np.exp(logits) / np.exp(logits).sum(axis=0)
    true = rng.random(40_000) > honest[0]
    logs = logits * temperature - np.log(np.exp(logits * temperature).sum(axis=0))
    assert un.fit_temperature(logs, true) == pytest.approx(temperature, rel=0.05)
    with pytest.raises(ValueError, match="at least 2 classes"):
        un.fit_temperature(logs[:1], true)


def test_nothing_is_fitted_on_a_test_split():
    un.check_fitted_on(["val", "rooms_val"])
    for split in ("test", "rooms"):
        with pytest.raises(ValueError, match=f"{split} is held out"):
            un.check_fitted_on(["val", split])


def test_every_pixel_is_painted_by_one_branch_or_kept():
    region = np.array([[True, True, False, False]])
    sets = un.kinds_of_pixels(region, np.array([[0.0, 0.7, 0.0, 0.7]]))
    assert {k: v[0].tolist() for k, v in sets.items()} == {
        "optical": [True, True, False, False],
        "geometric": [False, False, True, False],
        "kept": [False, False, False, True],
    }


@pytest.mark.parametrize(
    ("expected", "real", "said"), [(0.01, 0.02, "too sure"), (0.02, 0.01, "too unsure"), (0.01, 0.012, "about right")]
)
def test_honesty_in_words(expected, real, said):
    assert un.honesty(expected, real) == said


def test_what_was_stated_becomes_columns_and_curves():
    one = {"reliability": [[1, 0.68, 0.5], [2, 0.95, 0.9]], "risk_coverage": [[0.5, 0.01, 0.005], [1.0, 0.02, 0.02]]}
    report = {how: {"optical": one, "kept": one} for how in ("spread alone", "calibrated")}
    columns = un.coverage_columns(report)
    assert list(columns)[2:] == ["optical, spread", "optical, calibrated", "kept, calibrated"]
    assert columns["within"] == ["1 std", "2 std"] and columns["kept, calibrated"] == [50, 90]
    curves = un.risk_curves(report)
    assert list(curves["kept"]) == ["calibrated", "oracle"]  # samples do not differ where a reading is kept
    assert curves["optical"]["oracle"] == ((0.5, 1.0), (0.005, 0.02))
