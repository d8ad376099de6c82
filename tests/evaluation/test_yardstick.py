import importlib.util

import pytest
import torch

from ditr_lite.evaluation import yardstick
from ditr_lite.pipeline import Ditr


@pytest.fixture(scope="module")
def ditr():
    return Ditr.from_pretrained()


def test_the_two_networks_are_of_nearly_one_size(ditr):
    pytest.importorskip("diffusers")
    rows = yardstick.compare_unets(ditr, runs=1)
    ours, other = rows["ours"], rows["diffusers"]
    assert 0.8 < ours["parameters"] / other["parameters"] < 1.25
    assert all(row["ms"] > 0 and row["gflops"] > 0 for row in rows.values())
    table = yardstick.format_unets(rows)
    assert "ms/GFLOP" in table and "diffusers" in table and f"{ours['parameters']:,}" in table


def test_without_the_library_the_yardstick_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install -e '\.\[dev\]'"):
        yardstick.library_unet(4, 4, 8, 2, 1)


def test_throughput_counts_steps_and_leaves_the_system_as_it_was(ditr):
    before = [p.clone() for p in ditr.parts["optical"].parameters()]
    speed = yardstick.throughput(ditr, steps=1)
    assert speed["frames_per_s"] == pytest.approx(speed["batch"] * speed["steps_per_s"])
    assert all(map(torch.equal, before, ditr.parts["optical"].parameters()))
