from dataclasses import replace

import numpy as np
import pytest
import torch

from ditr_lite import boundary, metrics, pipeline
from ditr_lite.config import RefineConfig, preset
from ditr_lite.data import Sample
from ditr_lite.stage_two import BRANCHES
from ditr_lite.studies import swaps
from ditr_lite.studies.swaps import SWAPS, Swap, Swapped
from ditr_lite.windows import RIM

SHAPE = (64, 96)


@pytest.fixture(scope="module")
def tiny():
    torch.manual_seed(0)
    ditr = pipeline.Ditr(pipeline.build(preset("tiny")), preset("tiny"))
    for part in ditr.parts.values():  # last layers start at zero: let every input reach the output
        for parameter in part.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    return ditr


@pytest.fixture(scope="module")
def frame():
    rng = np.random.default_rng(0)
    truth = np.tile(np.linspace(0.5, 0.8, SHAPE[1], dtype=np.float32), (SHAPE[0], 1))
    region = np.zeros(SHAPE, bool)
    region[20:44, 30:60] = True
    depth = truth + np.float32(0.05) * region
    depth[5:15, 5:30] = 0
    depth[25:30, 35:50] = 0
    rgb = rng.integers(0, 255, (*SHAPE, 3), np.uint8)
    rgb[region] //= 3
    return Sample("frame", rgb, depth, truth, region, material=region.astype(np.uint8))


def complete(ditr, frame, name):
    return Swapped(ditr, SWAPS[name]).complete(frame, samples=2, seed=3)


def test_the_default_swap_is_the_system_bit_for_bit(tiny, frame):
    want = tiny(frame.rgb, frame.depth, samples=2, seed=3).depth
    np.testing.assert_array_equal(complete(tiny, frame, "default"), want)
    given = tiny(frame.rgb, frame.depth, frame.region, samples=2, seed=3).depth
    np.testing.assert_array_equal(complete(tiny, frame, "true region"), given)


def given_to(monkeypatch, ditr, frame, swap):
    """Return what was painted under a swap: (painter, views) of the holes, then of the region."""
    seen, original = [], pipeline.paint

    def paint(painter, views, *rest):
        seen.append((painter, views))
        return original(painter, views, *rest)

    monkeypatch.setattr(pipeline, "paint", paint)
    Swapped(ditr, swap).complete(frame, samples=1)
    monkeypatch.setattr(pipeline, "paint", original)
    return seen


def test_guides_go_where_the_swap_sends_them(monkeypatch, tiny, frame):
    out = tiny(frame.rgb, frame.depth, frame.region, samples=1)
    maps = (out.boundary_rgb, out.boundary_depth, out.boundary_da)
    assert not np.array_equal(maps[0], maps[2])
    for guides in ((boundary.M_DA, boundary.M_RGB), (boundary.M_RGB, boundary.M_DA), (None, boundary.M_D)):
        holes, region = given_to(monkeypatch, tiny, frame, Swap("", guides, region="true"))
        np.testing.assert_array_equal(holes[1].guide[0, 0].numpy() > 0, maps[guides[1]])
        found = region[1].guide[0, 0].numpy() > 0
        assert found.any() == (guides[0] is not None)
        if guides[0] == boundary.M_RGB:  # which the finer step is always given
            np.testing.assert_array_equal(found, region[1].boundary[0, 0].numpy() > 0)


def test_the_finer_step_keeps_its_guide(monkeypatch, tiny, frame):
    boundaries = {}
    for name in ("default", "guides swapped", "no guide"):
        seen = given_to(monkeypatch, tiny, frame, replace(SWAPS[name], region="true"))
        boundaries[name] = [views.boundary for _, views in seen]
        assert all(painter.detail is not None for painter, _ in seen)
    assert boundaries["default"][0].any()
    for name in ("guides swapped", "no guide"):
        assert all(map(torch.equal, boundaries[name], boundaries["default"]))
    assert all(painter.detail is None for painter, _ in given_to(monkeypatch, tiny, frame, SWAPS["no detail"]))


def test_evidence_is_withheld_and_nothing_else(monkeypatch, tiny, frame):
    with_it = given_to(monkeypatch, tiny, frame, Swap("", region="true"))
    without = given_to(monkeypatch, tiny, frame, Swap("", region="true", evidence=False))
    assert [painter.evidence for painter, _ in with_it] == [False, True]  # holes, region
    assert [painter.evidence for painter, _ in without] == [False, False]
    for (one, views), (other, blind) in zip(with_it, without, strict=True):
        same = replace(views, valid=views.valid * (1 - views.region))  # which the final step does not see either
        assert all(torch.equal(getattr(blind, name), getattr(same, name)) for name in vars(views))
        assert replace(one, evidence=False) == replace(other, evidence=False)


def test_the_region_can_be_shown_as_it_is_and_is_painted_as_it_is(monkeypatch, tiny, frame):
    wider = given_to(monkeypatch, tiny, frame, Swap("", region="true"))[1][1].region
    exact = given_to(monkeypatch, tiny, frame, SWAPS["true, exact"])[1][1].region
    assert torch.equal(wider, torch.nn.functional.max_pool2d(exact, 2 * RIM + 1, 1, RIM))
    painted = tiny(frame.rgb, frame.depth, frame.region, samples=1).depth != frame.depth
    assert not painted[~frame.region & (frame.depth > 0)].any()


@pytest.mark.parametrize("only", BRANCHES)
def test_one_branch_paints_everything_with_its_own_guide(monkeypatch, tiny, frame, only):
    swap = Swap("", only=only, region="true")
    seen = given_to(monkeypatch, tiny, frame, swap)
    assert len(seen) == 2 and all(painter.net is tiny.parts[only] for painter, _ in seen)
    own = Swap("").guides[BRANCHES.index(only)]
    assert swap.plan.painters == (only, only) and swap.plan.guides == (own, own)


def test_regions_are_what_they_are_called(tiny, frame):
    empty = complete(tiny, frame, "empty region")
    np.testing.assert_array_equal(empty[frame.depth > 0], frame.depth[frame.depth > 0])  # nothing is repainted
    for name, kernels in {"unrefined": RefineConfig(0, 0, 0), "refined 7/5/3": RefineConfig(7, 5, 3)}.items():
        other = pipeline.Ditr(tiny.parts, replace(tiny.config, refine=kernels))
        want = other(frame.rgb, frame.depth, samples=2, seed=3).depth
        np.testing.assert_array_equal(complete(tiny, frame, name), want)
    with pytest.raises(ValueError, match="no true region"):
        complete(tiny, replace(frame, region=None), "true region")


def test_a_region_can_be_handed_over(tiny, frame):
    other = np.roll(frame.region, 5, axis=1)
    want = tiny(frame.rgb, frame.depth, other, samples=2, seed=3).depth
    np.testing.assert_array_equal(Swapped(tiny, SWAPS["default"]).paint(frame, other, samples=2, seed=3), want)


def test_nothing_of_the_system_itself_is_changed(tiny, frame):
    before = vars(tiny).copy()
    swaps.score_swaps(tiny, [frame], draws=1, progress=False)
    assert vars(tiny) == before


@pytest.mark.parametrize("wrong", [{"only": "optic"}, {"region": "guessed"}])
def test_a_swap_that_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match="expected only to be None"):
        Swap("", **wrong)


def scores(*optical):
    return [{key: {"rmse": r, "mae": r / 2, "rel": r} for key in metrics.SETS} | {"geometric": None} for r in optical]


def test_differences_are_paired_and_signed():
    rows = {"default": scores(0.02, 0.20), "no guide": scores(0.03, 0.21)}
    rows |= {"true region": scores(0.01, 0.10), "true, no evidence": scores(0.02, 0.11)}
    report = swaps.summarise_swaps(rows)
    assert report["no guide"]["optical"]["minus_m"] == [0.01, 0.01, 0.01]  # the frames differ by far more
    assert report["true, no evidence"]["whole"]["minus_m"] == [0.01, 0.01, 0.01]
    assert report["true, no evidence"]["against"] == "true region" and report["default"]["against"] is None
    assert report["default"]["optical"] == {"rmse_m": [0.11, 0.02, 0.2], "minus_m": None}
    assert report["no guide"]["geometric"] == {"rmse_m": None, "minus_m": None}
    text = swaps.format_swaps(report)
    assert "+10.0 [ +10.0,  +10.0]" in text and "to true region" in text and "110.0" in text


def test_the_breakdown_stands_beside_both_readings_of_table_v():
    full = [{key: {"rmse": 0.02, "mae": 0.01, "rel": 0.03} for key in metrics.SETS}] * 3
    parts = swaps.breakdown(full)
    assert parts["optical"] == {"rmse": [0.02] * 3, "mae": [0.01] * 3, "rel": [0.03] * 3}
    lines = swaps.beside_table_v(parts).splitlines()
    cells = {(line.split()[0], line.split()[1]): line.split("]")[1].split()[:2] for line in lines[1:]}
    assert cells["optical", "MAE"] == ["0.033", "0.015"] and cells["geometric", "REL"] == ["0.014", "0.018"]
    assert cells["whole", "RMSE"] == ["0.019", "0.019"]  # Table I
