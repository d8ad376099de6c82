import numpy as np
import pytest

from ditr_lite.data import Sample
from ditr_lite.simulator.realism import STATISTICS, compare_with_real, frame_statistics


def frame(bias=0.03, name="frame", missing=2):
    """Return a 10 x 10 frame 1 m away: half of it glass, read ``bias`` too far, with ``missing`` rows lost."""
    gt = np.ones((10, 10), np.float32)
    region = np.zeros((10, 10), bool)
    region[:, :5] = True
    raw = np.where(region, 1 + bias, 1.002).astype(np.float32)
    raw[:missing] = 0
    return Sample(name, np.zeros((10, 10, 3), np.uint8), raw, gt, region)


def test_statistics_of_a_frame_made_by_hand():
    found = frame_statistics(frame())
    assert set(found) == set(STATISTICS)
    expected = {"missing_outside": 0.2, "missing_inside": 0.2, "bias_inside_m": 0.03, "rmse_inside_m": 0.03}
    expected |= {"bias_inside_median_m": 0.03, "beyond_twice_median": 0.0}
    expected |= {"mae_outside_m": 0.002, "noise_outside": 0.002, "region_share": 0.5, "distance_m": 1.0}
    assert found == pytest.approx(expected, rel=1e-4)


def test_a_wild_reading_moves_the_mean_and_not_the_median():
    wild = frame()
    wild.depth[5, 0] = 5.03  # one of 80 readings, one of 40 inside
    found = frame_statistics(wild)
    assert found["bias_inside_m"] == pytest.approx(0.13, rel=1e-4)
    assert found["bias_inside_median_m"] == pytest.approx(0.03, rel=1e-4)
    assert found["beyond_twice_median"] == pytest.approx(1 / 80)


def test_a_frame_without_readings_has_none_beyond():
    assert np.isnan(frame_statistics(frame(missing=10))["beyond_twice_median"])


def test_bias_keeps_its_sign():
    assert frame_statistics(frame(bias=-0.02))["bias_inside_m"] == pytest.approx(-0.02, rel=1e-4)


def test_what_a_frame_does_not_have_is_nan():
    empty = frame()
    empty.region[:] = False
    found = frame_statistics(empty)
    assert np.isnan(found["bias_inside_m"]) and np.isnan(found["missing_inside"]) and found["region_share"] == 0


def test_a_frame_without_truth_or_region_is_refused():
    sample = frame()
    with pytest.raises(ValueError, match="ground truth and a region"):
        frame_statistics(Sample("x", sample.rgb, sample.depth, sample.depth_gt))


def test_table_says_which_real_frames_lie_inside_the_spread():
    simulated = [frame(bias) for bias in np.linspace(0.01, 0.05, 21)]
    table = compare_with_real(simulated, [frame(0.03, "in"), frame(0.2, "out")])
    lines = {line.split()[0]: line for line in table.splitlines()}
    assert lines["bias_inside_m"].endswith("yes NO") and lines["region_share"].endswith("yes yes")
    numbers = [float(x) for x in lines["bias_inside_m"].split()[1:6]]
    assert numbers == pytest.approx([0.012, 0.03, 0.048, 0.03, 0.2], abs=1e-4)


def test_table_without_real_frames_shows_the_spread_alone():
    table = compare_with_real([frame(), frame(0.05)], [])
    assert len(table.splitlines()) == 1 + len(STATISTICS)
