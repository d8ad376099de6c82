"""tools/training_study.py: every study runs, small, and says what it found."""

import sys

import numpy as np
import pytest
import training_study as study


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
