import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file
from torch import nn

from ditr_lite import store
from ditr_lite.training import loop
from ditr_lite.training.loop import WHOLE, Engine, Recipe, Share, Step, fit, learning_rate

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
        loop.follow_average(average, model, decay=0.9)
    assert average["weight"].item() == pytest.approx(1 + 3 * 0.9**7)


def test_counters_and_codebook_are_copied_not_averaged():
    model = nn.ModuleDict({"quantizer": nn.Linear(1, 1), "bn": nn.BatchNorm1d(1)})
    average = {k: torch.zeros_like(v) for k, v in model.state_dict().items()}
    model["bn"].num_batches_tracked += 5
    loop.follow_average(average, model, decay=0.9)
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


def test_seconds_are_counted_on_after_an_interruption(tmp_path, monkeypatch):
    def clock_from(start):
        clock = iter(range(start, start + 1000, 10))  # ten seconds between looks
        monkeypatch.setattr(loop, "time", SimpleNamespace(monotonic=lambda: next(clock)))

    clock_from(0)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, 8)
    clock_from(5000)
    _, notes = run(tmp_path)
    assert [row["seconds"] for row in notes["curve"]] == [10, 20, 30] and notes["seconds"] == 30


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
        ({"clip": 0.5}, {}),
        ({"law": "constant"}, {}),
        ({"patience": 3}, {}),
        ({"optimiser": "sgd"}, {}),
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
    tensors, whole = load_file(str(file)), file.read_bytes()
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
    raw = load_file(str(tmp_path / "a" / "part.checkpoint.safetensors"))
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


# --- the same numbers as a loop without anything around it ------------------------------------------------------------


def plain_loop(model, step_loss, recipe, seed=0):
    """Train as the first version did: AdamW, clipping, a moving average, and nothing of accelerate."""
    optimiser = torch.optim.AdamW(model.parameters(), lr=recipe.lr, weight_decay=recipe.weight_decay)
    average, totals = {k: v.clone() for k, v in model.state_dict().items()}, []
    for step in range(recipe.steps):
        torch.manual_seed(seed * 1_000_003 + step)
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(step, recipe)
        total = step_loss(step)["total"]
        optimiser.zero_grad(set_to_none=True)
        total.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        loop.follow_average(average, model, min(recipe.decay, (step + 1) / (step + 10)))
        totals.append(float(total.detach()))
    return average, totals


@pytest.mark.parametrize("workers", [0, 1])
def test_one_process_gives_the_bits_of_a_plain_loop(workers):
    reference = build()
    wanted, totals = plain_loop(reference, score_in_steps(reference), RECIPE)
    model, seen = build(), []
    engine = Engine(workers=workers)
    fit(
        "part",
        model,
        score_in_steps(model),
        RECIPE,
        None,
        watch=lambda k, row: seen.append(row["total"]),
        engine=engine,
    )
    assert seen == totals
    assert all(torch.equal(wanted[k], v) for k, v in model.state_dict().items())


# --- shares -----------------------------------------------------------------------------------------------------------


def draw_rows(step, share):
    """Draw 12 rows for the whole batch and keep a share of them."""
    rows = np.random.default_rng([0, step]).normal(size=(12, 3))
    return torch.from_numpy(share.take(rows)).float()


def score_in_steps(model):
    def score(x, step, share):
        noise = share.take(torch.randn(len(x) * share.of, 1))
        return {"total": ((model(x) - x.sum(1, keepdim=True) - 0.1 * noise) ** 2).mean()}

    return Step(draw_rows, score)


def without_dropout():
    torch.manual_seed(1)
    return nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 1))


def test_accumulated_shares_are_the_whole_batch():
    twelve, found = replace(RECIPE, batch=12), {}
    for turns in (1, 2, 3):
        model, seen = without_dropout(), []
        how = {"engine": Engine(accumulate=turns), "watch": lambda k, row, seen=seen: seen.append(row["total"])}
        fit("part", model, score_in_steps(model), twelve, None, **how)
        found[turns] = (seen, model.state_dict())
    for turns in (2, 3):
        np.testing.assert_allclose(found[turns][0], found[1][0], rtol=1e-5)
        for key, value in found[1][1].items():
            torch.testing.assert_close(found[turns][1][key], value, rtol=1e-4, atol=1e-6)


def test_shares_are_equal_parts_in_order():
    rows = torch.arange(6)
    assert torch.equal(torch.cat([Share(k, 3).take(rows) for k in range(3)]), rows) and WHOLE.take([1, 2]) == [1, 2]
    with pytest.raises(ValueError, match="batch of 6 cannot be divided into 4 equal shares"):
        Share(0, 4).take(rows)
    model = build()
    with pytest.raises(ValueError, match="a batch of 1 cannot be divided .* 1 processes x 2 turns: change --batch"):
        fit("part", model, score_in_steps(model), RECIPE, None, engine=Engine(accumulate=2))
    with pytest.raises(ValueError, match="for one process without accumulation"):
        fit("part", model, loss_of(model), replace(RECIPE, batch=2), None, engine=Engine(accumulate=2))


def test_the_largest_seed_trains():
    model = build()
    notes = fit("part", model, loss_of(model), replace(RECIPE, steps=2), None, seed=2**63 - 1)
    assert notes["steps"] == 2


@pytest.mark.parametrize("wrong", [{"accumulate": 0}, {"workers": -1}, {"precision": "fp8"}])
def test_an_engine_without_sense_is_refused(wrong):
    with pytest.raises(ValueError, match="expected accumulate|unknown precision 'fp8'; choose one of auto, no, bf16"):
        Engine(**wrong)


def test_bfloat16_computes_coarsely_and_keeps_the_weights_fine():
    kinds, sums = [], []
    for precision in ("no", "bf16"):
        model = without_dropout()
        model[0].register_forward_hook(lambda module, given, out: kinds.append(out.dtype))
        fit("part", model, score_in_steps(model), RECIPE, None, engine=Engine(precision=precision))
        assert all(v.dtype == torch.float32 for v in model.state_dict().values())
        sums.append(float(model[0].weight.detach().sum()))
    assert set(kinds) == {torch.float32, torch.bfloat16} and sums[0] != sums[1]
    assert sums[0] == pytest.approx(sums[1], abs=0.1)


def test_float32_is_float32_whatever_the_launcher_was_asked_for(monkeypatch):
    monkeypatch.setenv("ACCELERATE_MIXED_PRECISION", "bf16")
    kinds = {}
    for precision in ("no", "auto"):
        model = without_dropout()
        model[0].register_forward_hook(lambda module, given, out, p=precision: kinds.update({p: out.dtype}))
        fit("part", model, score_in_steps(model), replace(RECIPE, steps=1), None, engine=Engine(precision=precision))
    assert kinds == {"no": torch.float32, "auto": torch.bfloat16}


def test_an_error_in_a_worker_is_told():
    def draw(step, share):
        raise ValueError("picture 7 is damaged")

    model = build()
    with pytest.raises(ValueError, match="picture 7 is damaged"):
        fit("part", model, Step(draw, None), RECIPE, None, engine=Engine(workers=1))


# --- what goes wrong --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_stops_with_part_step_and_checkpoint(tmp_path, poison):
    model = build()

    def step_loss(step):
        return {"total": model(torch.ones(2, 3)).mean() * (poison if step == 8 else 1.0)}

    with pytest.raises(ValueError, match="training of part stopped at step 9: .*not finite") as stopped:
        fit("part", model, step_loss, RECIPE, tmp_path, every=5)
    assert f"the last good checkpoint, of step 5, is {tmp_path / 'part.checkpoint.safetensors'}" in str(stopped.value)
    assert all(torch.isfinite(v).all() for v in model.state_dict().values())  # not moved by that step
    with pytest.raises(ValueError, match="there is no checkpoint yet"):
        fit("part", build(), step_loss, replace(RECIPE, lr=0.01), None)


def test_a_gradient_that_is_not_finite_stops_before_the_weights_move(tmp_path):
    model = build()

    def step_loss(step):
        weight = model[0].weight
        flat = (weight - weight.detach()).sum().sqrt()  # 0, and infinitely steep
        return {"total": model(torch.ones(2, 3)).square().mean() + (flat if step == 8 else 0)}

    with pytest.raises(ValueError, match=r"stopped at step 9: .*loss [0-9.]+, norm of the gradient inf"):
        fit("part", model, step_loss, RECIPE, tmp_path, every=5)
    assert all(torch.isfinite(v).all() for v in model.state_dict().values())


def test_every_flipped_bit_of_a_checkpoint_is_noticed(tmp_path):
    run(tmp_path)
    file = tmp_path / "part.checkpoint.safetensors"
    whole = file.read_bytes()
    rng = np.random.default_rng(0)
    header = 8 + int.from_bytes(whole[:8], "little")
    places = [*rng.integers(0, header, 60), *rng.integers(header, len(whole), 40), len(whole) - 1]
    for place in map(int, places):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(flipped)
        with pytest.raises(ValueError, match="is damaged .*: delete it|belongs to another run"):
            run(tmp_path)


def test_a_cut_or_lost_log_does_not_matter(tmp_path):
    straight, notes = run(tmp_path / "straight")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "stopped", 8)
    log = tmp_path / "stopped" / "part.jsonl"
    log.write_text(log.read_text()[:-9])
    resumed, again = run(tmp_path / "stopped")
    assert all(torch.equal(straight[k], resumed[k]) for k in straight)
    assert [r["total"] for r in again["curve"]] == [r["total"] for r in notes["curve"]]
    assert [json.loads(line) for line in log.read_text().splitlines()] == again["curve"]


def as_before_checksums(file):
    """Rewrite a checkpoint as the first version wrote it."""
    with safe_open(str(file), "pt") as opened:
        about = {k: v for k, v in opened.metadata().items() if k in ("run", "steps")}
    store.write_tensors(load_file(str(file)), file, about)


@pytest.mark.parametrize("cut", [0, 9])
def test_a_checkpoint_of_the_first_version_is_taken(tmp_path, cut):
    straight, _ = run(tmp_path / "straight")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "stopped", 11)
    as_before_checksums(tmp_path / "stopped" / "part.checkpoint.safetensors")
    log = tmp_path / "stopped" / "part.jsonl"
    log.write_text(log.read_text()[: len(log.read_text()) - cut])
    with pytest.warns(UserWarning, match="no checksum"):
        resumed, notes = run(tmp_path / "stopped")
    assert all(torch.equal(straight[k], resumed[k]) for k in straight)
    assert [r["step"] for r in notes["curve"]] == ([5, 10, 12] if not cut else [5, 12])


# --- the best that was met --------------------------------------------------------------------------------------------


def scored_by(values):
    """Return a validation that gives these figures, one after the other."""
    left = iter(values)
    return lambda: {"error": next(left)}


@pytest.mark.parametrize(
    ("values", "kept", "last"),
    [([5, 4, 3, 2, 1], 12, 12), ([5, 4, 6, 7, 1], 3, 9), ([1, 2, 3, 4, 5], 0, 6), ([float("nan"), 4, 5, 6, 1], 3, 9)],
)
def test_the_best_average_remains_and_training_stops_early(tmp_path, values, kept, last):
    recipe, model, before = replace(RECIPE, patience=2, ramp=False), build(), build().state_dict()
    how = {"validate": scored_by(values), "every": 3, "best": "error"}
    notes = fit("part", model, loss_of(model), recipe, tmp_path, **how)
    assert notes["best_step"] == kept and notes["steps"] == last == notes["curve"][-1]["step"]
    assert all(torch.equal(before[k], v) for k, v in model.state_dict().items()) == (kept == 0)
    again = build()
    repeated = fit("part", again, loss_of(again, until=last), recipe, tmp_path, **how | {"validate": scored_by([])})
    assert repeated["best_step"] == kept and all(
        torch.equal(again.state_dict()[k], v) for k, v in model.state_dict().items()
    )


# --- other optimisers and laws ----------------------------------------------------------------------------------------


def test_sgd_is_the_textbooks_and_leaves_frozen_weights_out():
    x = nn.Linear(1, 1, bias=False)
    nn.init.constant_(x.weight, 2.0)
    recipe = Recipe(2, 1, 0.01, 0, 0.0, 0.1, "sgd", 0.9, clip=0.0, law="constant")
    fit("x", x, lambda step: {"total": (x.weight**2).sum()}, recipe, None)
    first = 2 - 0.01 * 4.2  # gradient 4 + 0.1 * 2
    assert x.weight.item() == pytest.approx(first - 0.01 * (0.9 * 4.2 + 2.1 * first))


def test_sgd_resumes_in_the_same_bits(tmp_path):
    recipe = replace(RECIPE, optimiser="sgd", momentum=0.9, lr=0.01)
    ends = []
    for stops in ((), (8,)):
        for until in (*stops, None):
            model = build()
            try:
                fit("part", model, loss_of(model, until), recipe, tmp_path / str(len(stops)), every=5)
            except KeyboardInterrupt:
                continue
        ends.append(model.state_dict())
    assert all(torch.equal(ends[0][k], ends[1][k]) for k in ends[0])


def test_laws_of_the_rate():
    falls = replace(RECIPE, steps=100, law="falling", epoch=10, warmup=0, lr=1.0)
    assert learning_rate(0, falls) == learning_rate(9, falls) == 1 and learning_rate(50, falls) == pytest.approx(
        0.5 / 10**0.5
    )
    flat = replace(RECIPE, law="constant", warmup=4, lr=1.0)
    assert [learning_rate(k, flat) for k in (0, 1, 3, 9)] == [0.25, 0.5, 1, 1]
    for wrong in ({"law": "steep"}, {"optimiser": "lion"}):
        with pytest.raises(
            ValueError, match="expected an optimiser of adam, sgd and a law of cosine, constant, falling"
        ):
            replace(RECIPE, **wrong)


# --- time -------------------------------------------------------------------------------------------------------------


def test_steps_are_timed_in_turn_and_change_nothing(monkeypatch):
    clock, seen = iter(np.cumsum([0, 1, 0, 5, 0, 9, 0, 5, 0, 2, 0, 50])), []  # rounds of 1 and 5, 9 and 5, 2 and 50 s
    monkeypatch.setattr(loop.time, "process_time", lambda: float(next(clock)))
    nets = {"quick": nn.Linear(2, 1), "slow": nn.Linear(2, 1)}
    before = {name: net.weight.clone() for name, net in nets.items()}

    def step(name, k):
        seen.append((k, name))
        return {"total": nets[name](torch.ones(1, 2)).sum()}

    steps = {name: partial(step, name) for name in nets}
    assert loop.time_steps(nets, steps, rounds=3) == {"quick": 2.0, "slow": 5.0}  # medians
    assert seen == [(k, name) for k in range(3) for name in nets]
    assert all(torch.equal(net.weight, before[name]) and net.weight.grad is None for name, net in nets.items())
