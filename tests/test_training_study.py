"""tools/training_study.py: every study runs, small, and says what it found."""

import argparse
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
SPEC = importlib.util.spec_from_file_location("training_study", ROOT / "tools" / "training_study.py")
study = importlib.util.module_from_spec(SPEC)
sys.modules["training_study"] = study  # a process that is spawned looks for it there
SPEC.loader.exec_module(study)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a process of its own is forked")
def test_a_killed_training_ends_in_the_same_bits(capsys, monkeypatch):
    monkeypatch.setattr(study, "outlines", toy_run)
    monkeypatch.setattr(study, "crops_of", lambda *_: None)
    found = study.kills(argparse.Namespace(steps=40, count=2, seed=0))
    assert found["same"] == [True, True] and "2 of 2 killed trainings" in capsys.readouterr().out


def toy_run(folder, steps, watch=None, every=2, batch=2):
    """Train three numbers, slowly enough to be killed."""
    import time

    import torch

    torch.manual_seed(0)
    net = torch.nn.Linear(3, 1)

    def step_loss(step):
        time.sleep(0.02)
        return {"total": (net(torch.randn(4, 3)) ** 2).mean()}

    recipe = study.loop.Recipe(steps=steps, batch=1, lr=0.01)
    return study.loop.fit("outlines", net, step_loss, recipe, folder, every=every, progress=False)


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
