from dataclasses import replace

import numpy as np
import pytest
import torch
from made_scenes import make_scenes

from ditr_lite.boundary import get_backend
from ditr_lite.conditioning import CHANNELS
from ditr_lite.config import override, preset
from ditr_lite.pipeline import build
from ditr_lite.region import RegionNet
from ditr_lite.region.encoder import ColourEncoder
from ditr_lite.schedule import make_schedule
from ditr_lite.stage_two import BRANCHES, Views, paint
from ditr_lite.training import recipes
from ditr_lite.training.batches import frames_in_order
from ditr_lite.training.loop import WHOLE, Recipe
from ditr_lite.training.parts import PARTS, PRETRAINED, painter_of
from ditr_lite.training.recipes import branch_batch, branch_inputs, freeze_early, one_step, rng_of
from ditr_lite.training.scenes import Pool

TINY = preset("tiny")
RECIPE = Recipe(steps=40, batch=2, lr=1e-2)


BACKEND = get_backend("classical")


@pytest.fixture(scope="module")
def scenes():
    return make_scenes(2, (64, 96))


@pytest.fixture(scope="module")
def pool(scenes):
    return Pool([scenes])


@pytest.fixture
def parts():
    torch.manual_seed(0)
    parts = build(TINY)
    for branch in ("optical", "geometric"):
        torch.nn.init.normal_(parts[branch].out.weight, std=0.05)
    return parts


def step_of(part, parts, pool):
    painters = {branch: painter_of(branch, parts, TINY) for branch in BRANCHES}
    if part == "region":
        return recipes.region_step(parts[part], pool, TINY, RECIPE)
    if part == "autoencoder":
        return recipes.autoencoder_step(parts[part], pool, TINY, RECIPE, crop=32)
    parts["autoencoder"].eval().requires_grad_(False)
    if part == "detail":
        return recipes.detail_step(parts[part], painters, pool, TINY, RECIPE, BACKEND)
    return recipes.branch_step(part, painters[part], pool, TINY, RECIPE, BACKEND)


def test_every_part_has_a_recipe():
    assert tuple(recipes.RECIPES) == PARTS and set(PARTS) == set(build(TINY))
    assert set(build(preset("lite"))) == {*PARTS, PRETRAINED}


@pytest.mark.parametrize("part", PARTS)
def test_loss_falls_when_one_batch_is_learnt_by_heart(part, parts, pool):
    step_loss, model = step_of(part, parts, pool), parts[part].train()
    optimiser = torch.optim.AdamW(model.parameters(), lr=5e-3)
    values = []
    for _ in range(14):
        torch.manual_seed(0)  # the same noise, time steps and batch every time
        losses = step_loss(0)
        optimiser.zero_grad()
        losses["total"].backward()
        if not values:
            silent = [n for n, p in model.named_parameters() if p.grad is None]
        optimiser.step()
        values.append(float(losses["total"].detach()))
    assert np.isfinite(values).all() and not silent
    assert np.mean(values[-3:]) < 0.8 * values[0]


@pytest.mark.parametrize("part", PARTS)
def test_a_step_can_be_drawn_again(part, parts, pool):
    step_loss, totals = step_of(part, parts, pool), []
    parts[part].eval()
    for step in (4, 4, 5):
        torch.manual_seed(9)
        totals.append(float(step_loss(step)["total"].detach()))
    assert totals[0] == totals[1] != totals[2]


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("anchor", [True, False])
def test_every_part_trains_in_bfloat16(part, anchor, parts, pool):
    for branch in BRANCHES:
        net = parts[branch]
        net.config = replace(net.config, anchor=anchor)
    step_loss, totals = step_of(part, parts, pool), []
    for half in (False, True):
        torch.manual_seed(0)
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            losses = step_loss(0)
        totals.append(float(losses["total"].detach()))
    losses["total"].backward()
    assert totals[0] != totals[1] and totals[1] == pytest.approx(totals[0], rel=0.05)
    assert all(torch.isfinite(p.grad).all() for p in parts[part].parameters() if p.grad is not None)


def plain(scenes):
    return next(frames_in_order(scenes, TINY.size, backend=BACKEND))


def test_stage_one_trains_at_its_first_look(pool):
    closer = override(TINY, **{"refine.looks": (1.5, 1.0)})
    for config, size in ((TINY, (64, 96)), (closer, (96, 144))):
        assert recipes.draw_region(pool, config, RECIPE, 0, 3, WHOLE).rgb.shape == (2, 3, *size)


def test_branches_share_what_there_is_to_paint(scenes):
    batch = plain(scenes)
    (optical, op_paint), (geometric, geo_paint) = (branch_inputs(b, batch, TINY) for b in BRANCHES)
    assert torch.equal(op_paint, batch.region) and torch.equal(geo_paint, (1 - batch.region) * (1 - batch.valid))
    # together with what is kept they are the whole picture, once (Eq. 1 and 2)
    assert torch.equal(op_paint + geo_paint + batch.valid * (1 - batch.region), torch.ones_like(op_paint))
    boundary, trusted = CHANNELS.index("boundary"), CHANNELS.index("trusted")
    assert torch.equal(optical[0][:, boundary], batch.guide_da[:, 0])  # S8: M_DA guides the optical branch
    assert torch.equal(geometric[0][:, boundary], batch.guide_rgb[:, 0])
    assert optical[0][:, trusted].sum() > 0 and geometric[0][:, trusted].sum() == 0
    assert branch_inputs("optical", batch, TINY, evidence=False)[0][0][:, trusted].sum() == 0


def test_the_optical_branch_trains_on_windows_where_there_are_any(pool):
    rng = rng_of(0, 0)
    assert branch_batch("optical", pool, TINY, 2, rng).rgb.shape == (2, 3, 64, 64)
    assert branch_batch("geometric", pool, TINY, 2, rng).rgb.shape == (2, 3, 64, 96)
    whole = override(TINY, window=0)
    assert branch_batch("optical", pool, whole, 2, rng).rgb.shape == (2, 3, 64, 96)


def test_evidence_is_now_and_then_withheld(parts, pool, monkeypatch):
    seen = []

    def inputs(branch, batch, config, evidence=True):
        seen.append(evidence)
        raise StopIteration

    monkeypatch.setattr(recipes, "branch_inputs", inputs)
    monkeypatch.setattr(recipes, "branch_batch", lambda *a: a[4].random() and None)
    step = step_of("optical", parts, pool)
    for k in range(80):
        with pytest.raises(StopIteration):
            step(k)
    assert 0.7 < np.mean(seen) < 0.97


def test_one_step_is_what_stage_two_paints(parts, scenes):
    batch = plain(scenes)
    parts.eval()
    for branch, guide in (("optical", batch.guide_da), ("geometric", batch.guide_rgb)):
        painter = painter_of(branch, parts, TINY)
        views = Views(batch.rgb, batch.depth_n, batch.valid, batch.region, guide, batch.guide_rgb)
        generator = torch.Generator().manual_seed(5)
        wanted = paint(painter, views, make_schedule(TINY.schedule), generator=generator)[0]
        found, _ = one_step(branch, painter, batch, TINY, seed=5)
        assert torch.allclose(found, wanted, atol=1e-4)
        assert not torch.equal(found, one_step(branch, painter, batch, TINY, seed=6)[0])


def test_only_a_pretrained_encoder_is_kept_from_learning_at_first():
    lite, tiny = RegionNet(preset("lite").region), RegionNet(TINY.region)
    for model in (lite, tiny):
        freeze_early(model)
    frozen = {n for n, p in lite.named_parameters() if not p.requires_grad}
    encoder = ColourEncoder()
    early = [n for n, _ in encoder.named_parameters() if n.startswith(("stem.", "stages.0.", "stages.1."))]
    assert frozen == {f"encoder_rgb.encoder.{n}" for n in early}
    assert all(p.requires_grad for p in tiny.parameters())
