from dataclasses import replace

import numpy as np
import pytest

from ditr_lite.data import Sample
from ditr_lite.studies import failures

SHAPE = (64, 96)


def scene():
    """Two glass boxes side by side, the left one larger, and an opaque box that touches none of them."""
    instances, material = np.zeros((2, *SHAPE), np.uint8)
    instances[10:30, 10:40], material[10:30, 10:40] = 1, 1
    instances[10:30, 40:50], material[10:30, 40:50] = 2, 2
    instances[40:50, 60:70] = 3
    truth = np.full(SHAPE, 0.9, np.float32)
    truth[instances > 0] = 0.6
    depth = truth.copy()
    depth[10:20, 10:50] = 0  # half of the region
    return Sample("boxes", np.zeros((*SHAPE, 3), np.uint8), depth, truth, material > 0, None, material, instances)


def test_a_known_scene_is_described_exactly():
    described = failures.describe(scene(), 0.25)
    assert list(described) == list(failures.DESCRIBED)
    assert described == {
        "region_share": 800 / 6144,
        "largest_share": 600 / 6144,
        "objects": 2,
        "overlap": 20 / (20 + 2 * 40 + 2 * 20),  # one side shared; top and bottom of both; the outer sides
        "distance_m": pytest.approx(0.6),
        "missing_share": 0.5,
        "miss_rate": 0.25,
    }
    assert failures.describe(scene())["miss_rate"] is None


def test_slivers_are_not_objects_but_bound_them():
    sample = scene()
    sample.instances[20, 20:30] = 4  # ten pixels
    assert failures.describe(sample)["objects"] == 2
    assert failures.overlap(sample.instances, sample.region) == (20 + 22) / (140 + 22)


def test_overlap_counts_opaque_neighbours_and_no_outline_elsewhere():
    instances, region = np.zeros((5, 6), int), np.zeros((5, 6), bool)
    instances[1:3, 1:3], region[1:3, 1:3] = 1, True
    assert failures.overlap(instances, region) == 0
    instances[1:3, 3] = 2  # an opaque object to the right
    assert failures.overlap(instances, region) == 2 / 8
    instances[4] = 3  # another, far away: its outline does not count
    assert failures.overlap(instances, region) == 2 / 8
    assert failures.overlap(instances, np.zeros((5, 6), bool)) == 0
    with pytest.raises(ValueError, match="should be alike"):
        failures.overlap(instances, region[1:])


def test_what_cannot_be_described_is_refused():
    with pytest.raises(ValueError, match="lacks region"):
        failures.describe(replace(scene(), instances=None))
    with pytest.raises(ValueError, match="nothing in its region"):
        failures.describe(replace(scene(), region=np.zeros(SHAPE, bool)))


def test_correlations_are_taken_over_the_frames_in_both():
    described = {f"f{k}": dict.fromkeys(failures.DESCRIBED, 1.0) | {"objects": k, "overlap": -k} for k in range(8)}
    errors = {f"f{k}": 0.01 * k for k in range(7)} | {"f7": None, "unknown": 9.0}
    found = failures.correlations(errors, described)
    assert list(found) == list(failures.DESCRIBED) and found["region_share"] is None
    assert found["objects"][0] == pytest.approx(1) and found["overlap"][0] == pytest.approx(-1)


def test_the_worst_come_first():
    errors = {"a": 0.1, "b": None, "c": 0.3, "d": 0.2}
    assert failures.worst(errors, 2) == ["c", "d"] and failures.worst(errors) == ["c", "d", "a"]


@pytest.mark.parametrize(
    ("rho", "words"),
    [((0.3, 0.1, 0.5), "grow"), ((-0.3, -0.5, -0.1), "shrink"), ((0.1, -0.1, 0.3), "no meas"), (None, "cannot")],
)
def test_the_verdict_follows_the_interval(rho, words):
    assert words in failures.correlation_verdict("overlap", rho)


def test_ranges_leave_out_what_was_not_measured():
    described = {f"f{k}": dict.fromkeys(failures.DESCRIBED, 0.5) | {"objects": k, "miss_rate": None} for k in range(4)}
    lines = failures.format_ranges(described | {"more": described["f0"] | {"overlap": 0.25}}).splitlines()
    assert [line.split()[0] for line in lines] == list(failures.DESCRIBED)
    assert lines[2].endswith(" 0.000 to  3.000") and lines[3].endswith(" 0.250 to  0.500")
    assert lines[-1].endswith("not measured")


def test_the_papers_cases_are_judged_by_their_intervals():
    rho = dict.fromkeys(failures.DESCRIBED, (0.3, 0.1, 0.5)) | {"overlap": None}
    apart = {"largest_share": (0.2, 0.1, 0.3), "overlap": None}
    *lines, largest, overlap = failures.format_verdicts(rho, apart).splitlines()
    assert (
        len(lines) == len(rho)
        and "'largest_share': confirmed on these scenes; with overlap held fixed +0.20" in largest
    )
    assert "'overlap': not confirmed on these scenes; with largest_share held fixed it cannot be told" in overlap
    apart["overlap"] = (0.1, -0.1, 0.3)
    assert "'overlap': not confirmed" in failures.format_verdicts(rho, apart)


def test_a_case_that_only_comes_with_the_other_is_told_apart():
    rng = np.random.default_rng(0)
    size = rng.random(100)
    overlap, errors = size + 0.3 * rng.random(100), size + 0.3 * rng.random(100)
    described = {
        f"f{k}": dict.fromkeys(failures.DESCRIBED, 0.0) | {"largest_share": size[k], "overlap": overlap[k]}
        for k in range(100)
    }
    made = {f"f{k}": error for k, error in enumerate(errors)}
    assert failures.correlations(made, described)["overlap"][1] > 0.5
    apart = failures.partial_correlations(made, described)
    assert apart["overlap"][1] < 0 < apart["overlap"][2] and apart["largest_share"][1] > 0.3
