import importlib.util
import mmap
import time

import numpy as np
import pytest
import torch

from ditr_lite import pipeline
from ditr_lite.config import override, preset
from ditr_lite.data import Sample, load_sample
from ditr_lite.evaluation import timing
from ditr_lite.evaluation.timing import KINDS, REST, where_time_goes

SHAPE = (64, 96)


def tiny(**settings):
    config = override(preset("tiny"), **settings)
    return pipeline.Ditr(pipeline.build(config), config)


@pytest.fixture(scope="module")
def frame():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (*SHAPE, 3), np.uint8)
    depth = np.tile(np.linspace(0.5, 0.7, SHAPE[1], dtype=np.float32), (SHAPE[0], 1))
    return Sample("frame", rgb, depth, depth)


@pytest.mark.parametrize("window", [64, 0])
def test_every_operation_belongs_to_one_stage(frame, window):
    ditr = tiny(window=window)
    with pytest.raises(ValueError, match="at least 5 runs"):
        timing.time_stages(ditr, frame, runs=4)
    rows = timing.time_stages(ditr, frame, steps=1, samples=1)
    by_name = {row["stage"]: row for row in rows}
    assert len(rows) == 6 and all(row["ms"] > 0 for row in rows)
    assert by_name["boundary maps"]["gflops"] is None
    parts = [row["gflops"] or 0 for row in rows[:-1]]
    assert min(parts[2:4]) > 0  # both branches paint: an untrained stage one claims everything
    assert np.isclose(sum(parts), by_name["whole"]["gflops"])
    assert "stage two: optical branch" in timing.format_latency(rows)


def test_without_a_region_the_optical_branch_costs_nothing(frame, monkeypatch):
    nothing = np.zeros(SHAPE, np.float32), np.zeros(SHAPE, bool)
    monkeypatch.setattr(pipeline.Ditr, "find_region", lambda self, *_: nothing)
    stages = timing.stages(tiny(), frame, 1, 1)
    assert stages["stage two: optical branch"]() is None and len(stages["decoder and detail"]()) == 1


def test_a_window_without_a_reading_is_measured_as_it_is_completed(frame):
    depth, region = frame.depth.copy(), np.zeros(SHAPE, bool)
    depth[8:58, 20:76], region[30:34, 46:50] = 0, True
    ditr = tiny(window=64)
    assert set(timing.views_of(ditr, frame.rgb, depth, region)) == {"geometric", "optical"}
    assert ditr(frame.rgb, depth, region).depth.all()


def test_the_machine_is_described_by_what_it_can_do():
    found = timing.machine()
    assert found["cores"] >= 1 and found["torch"] == torch.__version__ and found["product_ms"] > 1


def test_peak_sees_what_is_allocated_and_given_back():
    def hold():  # 80 MB, gone afterwards, asked of the system: an array may be laid into memory that is held already
        block = np.frombuffer(mmap.mmap(-1, 80_000_000), np.uint8)
        block[:] = 1
        time.sleep(0.5)  # on a busy machine a thread that looks every 2 ms may have to wait for its turn

    before, during = timing.peak_mb(lambda: None), timing.peak_mb(hold)
    assert 60 < during - before < 200


def test_every_stage_of_the_shipped_system_stays_below_the_limit():
    peaks = timing.stage_peaks(None, load_sample("test_00000"), steps=1, samples=1)
    assert "whole" in peaks and all(50 < peak < 1500 for peak in peaks.values())


def test_the_two_networks_are_of_nearly_one_size():
    pytest.importorskip("diffusers")
    config = preset("lite")
    parts = pipeline.build(config)
    ours = sum(p.numel() for p in parts["optical"].parameters())
    rows = timing.compare_unets(pipeline.Ditr(parts, config), runs=1)
    assert rows["ours"]["parameters"] == ours and 0.8 < ours / rows["diffusers"]["parameters"] < 1.25
    assert all(row["ms"] > 0 and row["gflops"] > 0 for row in rows.values())
    table = timing.format_unets(rows)
    assert "ms/GFLOP" in table and "diffusers" in table and f"{ours:,}" in table


def test_without_the_library_the_yardstick_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install -e '\.\[dev\]'"):
        timing.library_unet(4, 4, 8, 2, 1)


def test_throughput_counts_steps_and_leaves_the_system_as_it_was():
    ditr = tiny()
    before = [p.clone() for p in ditr.parts["optical"].parameters()]
    speed = timing.throughput(ditr, steps=1)
    assert speed["frames_per_s"] == pytest.approx(speed["batch"] * speed["steps_per_s"])
    assert all(map(torch.equal, before, ditr.parts["optical"].parameters()))


def test_every_operation_is_counted_where_it_belongs():
    conv, x = torch.nn.Conv2d(8, 8, 3, padding=1), torch.randn(2, 8, 64, 64)

    def call():
        time.sleep(0.02)
        return conv(x)

    begin = time.perf_counter()
    spent = where_time_goes(call, runs=2)
    whole = 1000 * (time.perf_counter() - begin)
    assert set(spent) == {*KINDS, REST} and list(spent.values()) == sorted(spent.values(), reverse=True)
    assert spent["convolution"] > 0 and spent["attention"] == 0
    assert 20 <= spent[REST] < whole and sum(spent.values()) < whole


@pytest.mark.parametrize(
    ("call", "kind"),
    [
        (lambda x: torch.matmul(x, x), "matrix product"),
        (lambda x: x.amin(1), "minimum"),
        (lambda x: x.min(1), "minimum"),
        (torch.nn.functional.silu, "activation"),
        (lambda x: torch.nn.functional.group_norm(x[None], 8), "normalisation"),
        (lambda x: torch.cat([x, x]), "moving and resizing"),
        (lambda x: x.cumsum(0), REST),
    ],
)
def test_kinds(call, kind):
    x = torch.randn(512, 512)
    spent = where_time_goes(lambda: [call(x) for _ in range(20)], runs=1)
    named = {k: ms for k, ms in spent.items() if k != REST and ms > 0}  # calling costs time, too
    assert max(named, key=named.get, default=REST) == kind
