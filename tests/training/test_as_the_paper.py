"""The paper's recipe for stage one, its rate for the denoiser, and a step of every part at the paper's widths."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from made_scenes import make_scenes

from ditr_lite import diffusion
from ditr_lite.autoencoder import VQAutoencoder
from ditr_lite.boundary import get_backend
from ditr_lite.conditioning import CHANNELS
from ditr_lite.config import override, preset
from ditr_lite.pipeline import build
from ditr_lite.region import RegionNet
from ditr_lite.schedule import make_schedule
from ditr_lite.training import recipes
from ditr_lite.training.as_the_paper import (
    BASE_RATE,
    BATCH,
    DENOISER_BATCH,
    EPOCHS,
    FALL,
    MOMENTUM,
    PEAK,
    WEIGHT_DECAY,
    paper_learning_rate,
    paper_recipe,
    scaled_rate,
    train_region,
    trosnet_learning_rate,
)
from ditr_lite.training.loop import WHOLE, Recipe, learning_rate, optimiser_of
from ditr_lite.training.losses import autoencoder_loss, region_loss
from ditr_lite.training.parts import painter_of
from ditr_lite.training.scenes import Pool, every, first
from ditr_lite.unet import DenoisingUNet


@pytest.fixture(scope="module")
def scenes():
    return make_scenes(4, (48, 64))


def net():
    torch.manual_seed(0)
    return RegionNet(preset("tiny").region)


def test_constants_are_the_papers():
    assert (EPOCHS, BATCH, MOMENTUM, WEIGHT_DECAY) == (200, 16, 0.9, 1e-4)


def test_paper_rate_is_a_cosine_times_an_exponential():
    assert paper_learning_rate(0) == PEAK and paper_learning_rate(EPOCHS) == pytest.approx(0)
    halfway = paper_learning_rate(100)
    assert halfway == pytest.approx(PEAK / 2 / math.sqrt(10))  # cosine: a half; exponential: the root of a tenth
    for epoch in (10, 60, 150):
        cosine = (1 + math.cos(math.pi * epoch / EPOCHS)) / 2
        assert paper_learning_rate(epoch, fall=0) == pytest.approx(PEAK * cosine)
        assert paper_learning_rate(epoch) / paper_learning_rate(epoch, fall=0) == pytest.approx(
            math.exp(-FALL * epoch / EPOCHS)
        )
    rates = [paper_learning_rate(e) for e in range(EPOCHS + 1)]
    assert (np.diff(rates) < 0).all()
    assert paper_learning_rate(3, 999, 10, 0.1) == paper_learning_rate(3, 0, 10, 0.1)


@pytest.mark.parametrize("epoch, epochs", [(-1, 10), (11, 10), (0, 0)])
def test_paper_rate_refuses_epochs_that_there_are_not(epoch, epochs):
    with pytest.raises(ValueError, match="expected an epoch from 0 to"):
        paper_learning_rate(epoch, epochs=epochs)


@pytest.mark.parametrize("steps, epochs", [(200, 2), (250, 3), (299, 3), (40, 1)])
def test_an_epoch_that_is_cut_short_still_learns(steps, epochs):
    recipe = Recipe(steps, 16, PEAK, warmup=0, law="falling", epoch=100)
    rates = [learning_rate(k, recipe) for k in range(steps)]
    assert rates == [paper_learning_rate(k // 100, epochs=epochs) for k in range(steps)] and rates[-1] > 0


def test_trosnet_rate_is_a_line_plus_a_sine_of_period_228():
    assert trosnet_learning_rate(0, 0) == pytest.approx(0.001)
    assert trosnet_learning_rate(0, 57) == pytest.approx(0.0015)  # a quarter of the period: the crest
    assert trosnet_learning_rate(0, 171) == pytest.approx(0.0005)
    assert trosnet_learning_rate(150, 57) == pytest.approx(0.0006 + 0.0003)
    assert trosnet_learning_rate(40, 10) == pytest.approx(trosnet_learning_rate(40, 238))


def test_optimiser_is_the_papers():
    recipe = paper_recipe("region", scenes=33)
    model = net()
    group = optimiser_of(recipe, list(model.parameters())).param_groups[0]
    assert (group["momentum"], group["weight_decay"], group["nesterov"]) == (0.9, 1e-4, False)
    assert (recipe.batch, recipe.epoch, recipe.steps, recipe.clip) == (16, 3, 600, 0)  # S3
    for epoch in (0, 1, 77, 199):
        assert learning_rate(3 * epoch + 2, recipe) == pytest.approx(paper_learning_rate(epoch))


def test_stage_two_has_the_papers_batch_and_rate():
    for branch in ("optical", "geometric"):
        recipe = paper_recipe(branch, scenes=65, epochs=10)
        assert (recipe.batch, recipe.lr, recipe.steps, learning_rate(19, recipe)) == (64, 1e-6, 20, 1e-6)  # S6
    with pytest.raises(ValueError, match="the paper trains no 'detail'"):
        paper_recipe("detail", 10)
    with pytest.raises(ValueError, match="at least 1"):
        paper_recipe("region", 0)


def test_training_learns_follows_the_law_and_repeats(scenes):
    model, rates = net(), []

    def law(epoch, iteration, epochs):
        rates.append((epoch, iteration, epochs))
        return 0.05

    rows = train_region(model, scenes, 8, 3, law, validate=lambda: {"eval_mode": float(not model.training)})
    assert rates == [(i // 2, i, 8) for i in range(16)]
    assert rows[-1]["total"] < 0.9 * rows[0]["total"] and rows[0]["rate"] == 0.05
    assert [r["epoch"] for r in rows] == list(range(8)) and all(r["eval_mode"] == 1 for r in rows)
    assert not model.training and {"ce", "dice", "side", "boundary", "seconds"} <= set(rows[0])
    again = net()
    train_region(again, scenes, 8, 3, lambda *_: 0.05)
    assert all(torch.equal(a, b) for a, b in zip(model.parameters(), again.parameters(), strict=True))


def test_rate_zero_changes_nothing(scenes):
    model, before = net(), net()
    train_region(model, scenes, 1, 4, lambda *_: 0.0)
    assert all(torch.equal(a, b) for a, b in zip(model.parameters(), before.parameters(), strict=True))


def test_class_weights_reach_the_loss(scenes):
    plain, heavy = (
        train_region(net(), scenes, 1, 4, lambda *_: 0.0, class_weights=w)[0] for w in ((1, 1, 1), (0.01, 1, 1))
    )
    assert plain["ce"] != heavy["ce"] and plain["dice"] == pytest.approx(heavy["dice"])


@pytest.mark.parametrize("epochs, batch", [(0, 4), (1, 0)])
def test_nothing_to_do_is_refused(scenes, epochs, batch):
    with pytest.raises(ValueError, match="at least 1"):
        train_region(net(), scenes, epochs, batch)


def test_frames_are_brought_to_the_size_asked_for(scenes):
    seen = []
    model = net()
    model.register_forward_hook(lambda module, given, out: seen.append(tuple(given[0].shape)))
    train_region(model, scenes, 1, 3, lambda *_: 0.0)
    train_region(model, scenes, 1, 4, lambda *_: 0.0, size=(32, 32))
    assert seen == [(3, 3, 48, 64), (1, 3, 48, 64), (4, 3, 32, 32)]


# ---- stage two

PAPER = preset("paper")
SIZE = (32, 64)  # the widths are the paper's, the image is small


def test_the_stated_rate_and_the_scaled_one():
    assert (DENOISER_BATCH, BASE_RATE) == (64, 1e-6)
    assert scaled_rate() == pytest.approx(6.4e-5) and scaled_rate(gpus=2) == pytest.approx(1.28e-4)
    for bad in ({"base": 0.0}, {"batch": 0}, {"gpus": 0}):
        with pytest.raises(ValueError, match="expected a positive base"):
            scaled_rate(**bad)


def region_case():
    model, (height, width) = RegionNet(PAPER.region), SIZE
    rgb, depth, valid = torch.randn(2, 3, height, width), torch.randn(2, 1, height, width), torch.ones(2, 1, *SIZE)
    target = (depth[:, 0] > 0).long()
    return model, lambda: region_loss(model(rgb, depth, valid), target)["total"]


def autoencoder_case():
    model, depth = VQAutoencoder(PAPER.autoencoder), F.avg_pool2d(torch.randn(2, 1, *SIZE), 9, 1, 4)
    return model, lambda: autoencoder_loss(depth, model(depth), torch.ones_like(depth))["total"]


def denoiser_case():
    """Eq. 8 by way of Eq. 9: the network gives x0, what is scored is the noise that follows from it."""
    c = PAPER.autoencoder.latent_channels
    model, schedule = DenoisingUNet(PAPER.unet, c, len(CHANNELS)), make_schedule(PAPER.schedule)
    torch.nn.init.normal_(model.out.weight, std=0.05)  # zero at first, which would hide every other gradient
    cond, x0, eps = torch.randn(2, len(CHANNELS), *SIZE), *torch.randn(2, 2, c, SIZE[0] // 4, SIZE[1] // 4)
    t = torch.tensor([100, 900])
    x_t = diffusion.q_sample(x0, t, eps, schedule)

    def loss():
        pred_x0 = model(x_t, t, model.features(cond), x0, torch.ones_like(x0[:, :1]))
        return diffusion.loss(diffusion.eps_from_x0(x_t, t, pred_x0, schedule), x0, eps, t, schedule)

    return model, loss


@pytest.mark.parametrize(("case", "lr"), [(region_case, 1e-3), (autoencoder_case, 1e-5), (denoiser_case, 6.4e-5)])
def test_a_step_of_training_runs_at_the_papers_widths(case, lr):
    torch.manual_seed(0)
    resource = pytest.importorskip("resource", reason="Windows does not tell the peak of a process's memory")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    model, loss = case()
    optimiser = torch.optim.Adam(model.train().parameters(), lr)
    before = loss()
    before.backward()
    without = [name for name, p in model.named_parameters() if p.grad is None]
    optimiser.step()
    assert not without and torch.isfinite(before) and loss() < before
    more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak
    assert more < 2e6 * (1024 if sys.platform == "darwin" else 1)  # under 2 GB; kilobytes, on macOS bytes


def test_the_papers_preset_minimises_eq_8(monkeypatch):
    scored, loss = [], diffusion.loss
    monkeypatch.setattr(recipes.diffusion, "loss", lambda *a: scored.append(a) or loss(*a))
    tiny = override(preset("tiny"), **{"evidence": False})
    eq8 = override(tiny, **{"sampler.objective": preset("paper").sampler.objective})
    pool, totals = Pool([make_scenes(2, (64, 96))]), []
    for config in (tiny, eq8):
        torch.manual_seed(0)
        painter = painter_of("geometric", build(config), config)
        how = (config, Recipe(9, 8, 1e-3), get_backend("classical"))
        totals.append(float(recipes.branch_step("geometric", painter, pool, *how)(0)["total"].detach()))
    (_, _, _, t_ours, *_, no_weight, ours), (out, x0, eps, t, schedule, _, _, mask) = scored
    assert (t_ours == 999).sum() == 4 and (t == 999).sum() == 0  # half of a batch is the last step; or any may come
    assert no_weight is None and ours.max() > 1 > ours.min() > 0  # cells that must be painted count most
    assert mask.min() == 0 and (mask == 1).float().mean() > 0.5  # those of known truth alike
    x_t = diffusion.q_sample(x0, t, eps, schedule)
    noise = diffusion.eps_from_x0(x_t, t, out, schedule)
    squared, weight = ((noise - eps) ** 2).flatten(1), mask.expand_as(eps).flatten(1)
    assert totals[1] == pytest.approx(float(((weight * squared).sum(1) / weight.sum(1)).mean()), rel=1e-3)
    with pytest.raises(ValueError, match="unknown sampler.objective 'eq9'; choose one of completion, eq8"):
        override(tiny, **{"sampler.objective": "eq9"})


def test_in_the_papers_epochs_every_frame_is_seen_once():
    depth = np.stack([np.full((64, 96), 1000 * 2**k, np.uint16) for k in range(4)])  # told apart by their distance
    few = replace(make_scenes(4, (64, 96)), depth=depth, depth_gt=depth)
    config, recipe = preset("tiny"), replace(paper_recipe("region", scenes=4), batch=3, epoch=2)
    step = recipes.region_step(net(), Pool([first(few, 2), every(few, [2, 3])]), config, recipe)
    for epoch in range(3):
        lows = [step.draw(k, WHOLE).bounds.low.flatten() for k in (2 * epoch, 2 * epoch + 1)]
        assert len({round(10 * float(low)) for low in torch.cat(lows)}) == 4
    uneven = recipes.region_step(net(), Pool([few, few], [0.9, 0.1]), config, recipe)
    assert uneven.draw.func is recipes.draw_region  # shares that were asked for are kept
