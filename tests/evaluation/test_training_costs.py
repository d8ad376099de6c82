"""What a training costs: operations and bytes against closed forms, and the time model against made times."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_scenes import make_scenes
from torch import nn

from ditr_lite.config import override, preset
from ditr_lite.evaluation.training_costs import (
    HARDWARE,
    count_training,
    fit_time,
    format_cost,
    measure_step,
    step_cost,
)
from ditr_lite.pipeline import build
from ditr_lite.training.loop import Recipe
from ditr_lite.training.parts import PARTS
from ditr_lite.training.recipes import freeze_early

TINY = preset("tiny")
RECIPE = Recipe(steps=10, batch=4, lr=1e-3)


@pytest.mark.parametrize("device", ["cpu", "meta"])
def test_a_linear_layer_costs_its_closed_form(device):
    net = nn.Sequential(nn.Linear(30, 20, device=device), nn.Tanh())
    x = torch.zeros(7, 30, device=device, requires_grad=True)
    flops, kept = count_training(lambda: [net(x)], net)
    assert flops == 3 * 2 * 7 * 30 * 20  # forwards, and backwards to the weights and to the input
    assert kept == 4 * (7 * 30 + 7 * 20)  # the input for the weights' gradient, the output for the tanh's


@pytest.mark.parametrize("part", PARTS)
def test_every_part_is_counted(part):
    cost = step_cost(part, TINY, RECIPE)
    assert cost.parameters == sum(p.numel() for p in build(TINY)[part].parameters())
    assert cost.frames == 4 and cost.flops > 0 and cost.activations > 0
    assert step_cost(part, TINY, replace(RECIPE, batch=8)).flops == 2 * cost.flops
    shared = step_cost(part, TINY, RECIPE, shares=4)
    assert shared.flops == cost.flops and cost.memory - shared.memory == 3 * cost.activations
    sgd = step_cost(part, TINY, replace(RECIPE, optimiser="sgd"))
    assert cost.memory - sgd.memory == 4 * cost.parameters  # one moment less
    assert (cost.frozen > 0) == (part not in ("region", "autoencoder"))


def test_stage_one_costs_what_its_first_look_costs():
    closer = override(TINY, **{"refine.looks": (1.5, 1.0)})
    for part, factor in (("region", 2.25), ("geometric", 1.0)):
        assert step_cost(part, closer, RECIPE).flops == pytest.approx(factor * step_cost(part, TINY, RECIPE).flops)
    assert "views of 144 x 96" in format_cost("region", closer, RECIPE)


def test_hours_are_operations_over_the_rate_and_the_text_says_all():
    cost = step_cost("region", TINY, RECIPE)
    assert cost.hours(3600, cost.flops) == 1.0
    text = format_cost("region", TINY, RECIPE, 2, 5e9)
    assert "10 steps of 4 views of 96 x 64" in text and "2 views at a time" in text
    assert text.count("hours") == 1 + len(HARDWARE) and "here, at 5 GFLOP/s" in text
    with pytest.raises(ValueError, match="no part 'detail' of the paper preset is trained"):
        step_cost("detail", preset("paper"), RECIPE)


def test_the_time_model_finds_what_made_the_times():
    rng = np.random.default_rng(0)
    gflop, gb = rng.uniform(0.1, 5, 8), rng.uniform(0.01, 0.2, 8)
    model = fit_time(gflop, gb, 0.02 + 0.03 * gflop + 0.5 * gb)
    assert (model.fixed, model.per_gflop, model.per_gb) == pytest.approx((0.02, 0.03, 0.5))
    assert model.seconds(1.0, 0.1) == pytest.approx(0.1)
    falling = fit_time([1, 2, 3], [0.3, 0.2, 0.1], [0.1, 0.2, 0.3])
    assert min(falling.fixed, falling.per_gflop, falling.per_gb) >= 0
    with pytest.raises(ValueError, match="at least 3 measured steps"):
        fit_time([1, 2], [1, 2], [1, 2])


def test_a_measured_step_is_the_counted_one():
    scenes = make_scenes(2, (64, 96))
    gflop, gb, seconds = measure_step("geometric", TINY, scenes, 2, runs=1)
    wide = measure_step("geometric", override(TINY, **{"unet.width": 16}), scenes, 2, runs=1)
    assert gflop == pytest.approx(step_cost("geometric", TINY, replace(RECIPE, batch=2)).flops / 1e9)
    assert wide[0] > 2 * gflop and wide[1] > gb and min(seconds, wide[2]) > 0


def test_the_first_stages_of_a_pretrained_encoder_are_not_trained():
    cost = step_cost("region", preset("lite"), RECIPE)
    model = build(preset("lite"))["region"]
    freeze_early(model)
    assert cost.parameters == sum(p.numel() for p in model.parameters() if p.requires_grad)
    assert cost.frozen == sum(p.numel() for p in model.parameters() if not p.requires_grad) > 0
