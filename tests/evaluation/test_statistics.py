import math

import numpy as np
import pytest

from ditr_lite.evaluation import statistics
from ditr_lite.evaluation.statistics import paired_bootstrap


def test_seeds_are_averaged_and_their_distance_is_told():
    b = np.linspace(0.02, 0.2, 30)
    found = statistics.compare_seeds([b + 0.004, b + 0.006], [b - 0.001, b + 0.001, b])
    assert found == pytest.approx((0.005, 0.005, 0.005, 0.002))
    assert found.clear


@pytest.mark.parametrize(
    ("gap", "jitter", "clear"),
    [(0.005, 0.002, True), (0.005, 0.008, False), (-0.005, 0.002, True), (0.0, 0.0, False)],
)
def test_a_difference_is_clear_only_beyond_scenes_and_seeds(gap, jitter, clear):
    rng = np.random.default_rng(0)
    b = rng.uniform(0.02, 0.2, 40)
    a = b + gap + rng.normal(0, 0.004, 40) * (gap != 0)
    assert statistics.compare_seeds([a - jitter / 2, a + jitter / 2], [b]).clear is clear


def test_the_interval_is_the_paired_one_of_the_means_over_seeds():
    a, b = np.random.default_rng(1).uniform(0.02, 0.2, (2, 2, 25))
    assert statistics.compare_seeds(a, b)[:3] == paired_bootstrap(list(a.mean(0)), list(b.mean(0)))


@pytest.mark.parametrize("a", [[0.1, 0.2], [[0.1]], [[]], []])
def test_errors_of_other_scenes_are_refused(a):
    with pytest.raises(ValueError, match="same scenes"):
        statistics.compare_seeds(a, [[0.1, 0.2]])


def test_unpaired_intervals_are_as_wide_as_theory_says():
    rng = np.random.default_rng(2)
    a, b = rng.normal(0.10, 0.03, 400), rng.normal(0.08, 0.04, 400)
    mean, low, high = statistics.unpaired_bootstrap(a, b)
    assert mean == pytest.approx(a.mean() - b.mean())
    assert high - low == pytest.approx(2 * 1.96 * np.sqrt((a.var() + b.var()) / 400), rel=0.06)
    with pytest.raises(ValueError, match="one per image"):
        statistics.unpaired_bootstrap([], [0.1])


@pytest.mark.parametrize(
    ("interval", "words"),
    [
        ((0.002, 0.001, 0.003), "A: a larger error than B (+2.0 mm [+1.0, +3.0])"),
        ((-0.002, -0.003, -0.001), "A: a smaller error than B"),
        ((0.001, -0.001, 0.003), "A: no measurable difference from B"),
        (None, "A: nothing to compare"),
    ],
)
def test_the_verdict_follows_the_interval(interval, words):
    assert statistics.verdict("A", interval, "B").startswith(words)


def test_a_verdict_of_seeds_says_whether_it_beats_them():
    a, b = [[0.030, 0.040], [0.031, 0.041]], [[0.040, 0.050], [0.040, 0.050]]
    text = statistics.seed_verdict("a", a, b, "b")
    assert text == "a: a smaller error than b (-9.5 mm [-9.5, -9.5]); seeds 1.0 mm apart: clear"
    assert statistics.seed_verdict("b", b, [[0.030, 0.040], [0.045, 0.055]], "c").endswith("15.0 mm apart: not clear")


def test_bootstrap_interval_is_that_of_the_mean():
    values = np.random.default_rng(1).normal(5.0, 2.0, 400)
    mean, low, high = statistics.bootstrap_mean(values)
    assert mean == pytest.approx(values.mean())
    expected = 1.96 * values.std() / math.sqrt(len(values))
    assert (high - mean, mean - low) == (pytest.approx(expected, rel=0.1), pytest.approx(expected, rel=0.1))
    assert (
        statistics.bootstrap_mean(values)
        == statistics.bootstrap_mean(values)
        != statistics.bootstrap_mean(values, seed=1)
    )


def test_paired_bootstrap_keeps_pairs_together():
    hard = np.random.default_rng(2).normal(5.0, 2.0, 50)
    mean, low, high = statistics.paired_bootstrap(hard + 0.1, hard)
    assert (mean, low, high) == pytest.approx((0.1, 0.1, 0.1))  # unpaired, the interval would be about 1.6 wide
    assert statistics.paired_bootstrap([1.0, None, 3.0], [0.5, 9.0, None])[0] == 0.5
    with pytest.raises(ValueError, match="same images"):
        statistics.paired_bootstrap([1.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="finite"):
        statistics.bootstrap_mean([None])


def test_a_ratio_of_means_keeps_pairs_together():
    hard = np.linspace(0.5, 2, 30)
    assert np.allclose(statistics.ratio_bootstrap(list(0.75 * hard), list(hard)), 0.75)
    mean, low, high = statistics.ratio_bootstrap([1.0, 2.0, 3.0, None], [1.0, 4.0, 1.0, 5.0])
    assert mean == 1.0 and low < 1 < high  # the mean of the ratios would be 1.5
    flat, values = np.ones(400), np.random.default_rng(1).normal(5.0, 1.0, 400)
    _, low, high = statistics.ratio_bootstrap(values, flat)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / math.sqrt(400), rel=0.1)
    with pytest.raises(ValueError, match="common images"):
        statistics.ratio_bootstrap([None], [1.0])
    with pytest.raises(ValueError, match="n >= 1; got 1 images, n = 0"):
        statistics.ratio_bootstrap([1.0], [1.0], n=0)
    with pytest.raises(ValueError, match="same images"):
        statistics.ratio_bootstrap([1.0], [1.0, 2.0])


def test_an_interval_is_told_in_the_unit_and_style_asked_for():
    assert statistics.format_interval((0.0012, -0.0034, 0.0051), 1000) == "+1.2 [-3.4, +5.1]"
    assert statistics.format_interval([0.5, 0.25, 0.75], style=".2f") == "0.50 [0.25, 0.75]"
    assert statistics.format_interval(None) == "-" and statistics.format_interval(None, missing="x") == "x"


def test_rank_correlation_of_known_lists():
    assert statistics.spearman([1, 2, 3, 4], [10, 20, 25, 1000]) == pytest.approx(1)
    assert statistics.spearman([1, 2, 3, 4], [4, 3, 2, -5]) == pytest.approx(-1)
    assert statistics.spearman([1, 2, 3], [1, 3, 2]) == pytest.approx(0.5)
    x = np.array([1, 1, 2, 3, 3, 3, 5])  # equal values share their mean rank
    y = np.array([2, 1, 2, 4, 4, 0, 3])
    ranks = [[(values < v).sum() + ((values == v).sum() + 1) / 2 for v in values] for values in (x, y)]
    assert statistics.spearman(x, y) == pytest.approx(np.corrcoef(*ranks)[0, 1])


@pytest.mark.parametrize(("x", "y"), [([1], [2]), ([1, 1], [1, 2]), ([1, 2], [3, 3])])
def test_no_correlation_of_nothing(x, y):
    with pytest.raises(ValueError, match="not all alike"):
        statistics.spearman(x, y)


def test_the_interval_of_a_correlation_holds_the_truth_about_as_often_as_it_says():
    rng, rho = np.random.default_rng(1), 0.5
    truth = 6 / np.pi * np.arcsin(rho / 2)  # Spearman's of a bivariate normal
    hits = 0
    for k in range(60):
        x, y = rng.multivariate_normal([0, 0], [[1, rho], [rho, 1]], 60).T
        _, low, high = statistics.spearman_bootstrap(list(x), list(y), n=300, seed=k)
        hits += low <= truth <= high
    assert 51 <= hits <= 60


def test_what_is_held_fixed_no_longer_correlates():
    rng = np.random.default_rng(0)
    cause, noise = rng.random(200), rng.random((2, 200))
    x, y = cause + 0.4 * noise[0], cause + 0.4 * noise[1]  # each by the cause alone
    assert statistics.spearman_bootstrap(x, y, n=200)[1] > 0.5
    rho, low, high = statistics.spearman_bootstrap(x, y, n=200, held=cause)
    assert low < 0 < high
    ranks = [np.argsort(np.argsort(values)) for values in (x, y, cause)]
    left = [r - np.polyval(np.polyfit(ranks[2], r, 1), ranks[2]) for r in ranks[:2]]
    assert rho == pytest.approx(np.corrcoef(*left)[0, 1])
    with pytest.raises(ValueError, match="not all alike"):
        statistics.spearman_bootstrap(x, y, held=np.ones(200))


def test_images_without_a_value_are_left_out_of_a_correlation():
    x, y = [1, None, 2, 3, 4], [1, 5, None, 3, 4]
    assert statistics.spearman_bootstrap(x, y, n=200) == pytest.approx((1, 1, 1))  # some resamples are all alike
    with pytest.raises(ValueError, match="same images"):
        statistics.spearman_bootstrap([1, 2], [1, 2, 3])


@pytest.mark.parametrize(("scenes", "least", "most"), [(3, 0.65, 0.8), (8, 0.8, 0.93), (100, 0.91, 0.98)])
def test_an_interval_of_few_scenes_holds_the_true_mean_less_often_than_its_name_says(scenes, least, most):
    draws = np.random.default_rng(0).normal(size=(300, scenes))
    intervals = [statistics.bootstrap_mean(list(values), n=400) for values in draws]
    assert least < np.mean([low <= 0 <= high for _, low, high in intervals]) < most


def test_an_interval_holds_the_true_mean_less_often_where_a_few_scenes_have_huge_errors():
    draws = np.random.default_rng(0).lognormal(sigma=1.5, size=(300, 100))
    intervals = [statistics.bootstrap_mean(list(values), n=400) for values in draws]
    assert 0.75 < np.mean([low <= np.exp(1.5**2 / 2) <= high for _, low, high in intervals]) < 0.91


def test_of_three_scenes_the_interval_is_their_range():
    assert statistics.bootstrap_mean([1.0, 2.0, 6.0]) == (3.0, 1.0, 6.0)


def test_one_image_has_an_interval_without_width():
    assert statistics.bootstrap_mean([0.5, None]) == (0.5, 0.5, 0.5)
    assert statistics.ratio_bootstrap([1.0], [2.0]) == (0.5, 0.5, 0.5)
    assert statistics.unpaired_bootstrap([1.0], [2.0]) == (-1.0, -1.0, -1.0)


def test_an_interval_for_a_file_is_rounded_and_none_without_a_complete_image():
    assert statistics.interval(paired_bootstrap, [1.0, None], [None, 2.0]) is None
    assert statistics.interval(statistics.bootstrap_mean, []) is None
    assert statistics.interval(paired_bootstrap, [0.12345, None], [0.0, 1.0], digits=3) == [0.123, 0.123, 0.123]
    a, b = np.random.default_rng(4).uniform(1, 2, (2, 9)).tolist()
    assert statistics.interval(statistics.ratio_bootstrap, a, b) == list(statistics.ratio_bootstrap(a, b))
    assert statistics.mean_known([1.0, None, 2.0]) == 1.5 and statistics.mean_known([None]) is None


def test_differences_are_sorted_by_what_their_intervals_say():
    rows = {"a": (-2.0, -3.0, -1.0), "b": (1.0, 0.5, 2.0), "c": (0.1, -0.1, 0.2), "d": None}
    assert statistics.sort_by_verdict(rows) == {"lower": ["a"], "higher": ["b"], "not decided": ["c"]}
