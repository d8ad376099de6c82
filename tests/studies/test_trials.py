import json

import pytest

from ditr_lite.config import override, preset
from ditr_lite.store import WEIGHTS
from ditr_lite.studies import trials
from ditr_lite.studies.experiment import touched

TINY = preset("tiny")


def test_what_was_tried_is_what_the_results_say():
    found = trials.trials()
    region = json.loads((WEIGHTS / "results_region.json").read_text())
    factors = json.loads((WEIGHTS / "results_factors.json").read_text())
    assert [t.part for t in found if t.chosen] == ["autoencoder", "refinement", "stage one", "stage two, tiny"]
    rows = {(t.part, t.setting): t for t in found}
    assert rows["refinement", region["shipped"]].chosen and rows["autoencoder", "factor 4"].chosen
    assert rows["refinement", "7/5/3"].optical_m == region["refinement"]["7/5/3"]["optical_m"]["mean"][0]
    assert rows["autoencoder", "factor 8"].optical_m == factors["rows"][2]["floor"]["rmse_m"]["optical"][0]
    variant = next(k for k, row in region["finetuning"].items() if isinstance(row, dict) and "change" in row)
    change = rows["stage one", variant].optical_m - rows["stage one", "not fine-tuned"].optical_m
    assert abs(change - region["finetuning"][variant]["change"]["optical_m"][0]) < 1e-9


def test_the_table_says_when_the_choice_is_not_the_lowest():
    rows = [
        trials.Trial("kernel", "small", 0.040, True, "cheap", "python a"),
        trials.Trial("kernel", "large", 0.039, False, "dear", "python a"),
        trials.Trial("depth", "two", 0.030, True, "", "python b"),
        trials.Trial("depth", "three", 0.031, False, "", "python b"),
    ]
    text = trials.format_trials(rows)
    assert "kernel: chosen small, though large has the lowest error (python a)" in text
    assert "depth: chosen two, which also has the lowest error (python b)" in text
    assert text.count("<- chosen") == 2 and "39.0  dear" in text


def scored(optical, whole):
    return {k: {"mean": [sum(v) / len(v)] * 3, "scenes": v} for k, v in (("optical_m", optical), ("whole_m", whole))}


def test_the_rule_takes_the_cheapest_of_those_not_measurably_above_the_lowest():
    study = {
        "refinement": {
            "0/0/0": scored([0.040, 0.041, 0.042, 0.043], [0.010] * 4),
            "3/3/1": scored([0.030, 0.033, 0.030, 0.033], [0.011] * 4),
            "3/3/3": scored([0.031, 0.030, 0.032, 0.031], [0.012] * 4),
        },
        "shipped": "3/3/1",
    }
    text = trials.format_refinement(study)
    assert "(3/3/3): 3/3/1, 3/3/3" in text and text.endswith("of these 3/3/1 costs the whole frame least, as shipped")
    assert trials.format_refinement(study | {"shipped": "0/0/0"}).endswith("but 0/0/0 is shipped")
    assert trials.paired(study["refinement"], "3/3/1", "0/0/0", "whole_m") == pytest.approx((0.001,) * 3)
    assert "+1.00 [+1.00, +1.00]" in text  # the whole frame of 3/3/1, minus 0/0/0


def fake(rmse):
    """Return a stand-in for a comparison that knows its answers: (setting, seed) -> millimetres."""

    def compare(settings, seed, **how):
        values = {"default": rmse["default"][seed], "changed": rmse[settings.get("unet.heads", "1")][seed]}
        sets = {arm: {"optical": [v, None, v + 2], "geometric": [v, v, v]} for arm, v in values.items()}
        return {"seconds": {"default": 0 if seed else 9, "changed": 5}, "rmse_m": sets}

    return compare


@pytest.fixture
def rows(monkeypatch):
    monkeypatch.setattr(trials, "compare_settings", fake({"default": [10, 11], "1": [20, 22], "4": [10.5, 10.5]}))
    saved = []
    found = trials.try_settings(
        {"one head": {"unet.heads": "1"}, "four heads": {"unet.heads": "4"}}, save=lambda r: saved.append(1)
    )
    assert len(saved) == 4
    return found


def test_every_setting_is_tried_with_every_seed_and_the_default_counts_once(rows):
    assert list(rows) == [trials.DEFAULT, "one head", "four heads"]
    assert [len(row["seconds"]) for row in rows.values()] == [2, 2, 2]
    assert trials.errors(rows[trials.DEFAULT]).tolist() == [[10, 12], [11, 13]]  # the second frame holds no such pixel


def test_every_seed_keeps_its_arms_in_a_folder_of_its_own(monkeypatch, tmp_path):
    homes = []
    compare = fake({"default": [10, 11], "1": [20, 22]})
    monkeypatch.setattr(
        trials, "compare_settings", lambda *a, folder, **how: homes.append(folder) or compare(*a, **how)
    )
    trials.try_settings({"one head": {"unet.heads": "1"}}, folder=tmp_path)
    assert homes == [tmp_path, tmp_path / "seed_1"]


def test_a_change_must_beat_the_seeds_to_be_clear(rows):
    ten = trials.against_default(rows, "one head")
    assert ten.mean == pytest.approx(10.5) and ten.seeds == pytest.approx(2) and ten.clear
    assert not trials.against_default(rows, "four heads").clear
    assert trials.against_default(rows, "one head", "geometric").mean == pytest.approx(10.5)


@pytest.mark.parametrize("settings", trials.SETTINGS.values(), ids=trials.SETTINGS)
def test_every_setting_is_another_stage_two(settings):
    assert override(TINY, **settings) != TINY
    assert set(touched(TINY, settings)) <= {"optical", "geometric", "detail"}
