import numpy as np

from ditr_lite.data import load_sample
from ditr_lite.evaluation import memory


def test_peak_sees_what_is_allocated_and_given_back():
    held = memory.peak_mb(lambda: None)
    seen = memory.peak_mb(lambda: [np.ones(10_000_000).sum() for _ in range(3)])  # 80 MB, gone afterwards
    assert 60 < seen - held < 200


def test_every_stage_of_the_shipped_system_stays_below_the_limit():
    peaks = memory.stage_peaks(None, load_sample("test_00000"), steps=1, samples=1)
    assert "whole" in peaks and all(50 < peak < 1500 for peak in peaks.values())
