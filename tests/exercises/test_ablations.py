"""The right answer passes; every planted mistake fails with a message that names it."""

import numpy as np
from checker_cases import checker_tests
from scipy import stats

from ditr_lite.exercises import ablations as checks


def paired(formula):
    def of(a, b):
        pairs = np.array([(x, y) for x, y in zip(a, b, strict=True) if x * y > 0])
        return formula(pairs[:, 0], pairs[:, 1])

    return of


paired_mean = paired(lambda a, b: a.mean() - b.mean())


def seeds(a, b):
    means = [errors.mean(axis=1) for errors in (a, b)]
    return means[0].mean() - means[1].mean(), max(m.max() - m.min() for m in means)


def noise(a, b, take):
    return np.mean(a) - np.mean(b), take(a, b)


def pearson(x, y):
    x, y = x - x.mean(), y - y.mean()
    return (x @ y) / np.sqrt((x @ x) * (y @ y))


def ranks(values):
    return np.array([(values < v).sum() + ((values == v).sum() - 1) / 2 for v in values])


def spearman(x, y):
    return pearson(ranks(x), ranks(y))


def overlap(ids, region, counts=lambda i, j, r, s: i * j > 0, outline=lambda i, j, r, s: r or s, sideways=True):
    """Walk over all pairs of neighbours, one by one."""
    shared = total = 0
    height, width = ids.shape
    for y, x in np.ndindex(height, width):
        for v, u in ((y + 1, x), (y, x + 1)) if sideways else ((y + 1, x),):
            if v < height and u < width and ids[y, x] != ids[v, u]:
                pair = ids[y, x], ids[v, u], region[y, x], region[v, u]
                total += outline(*pair)
                shared += counts(*pair) and (pair[2] or pair[3])
    return shared / total


def touching(ids, region):
    """Count all neighbours in the region as outline."""
    total = sum((region[a] | region[b]).sum() for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])))
    apart = sum(
        ((ids[a] != ids[b]) & (region[a] | region[b])).sum()
        for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:]))
    )
    return overlap(ids, region) * apart / total


def reliability(spread, error, bins, key=None, of_error=np.square, of_spread=np.square, root=np.sqrt):
    order = np.argsort(spread if key is None else key(spread, error))
    rows = []
    for values, of in ((spread, of_spread), (error, of_error)):
        means = np.array([of(part).mean() for part in np.split(values[order], bins)])
        rows.append(root(means) if of is np.square else means)
    return np.array(rows)


RIGHT = {
    checks.check_paired_mean: paired_mean,
    checks.check_choose: lambda val, test: min(zip(val, test, strict=True))[1],
    checks.check_seeds: seeds,
    checks.check_spearman: spearman,
    checks.check_overlap: overlap,
    checks.check_reliability: reliability,
}

MISTAKES = [
    (checks.check_paired_mean, lambda a, b: np.mean(a[a != 0]) - np.mean(b[b != 0]), "different scenes"),
    (checks.check_paired_mean, lambda a, b: np.mean(a) - np.mean(b), "counts as no error"),
    (checks.check_paired_mean, lambda a, b: ((a - b) * (a * b > 0)).sum() / len(a), "no difference"),
    (checks.check_paired_mean, lambda a, b: (a - b)[a + b > 0].mean(), "where both lack it"),
    (checks.check_paired_mean, lambda a, b: (a - b)[a != 0].mean(), "only the first"),
    (checks.check_paired_mean, lambda a, b: (a - b)[b != 0].mean(), "only the second"),
    (checks.check_paired_mean, lambda a, b: paired_mean(b, a), "a - b is wanted"),
    (checks.check_paired_mean, paired(lambda a, b: np.median(a - b)), "median"),
    (checks.check_paired_mean, paired(lambda a, b: np.mean(np.abs(a - b))), "sign is lost"),
    (checks.check_paired_mean, paired(lambda a, b: np.mean(a / b - 1)), "share of b"),
    (checks.check_choose, lambda v, t: min(t), "done the choosing"),
    (checks.check_choose, lambda v, t: min(v), "too good"),
    (checks.check_choose, lambda v, t: t[v.argmax()], "largest validation"),
    (checks.check_choose, lambda v, t: v.argmin(), "place of the setting"),
    (checks.check_choose, lambda v, t: t[((v + t) / 2).argmin()], "helps to choose"),
    (checks.check_choose, lambda v, t: np.mean(t), "mean over settings"),
    (checks.check_seeds, lambda a, b: noise(a, b, lambda a, b: np.ptp(a.mean(1))), "both variants have seeds"),
    (checks.check_seeds, lambda a, b: noise(a, b, lambda a, b: np.ptp(b.mean(1))), "both variants have seeds"),
    (
        checks.check_seeds,
        lambda a, b: noise(a, b, lambda a, b: min(np.ptp(a.mean(1)), np.ptp(b.mean(1)))),
        "hides the noise",
    ),
    (
        checks.check_seeds,
        lambda a, b: noise(a, b, lambda a, b: max(np.ptp(a.mean(0)), np.ptp(b.mean(0)))),
        "between scenes",
    ),
    (checks.check_seeds, lambda a, b: noise(a, b, lambda a, b: max(np.ptp(a), np.ptp(b))), "single scenes"),
    (
        checks.check_seeds,
        lambda a, b: noise(a, b, lambda a, b: max(np.std(a.mean(1)), np.std(b.mean(1)))),
        "standard deviation",
    ),
    (checks.check_seeds, lambda a, b: noise(a, b, lambda a, b: np.ptp((a - b).mean(1))), "lucky seed"),
    (
        checks.check_seeds,
        lambda a, b: noise(a, b, lambda a, b: max(np.abs(np.diff(m.mean(1))).max() for m in (a, b))),
        "largest difference of any two",
    ),
    (
        checks.check_seeds,
        lambda a, b: noise(a, b, lambda a, b: max(abs(m[0].mean() - m[-1].mean()) for m in (a, b))),
        "largest difference of any two",
    ),
    (
        checks.check_seeds,
        lambda a, b: noise(a, b, lambda a, b: np.ptp(np.vstack([a, b]).mean(1))),
        "seeds of the same variant",
    ),
    (checks.check_seeds, lambda a, b: (seeds(b, a)[0], seeds(a, b)[1]), "a - b is wanted"),
    (checks.check_seeds, lambda a, b: (min(a.mean(1)) - min(b.mean(1)), seeds(a, b)[1]), "best seed"),
    (checks.check_seeds, lambda a, b: np.mean(a - b), "shape"),
    (checks.check_spearman, pearson, "Pearson"),
    (checks.check_spearman, lambda x, y: pearson(x.argsort(kind="stable"), y.argsort(kind="stable")), "twice"),
    (
        checks.check_spearman,
        lambda x, y: pearson(*(stats.rankdata(v, "ordinal") for v in (x, y))),
        "different ranks",
    ),
    (checks.check_spearman, lambda x, y: pearson(*((v[:, None] > v).sum(1) for v in (x, y))), "lowest of their ranks"),
    (
        checks.check_spearman,
        lambda x, y: 1 - 6 * ((ranks(x) - ranks(y)) ** 2).sum() / (len(x) * (len(x) ** 2 - 1)),
        "short formula",
    ),
    (checks.check_spearman, lambda x, y: spearman(x, -y), "wrong way round"),
    (checks.check_spearman, lambda x, y: spearman(x, y) ** 2, "has a sign"),
    (checks.check_overlap, lambda i, r: overlap(i, r, lambda i, j, r, s: r and s), "opaque neighbour"),
    (checks.check_overlap, lambda i, r: overlap(i, r, sideways=False), "sideways"),
    (checks.check_overlap, lambda i, r: overlap(i, r, lambda i, j, r, s: True), "neither is 0"),
    (
        checks.check_overlap,
        lambda i, r: overlap(i, r, outline=lambda i, j, r, s: r and s, counts=lambda i, j, r, s: r and s),
        "at least one side",
    ),
    (checks.check_overlap, lambda i, r: overlap(i, r, outline=lambda *_: True), "outlines of opaque"),
    (checks.check_overlap, touching, "only those that differ"),
    (checks.check_overlap, lambda i, r: 1 / (1 / overlap(i, r) - 1), "shared over all"),
    (checks.check_overlap, lambda i, r: overlap(i, r, lambda i, j, r, s: i * j == 0), "borders the background"),
    (checks.check_reliability, lambda s, e, b: reliability(s, e, b, lambda s, e: e**2), "not by the error"),
    (checks.check_reliability, lambda s, e, b: reliability(np.sort(s), np.sort(np.abs(e)), b), "sorted apart"),
    (checks.check_reliability, lambda s, e, b: reliability(s, e, b, lambda s, e: np.arange(len(s))), "not sorted"),
    (checks.check_reliability, lambda s, e, b: np.flip(reliability(s, e, b), 1), "smallest is wanted"),
    (checks.check_reliability, lambda s, e, b: reliability(s, e, b, of_error=lambda x: x), "cancel"),
    (checks.check_reliability, lambda s, e, b: reliability(s, e, b, of_error=np.abs), "not the mean absolute"),
    (checks.check_reliability, lambda s, e, b: reliability(s, e, b, of_spread=np.abs), "average the variances"),
    (checks.check_reliability, lambda s, e, b: reliability(s, e, b, root=lambda x: x), "variances"),
    (checks.check_reliability, lambda s, e, b: np.flip(reliability(s, e, b), 0), "exchanged"),
]


(
    test_the_right_answer_passes,
    test_a_planted_mistake_is_named,
    test_a_stub_is_not_a_failure_of_the_notebook,
    test_every_checker_is_tested,
) = checker_tests(checks, RIGHT, MISTAKES)
