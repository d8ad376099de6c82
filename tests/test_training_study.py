"""tools/training_study.py: every study runs, small, and says what it found."""

import sys
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest
import training_study as study

import ditr_lite as dl
from ditr_lite.data import SAMPLES
from ditr_lite.simulator import simulate
from ditr_lite.simulator.cameras import PRESETS


def test_differences_are_paired_over_frames_that_have_both(capsys):
    nan = float("nan")
    found = study._difference("x", np.array([0.3, nan, 0.5]), np.array([0.1, 0.2, 0.4]))
    assert found["frames"] == 2 and found["difference"][0] == pytest.approx(0.15)
    assert "x: +0.1500 [" in capsys.readouterr().out


def test_every_study_is_offered_with_its_own_steps(monkeypatch, capsys):
    seen = []
    monkeypatch.setitem(study.STUDIES, "cost", lambda options: seen.append(options.steps) or {})
    monkeypatch.setattr(sys, "argv", ["training_study.py", "cost"])
    study.main()
    assert seen == [study.STEPS["cost"]] and "cores; load before" in capsys.readouterr().out
    assert set(study.STEPS) == {*study.STUDIES, "worker"}


def test_frames_that_are_in_the_work_folder_are_asked_of_the_simulator_by_sensor_and_seed(monkeypatch, tmp_path):
    monkeypatch.setattr(simulate, "simulate_many", lambda *asked: asked)
    options = Namespace(work=tmp_path, workers=2)
    assert study.rendered(options, "d415", "val", 3, 7) == (tmp_path / "d415", "val", 3, 7, 2, 0, "d415")
    assert study.rendered(options, None, "val", 3, 7) == (tmp_path / "default", "val", 3, 7, 2, 0, None)


def test_a_sensor_is_compared_on_the_scenes_that_it_shares_with_the_random_one(monkeypatch):
    monkeypatch.setattr(study, "rendered", lambda options, sensor, *rest: [SAMPLES / "val" / "x"])
    monkeypatch.setattr(study.scenes, "load_scenes", lambda folder, limit: Namespace(names=next(names)))
    names = iter([["a", "b", "c"], *[["b", "c", "d"]] * len(PRESETS)])
    errors = iter([[1.0, 2.0, 4.0], *[[2.5, 4.5, 99.0]] * len(PRESETS)])
    monkeypatch.setattr(study, "errors_by_part", lambda *_: {"region": np.array(next(errors))})
    found = study.sensors(Namespace(frames=3))
    assert set(found) == set(PRESETS)
    for rows in found.values():
        assert rows["region"]["frames"] == 2 and rows["region"]["difference"][0] == pytest.approx(0.5)


@pytest.fixture
def tuned(monkeypatch, tmp_path):
    """What the fine-tuning study hands on, with shipped scenes as those of the sensor and no training."""
    seen = {}

    def rendered(options, sensor, split, count, seed):
        return sorted((SAMPLES / split).iterdir())[:count]

    def adapt(part, config, pool, held_out, start, out, work, recipe):
        out.mkdir(parents=True, exist_ok=True)
        (out / f"{part}.safetensors").write_bytes(b"")
        seen["choose"], seen["learn"], seen["recipe"] = held_out.names, pool.groups[0].names, recipe
        return {"judged": {"kept": "fine-tuned"}, "best_step": 20, "recipe": vars(recipe)}

    def errors_by_part(folder, frames, parts):
        seen["judge"] = frames.names
        return dict.fromkeys(parts, np.full(len(frames), 0.5 if folder == study.WEIGHTS else 0.4))

    def compare(first, second, samples, given_region=False):
        rows = {key: (-0.001, -0.002, -0.0005) for key in dl.metrics.SETS}
        ratio = {key: (1.03, 1.01, 1.05) for key in dl.metrics.SETS}
        rmse = {which: dict.fromkeys(dl.metrics.SETS, [0.1]) for which in ("first", "second")}
        return {"frames": [s.name for s in samples], "rmse_m": rmse, "difference": rows, "ratio": ratio}

    monkeypatch.setattr(study, "HELD_OUT", 3)
    monkeypatch.setattr(study, "rendered", rendered)
    monkeypatch.setattr(study.adapt, "adapt", adapt)
    monkeypatch.setattr(study, "errors_by_part", errors_by_part)
    monkeypatch.setattr(study, "compare_weights", compare)
    options = Namespace(sensor="l515", frames=2, judges=4, parts=["detail"], steps=7, work=Path(tmp_path), limit=2)
    return study.finetune(options), seen


def test_frames_that_judge_fine_tuning_neither_taught_nor_chose(tuned, capsys):
    found, seen = tuned
    assert [len(found["sets"][name]) for name in ("learn", "choose", "judge")] == [2, 3, 4]
    assert all(found["sets"][name] == seen[name] for name in ("learn", "choose", "judge"))
    assert len(set(seen["learn"]) | set(seen["choose"]) | set(seen["judge"])) == 9
    assert found["l515"]["frames"] == seen["judge"] and found["test"]["frames"] == dl.list_samples("test")[:2]
    assert seen["recipe"].steps == 7 and found["detail"]["difference"][0] == pytest.approx(-0.1)


def test_fine_tuning_is_told_in_words(tuned):
    lines = study.outcome("l515", tuned[0])
    assert lines[0].startswith("4 frames of l515") and "smaller error than before (-1.0 mm [-2.0, -0.5])" in lines[1]
    assert "harmed by more than 2 % (1.030 [1.010, 1.050]" in lines[-1] and "not harmed" not in lines[-1]
    tuned[0]["test"]["ratio"]["whole"] = (1.019, 0.9, 1.1)
    assert "whole: not decided whether harmed by more than 2 %" in study.outcome("l515", tuned[0])[-3]
    tuned[0]["test"]["ratio"]["whole"] = (1.0, 0.99, 1.015)
    assert "whole: not harmed by more than 2 %" in study.outcome("l515", tuned[0])[-3]


def test_other_weights_or_settings_are_tuned_in_another_folder(monkeypatch):
    one = study.key_of({"learn": ["a"]}, study.adapt.RECIPES)
    assert one == study.key_of({"learn": ["a"]}, study.adapt.RECIPES) and len(one) == 12
    assert one != study.key_of({"learn": ["b"]}, study.adapt.RECIPES)
    monkeypatch.setattr(study, "read_card", lambda folder: {"parts": {"optical": {"sha256": "other"}}})
    assert one != study.key_of({"learn": ["a"]}, study.adapt.RECIPES)
