"""The shipped scenes are what their card says."""

import re
from pathlib import Path

import data_card as tool
import numpy as np
import pytest

from ditr_lite.cli.simulate import SHIPPED as MADE
from ditr_lite.data import OPAQUE, ROOM_SPLITS, SAMPLES, SPLITS, list_samples, load_sample
from ditr_lite.loss_types import Cause, LossType, label
from ditr_lite.simulator import simulate, textures

ROOT = Path(__file__).resolve().parents[1]
CARD = (SAMPLES / "README.md").read_text(encoding="utf-8")
SHIPPED = [split for split in SPLITS + ROOM_SPLITS if split != "rooms_train"]
FEW = [name for split in SHIPPED for name in list_samples(split)[::24]]


@pytest.mark.parametrize("split", SHIPPED)
def test_card_counts_scenes_seeds_and_infrared_pairs(split):
    names = list_samples(split)
    seeds = [int(name.split("_")[-1]) for name in names]
    gone = sorted(set(range(seeds[-1] + 1)) - set(seeds))
    infrared = len(list((SAMPLES / split).glob("*/ir_left.png")))
    listed = f"0 to {seeds[-1]}" + (f" without {', '.join(map(str, gone))}" if gone else "")
    empty = sum(load_sample(name).meta.get("empty", False) for name in names)
    assert f"| {split} | {len(names)} | {listed} | {empty} | {infrared} |" in CARD


def test_every_shipped_split_is_on_the_card_and_the_others_can_be_rendered():
    assert sorted(SHIPPED) == sorted({path.parent.parent.name for path in SAMPLES.glob("*/*/meta.json")})
    assert "simulate --split rooms_train" in CARD
    with pytest.raises(ValueError, match="rooms_train"):
        list_samples("rooms_train")


def test_the_simulator_makes_all_shipped_scenes_again():
    held = {s: (len(list_samples(s)), len(list((SAMPLES / s).glob("*/ir_left.png")))) for s in SHIPPED}
    assert {split: (count, infrared) for split, count, infrared in MADE} == held


def test_only_rooms_have_sensors_of_their_own_in_each_split():
    def sensors(*names):  # as the README says of the table tops
        return [(scene.camera, scene.stereo.baseline_m, scene.meta["matcher"]) for scene in map(load_sample, names)]

    first, *others = sensors("train_00000", "val_00000", "test_00000")
    assert others == [first, first]
    one, other = sensors("rooms_val_00000", "rooms_00000")
    assert all(a != b for a, b in zip(one, other, strict=True))


def test_seeds_are_counted_from_the_first():
    scenes = [tool.Sample("s", None, None, meta={"seed": seed}) for seed in (5000, 5001, 5003)]
    assert tool.seeds(scenes) == "5000 to 5003 without 5002"


def test_card_explains_every_code_and_shape():
    for code in (*LossType, *Cause):
        assert f"{int(code)} {code.name}" in CARD
    for families in (tool.TRAIN_FAMILIES, tool.TEST_FAMILIES):
        assert all(name in CARD for kind in families.values() for name in kind)


def test_the_card_says_what_went_in_and_which_room_shapes_are_held_out():
    for name in (*textures.PHOTOGRAPHS, *textures.HELD_OUT_PHOTOGRAPHS, *textures.HELD_OUT_SURROUNDINGS):
        assert name in CARD
    assert f"Mitsuba 3 traces {simulate.ROOM_SAMPLES} paths a pixel" in " ".join(CARD.split())
    lines = [line for line in CARD.splitlines() if line.count("|") == 5]
    transparent = next(line for line in lines if line.startswith("| transparent |")).split(" | ")
    assert "flute" in transparent[1] and "wine_glass" in transparent[2] and transparent[3] == "pane, plate |"


@pytest.mark.parametrize("split", ["train", "rooms"])
def test_statistics_in_the_card_are_those_of_the_scenes(split):
    columns = next(line for line in CARD.splitlines() if re.fullmatch(rf"\|  \| (.* \| )?{split} \|.*", line))
    row = next(r for r in CARD.split(columns)[1].splitlines() if r.startswith("| median `region_share`"))
    shares = [tool.realism.frame_statistics(load_sample(name))["region_share"] for name in list_samples(split)]
    place = [title.strip() for title in columns.split("|")].index(split)
    assert float(row.split("|")[place]) == pytest.approx(np.median(shares), abs=1e-4)


def test_size_is_kept():
    assert sum(p.stat().st_size for p in SAMPLES.rglob("*") if p.is_file()) <= 40e6
    for name in ("contact_sheet.png", "contact_sheet_rooms.png"):
        assert (SAMPLES / name).stat().st_size <= 1e6


@pytest.mark.parametrize("name", FEW)
def test_labels_of_a_scene_agree(name):
    sample = load_sample(name)
    assert np.array_equal(sample.region, sample.material > OPAQUE)
    kinds = np.array([OPAQUE] + [thing["kind"] for thing in sample.meta["things"]])
    assert np.array_equal(sample.material, kinds[sample.instances])
    least = 0.005 if sample.meta["split"] in SPLITS else 0.0 if sample.meta["empty"] else 0.002
    assert sample.region.mean() >= least and (sample.depth > 0).mean() >= 0.25
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
        assert tool.few(samples[:count]).startswith(words)
    assert tool.few([]) == "" and "2 real frames are few" in CARD


def test_real_frames_come_from_a_named_folder_only(tmp_path, monkeypatch):
    monkeypatch.setattr(tool, "contact_sheet", lambda *_: pytest.fail("drawn before the folder was read"))
    with pytest.raises(ValueError, match="no ClearGrasp frames"):
        tool.main(["--scenes", str(tmp_path), "--real", str(tmp_path / "absent")])


def test_table_and_ranks_by_hand():
    assert tool.table(["a", "b"], [["x", "1"]]) == "| a | b |\n| --- | ---: |\n| x | 1 |"
    samples = [load_sample(name) for name in list_samples("train")[:4]]
    ranks = {key: rank for key, _, rank in tool.ranks(samples, samples[:1])}
    shares = [s.region.mean() for s in samples]
    assert ranks["region_share"] == 25 * (sum(share < shares[0] for share in shares) + 0.5)
    assert tool.rank([0.0, 0.0, float("nan"), 1.0, 2.0], 0.0) == 25


def test_a_statistic_that_is_mostly_zero_is_no_difference():
    one, other = ([load_sample(name) for name in list_samples(split)[:3]] for split in ("train", "test"))
    assert "beyond_twice_median" not in tool.largest_difference(one, other)


def test_what_the_shipped_card_says_in_words_is_what_the_tool_writes():
    written = {line for line in tool.TEXT.splitlines() if "{" not in line and "}" not in line}
    assert written - set(CARD.splitlines()) == set()
