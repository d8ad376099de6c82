from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ditr_lite.config import RefineConfig, preset
from ditr_lite.data import Sample
from ditr_lite.pipeline import compose
from ditr_lite.region import refine_region
from ditr_lite.studies.regions import offset_region, refinement_costs, region_costs

SHAPE = (64, 96)


def frame():
    """A wall at 0.6 m; in the region it reads 5 cm too far, and everywhere else 1 mm too far."""
    region = np.zeros(SHAPE, bool)
    region[20:40, 30:60] = True
    truth = np.full(SHAPE, 0.6, np.float32)
    depth = truth + np.where(region, np.float32(0.05), np.float32(0.001))
    rgb = np.zeros((*SHAPE, 3), np.uint8)
    return Sample("wall", rgb, depth, truth, region, material=region.astype(np.uint8))


class Painter:
    """Paints 2 cm too far, wherever the region is."""

    config = preset("tiny")

    def __call__(self, rgb, depth, region, samples):
        assert samples == 1
        painted = np.full(SHAPE, 0.62, np.float32)
        return SimpleNamespace(depth=compose(depth, painted, painted, region))

    def find_region(self, rgb, depth, refine):
        found = offset_region(frame().region, -2)
        return None, refine_region(found, refine.median, refine.dilate, refine.iterations)


@pytest.mark.parametrize("pixels, side", [(-2, 6), (-1, 8), (0, 10), (1, 12), (3, 16), (-5, 0)])
def test_a_region_is_offset_by_pixels(pixels, side):
    region = np.zeros((40, 40), bool)
    region[15:25, 15:25] = True
    out = offset_region(region, pixels)
    assert out.dtype == bool and out.sum() == side**2


def test_costs_are_what_the_frame_was_made_of():
    rows = {row["offset"]: row for row in region_costs(Painter(), frame(), (-2, 0, 3))}
    assert rows[0]["optical_m"] == pytest.approx(0.02, abs=1e-6)
    assert rows[0]["missed_m"] is None and rows[0]["discarded_m"] is None
    assert rows[-2]["missed_m"] == pytest.approx(0.05 - 0.02, abs=1e-6)  # keeps 5 cm instead of 2
    assert rows[-2]["discarded_m"] is None and rows[-2]["optical_m"] > rows[0]["optical_m"]
    assert rows[3]["discarded_m"] == pytest.approx(0.02 - 0.001, abs=1e-6) and rows[3]["missed_m"] is None
    assert rows[3]["optical_m"] == pytest.approx(0.02, abs=1e-6) and rows[3]["whole_m"] > rows[0]["whole_m"]


def test_holes_are_not_readings_that_were_discarded():
    sample = frame()
    depth = np.where(offset_region(sample.region, 3) & ~sample.region, 0, sample.depth).astype(np.float32)
    assert region_costs(Painter(), replace(sample, depth=depth), (3,))[0]["discarded_m"] is None


@pytest.mark.parametrize("gone", [{"depth_gt": None}, {"region": None}, {"region": np.zeros(SHAPE, bool)}])
def test_a_frame_that_cannot_be_priced_is_refused(gone):
    with pytest.raises(ValueError, match="wall lacks"):
        region_costs(Painter(), replace(frame(), **gone), (1,))


def test_refinements_are_compared_on_what_stage_one_finds():
    sample = frame()
    settings = [RefineConfig(0, 0, 0), RefineConfig(3, 3, 2), RefineConfig(7, 5, 3)]
    none, exact, paper = refinement_costs(Painter(), sample, settings)
    assert none["miss_rate"] == pytest.approx(1 - 16 * 26 / 600) and none["area_ratio"] == pytest.approx(16 * 26 / 600)
    assert exact["miss_rate"] < 0.03 and paper["miss_rate"] == 0 and paper["area_ratio"] > 1.3
    assert none["optical_m"] > exact["optical_m"] > 0 and paper["optical_m"] == pytest.approx(0.02, abs=1e-6)
    assert paper["whole_m"] > 0
