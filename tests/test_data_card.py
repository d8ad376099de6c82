"""The shipped scenes are what their card says."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

from ditr_lite.data import OPAQUE, SAMPLES, SPLITS, list_samples, load_sample
from ditr_lite.loss_types import Cause, LossType, label

ROOT = Path(__file__).resolve().parents[1]
CARD = (SAMPLES / "README.md").read_text(encoding="utf-8")
FEW = [name for split in SPLITS for name in list_samples(split)[::24]]


def load_tool():
    spec = importlib.util.spec_from_file_location("data_card", ROOT / "tools" / "data_card.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


tool = load_tool()


@pytest.mark.parametrize("split", SPLITS)
def test_card_counts_scenes_seeds_and_infrared_pairs(split):
    names = list_samples(split)
    seeds = [int(name.split("_")[1]) for name in names]
    gone = sorted(set(range(seeds[-1] + 1)) - set(seeds))
    infrared = len(list((SAMPLES / split).glob("*/ir_left.png")))
    listed = f"0 to {seeds[-1]}" + (f" without {', '.join(map(str, gone))}" if gone else "")
    assert f"| {split} | {len(names)} | {listed} | {infrared} |" in CARD


def test_card_explains_every_code_and_shape():
    for code in (*LossType, *Cause):
        assert f"{int(code)} {code.name}" in CARD
    for families in (tool.TRAIN_FAMILIES, tool.TEST_FAMILIES):
        assert all(name in CARD for kind in families.values() for name in kind)


def test_statistics_in_the_card_are_those_of_the_scenes():
    row = next(line for line in CARD.splitlines() if line.startswith("| median `region_share`"))
    shares = [tool.realism.frame_statistics(load_sample(name))["region_share"] for name in list_samples("train")]
    columns = next(line for line in CARD.splitlines() if re.fullmatch(r"\|  \| .*train \| val \| test \|", line))
    place = [title.strip() for title in columns.split("|")].index("train")
    assert float(row.split("|")[place]) == pytest.approx(np.median(shares), abs=1e-4)


def test_size_is_kept():
    assert sum(p.stat().st_size for p in SAMPLES.rglob("*") if p.is_file()) <= 25e6
    assert (SAMPLES / "contact_sheet.png").stat().st_size <= 1e6


@pytest.mark.parametrize("name", FEW)
def test_labels_of_a_scene_agree(name):
    sample = load_sample(name)
    assert np.array_equal(sample.region, sample.material > OPAQUE)
    kinds = np.array([OPAQUE] + [thing["kind"] for thing in sample.meta["things"]])
    assert np.array_equal(sample.material, kinds[sample.instances])
    assert sample.region.mean() >= 0.005 and (sample.depth > 0).mean() >= 0.25
    # the labels are older than the rounding to millimetres, which moves readings over the threshold here and there
    assert (sample.loss != label(sample.depth, sample.depth_gt, sample.region)).mean() < 0.01
    fine = np.isin(sample.loss, (LossType.OUTSIDE_FINE, LossType.INSIDE_FINE, LossType.UNKNOWN))
    assert np.array_equal(sample.cause == Cause.NONE, fine)


def test_no_shape_of_a_test_scene_was_seen_in_training():
    kinds = {split: set() for split in ("train", "test")}
    for split, seen in kinds.items():
        for name in list_samples(split)[:24]:
            seen |= {t["family"] for t in load_sample(name).meta["things"] if t["kind"] != OPAQUE}
    assert kinds["train"] and kinds["test"] and not kinds["train"] & kinds["test"]


def test_the_card_names_the_number_of_real_frames():
    samples = [load_sample(name) for name in list_samples("train")[:3]]
    for count, words in ((1, "1 real frame is few"), (2, "2 real frames are few")):
        assert words in tool.realism_section(samples, samples[:count], "scenes")
    assert "few" not in tool.realism_section(samples, [], "scenes") and "2 real frames are few" in CARD


def test_real_frames_come_from_a_named_folder_only(tmp_path, monkeypatch):
    monkeypatch.setattr(tool, "contact_sheet", lambda *_: pytest.fail("drawn before the folder was read"))
    with pytest.raises(ValueError, match="no ClearGrasp frames"):
        tool.main(["--scenes", str(tmp_path), "--real", str(tmp_path / "absent")])


def test_table_and_ranks_by_hand():
    assert tool.table(["a", "b"], [["x", "1"]]) == "| a | b |\n| --- | ---: |\n| x | 1 |"
    samples = [load_sample(name) for name in list_samples("train")[:4]]
    ranks = {key: rank for key, _, rank in tool.ranks(samples, samples[:1])}
    shares = [s.region.mean() for s in samples]
    assert ranks["region_share"] == 25 * sum(share < shares[0] for share in shares)
