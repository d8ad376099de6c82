import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from ditr_lite import store
from ditr_lite.training import loop
from ditr_lite.training.loop import Recipe, fit, learning_rate

RECIPE = Recipe(steps=12, batch=1, lr=0.05, warmup=3, decay=0.9)


# --- learning rate ----------------------------------------------------------------------------------------------------


def test_learning_rate_law():
    recipe = Recipe(steps=1100, batch=1, lr=2.0, warmup=100)
    rates = [learning_rate(step, recipe) for step in range(1100)]
    assert rates[0] == pytest.approx(0.02) and rates[49] == pytest.approx(1.0)  # a straight line up ...
    assert rates[99] == rates[100] == max(rates) == 2.0
    assert rates[600] == pytest.approx(2 * (0.01 + 0.99 / 2))  # ... then half a cosine, here in its middle
    assert all(np.diff(rates[100:]) < 0) and rates[-1] == pytest.approx(0.02, rel=1e-3)
    assert learning_rate(1100, recipe) == pytest.approx(0.02)


@pytest.mark.parametrize(
    "wrong", [{"steps": 0}, {"steps": -5}, {"batch": 0}, {"lr": -1e-3}, {"lr": float("nan")}, {"lr": float("inf")}]
)
def test_a_recipe_without_sense_is_refused(wrong):
    with pytest.raises(ValueError, match="expected .*, got"):
        replace(RECIPE, **wrong)
    assert replace(RECIPE, lr=0.0).lr == 0


# --- moving average ---------------------------------------------------------------------------------------------------


def test_moving_average_has_its_closed_form():
    model = nn.Linear(1, 1, bias=False)
    average = {"weight": torch.tensor([[4.0]])}
    nn.init.constant_(model.weight, 1.0)
    for _ in range(7):
        loop._follow(average, model, decay=0.9)
    assert average["weight"].item() == pytest.approx(1 + 3 * 0.9**7)


def test_counters_and_codebook_are_copied_not_averaged():
    model = nn.ModuleDict({"quantizer": nn.Linear(1, 1), "bn": nn.BatchNorm1d(1)})
    average = {k: torch.zeros_like(v) for k, v in model.state_dict().items()}
    model["bn"].num_batches_tracked += 5
    loop._follow(average, model, decay=0.9)
    assert torch.equal(average["quantizer.weight"], model["quantizer"].weight)
    assert average["bn.num_batches_tracked"] == 5 and torch.allclose(average["bn.weight"], torch.tensor(0.1))


# --- the loop ---------------------------------------------------------------------------------------------------------


def build():
    torch.manual_seed(1)
    return nn.Sequential(nn.Linear(3, 8), nn.Dropout(0.3), nn.Linear(8, 1))


def loss_of(model, until=None):
    """Return a noisy regression; at step ``until`` it is as if somebody pulled the plug."""

    def step_loss(step):
        if step == until:
            raise KeyboardInterrupt
        x = torch.randn(4, 3)  # from torch's own generator, which fit seeds for each step
        return {"total": ((model(x) - x.sum(1, keepdim=True)) ** 2).mean()}

    return step_loss


def run(folder, until=None, **settings):
    model = build()
    notes = fit("part", model, loss_of(model, until), RECIPE, folder, every=5, **settings)
    return model.state_dict(), notes


def test_interrupted_training_ends_in_the_same_bits(tmp_path):
    straight, notes = run(tmp_path / "straight")
    for until in (8, 11):  # the checkpoints are of steps 5 and 10
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "stopped", until)
    resumed, again = run(tmp_path / "stopped")
    assert all(torch.equal(straight[k], resumed[k]) for k in straight)
    assert [r["step"] for r in again["curve"]] == [5, 10, 12] == [r["step"] for r in notes["curve"]]
    assert [r["total"] for r in again["curve"]] == [r["total"] for r in notes["curve"]]
    logged = (tmp_path / "stopped" / "part.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in logged] == again["curve"]


def test_finished_training_is_not_repeated(tmp_path):
    first, _ = run(tmp_path)
    again, notes = run(tmp_path, until=0)  # would raise if a step were taken
    assert all(torch.equal(first[k], again[k]) for k in first) and notes["steps"] == 12


def test_a_longer_run_goes_on_from_a_shorter_one(tmp_path):
    straight, _ = run(tmp_path)
    model = build()
    notes = fit("part", model, loss_of(model), replace(RECIPE, steps=14), tmp_path, every=5)
    assert [r["step"] for r in notes["curve"]] == [5, 10, 12, 14] and notes["steps"] == 14
    assert not torch.equal(straight["0.weight"], model.state_dict()["0.weight"])


@pytest.mark.parametrize(
    ("changed", "settings"),
    [
        ({"steps": 2}, {}),  # it would say 2 steps of weights with 12
        ({"lr": 0.01}, {}),
        ({"batch": 2}, {}),
        ({"decay": 0.5, "steps": 20}, {}),
        ({}, {"seed": 1}),
        ({}, {"key": "other scenes"}),
    ],
)
def test_checkpoint_of_another_run_is_refused(tmp_path, changed, settings):
    run(tmp_path, key="scenes")
    model = build()
    with pytest.raises(ValueError, match="belongs to another run, .*: delete it or give --work another folder"):
        fit("part", model, loss_of(model), replace(RECIPE, **changed), tmp_path, **{"key": "scenes", **settings})


def test_checkpoint_that_does_not_say_of_which_run_it_is_or_is_cut_short_is_refused(tmp_path):
    run(tmp_path)
    file = tmp_path / "part.checkpoint.safetensors"
    tensors, whole = loop.load_file(str(file)), file.read_bytes()
    store.write_tensors(tensors, file)
    with pytest.raises(ValueError, match="belongs to another run"):
        run(tmp_path)
    for length in (0, 5, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="checkpoint.safetensors is damaged .*: delete it"):
            run(tmp_path)


def test_seed_decides_and_the_average_is_what_remains(tmp_path):
    one, _ = run(tmp_path / "a")
    other, _ = run(tmp_path / "b", seed=1)
    assert not torch.equal(one["0.weight"], other["0.weight"])
    raw = loop.load_file(str(tmp_path / "a" / "part.checkpoint.safetensors"))
    assert torch.equal(one["0.weight"], raw["average.0.weight"])
    assert not torch.equal(one["0.weight"], raw["model.0.weight"])


def test_a_checkpoint_that_fails_leaves_the_one_before(tmp_path, monkeypatch):
    straight, _ = run(tmp_path / "straight")
    real, calls = store.save_file, []

    def breaks_at_the_second(tensors, name, metadata=None):
        calls.append(name)
        if len(calls) == 2:
            with open(name, "wb") as file:
                file.write(b"half a checkpoint")
            raise OSError("disk full")
        real(tensors, name, metadata=metadata)

    monkeypatch.setattr(store, "save_file", breaks_at_the_second)
    with pytest.raises(OSError, match="disk full"):
        run(tmp_path / "full")
    resumed, notes = run(tmp_path / "full")
    assert all(torch.equal(straight[k], resumed[k]) for k in straight)
    assert [r["step"] for r in notes["curve"]] == [5, 10, 12]  # the logged row of the lost checkpoint is not doubled


def test_checkpoint_of_another_model_is_refused(tmp_path):
    run(tmp_path)
    other = nn.Sequential(nn.Linear(3, 9), nn.Dropout(0.3), nn.Linear(9, 1))
    with pytest.raises(ValueError, match="of other sizes: delete it"):
        fit("part", other, loss_of(other), RECIPE, tmp_path)


def test_validation_sees_the_average_in_eval_mode_and_changes_nothing(tmp_path):
    model, seen = build(), []

    def validate():
        assert not model.training and not torch.is_grad_enabled()
        seen.append(model.state_dict()["0.weight"].clone())
        return {"val": 0.5}

    notes = fit("part", model, loss_of(model), RECIPE, tmp_path / "a", validate, every=5)
    plain, _ = run(tmp_path / "b")
    assert torch.equal(seen[-1], model.state_dict()["0.weight"]) and len(seen) == 3
    assert torch.equal(plain["0.weight"], model.state_dict()["0.weight"])
    assert all(row["val"] == 0.5 for row in notes["curve"])
