from dataclasses import replace
from types import SimpleNamespace

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
from ditr_lite.stage_two import BRANCHES, Painter, Views, paint
from ditr_lite.training import batches, recipes
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


def test_what_is_to_be_painted_is_the_encoded_truth(scenes, monkeypatch):
    batch, schedule = plain(scenes), make_schedule(TINY.schedule)
    monkeypatch.setattr(recipes, "encode_picture", lambda *_: [])
    encoder = SimpleNamespace(encode=lambda x: torch.nn.functional.avg_pool2d(x, 4))
    silent = Painter(lambda x_t, *_: torch.zeros_like(x_t), encoder, None, None, False)
    sampler = replace(TINY.sampler, prediction="x0", objective="completion")
    given, _ = branch_inputs("optical", batch, TINY)

    def loss(batch):
        return float(recipes.denoising_loss(silent, batch, given, torch.ones(1), schedule, sampler))

    due = encoder.encode(recipes.fill(batch.gt_n, batch.gt_known)).square().mean()
    assert loss(batch) == pytest.approx(float(due))
    assert loss(replace(batch, depth_n=batch.depth_n + 0.3)) == loss(batch)
    assert loss(replace(batch, gt_n=batch.gt_n + 0.3)) > loss(batch) + 0.01


def test_classes_weigh_what_the_recipe_says(scenes, monkeypatch):
    weights = []
    monkeypatch.setattr(recipes, "region_loss", lambda out, target, weight=None, **_: weights.append(weight))
    recipes.score_region(lambda *_: None, plain(scenes), 0, WHOLE)
    assert weights[0].tolist() == pytest.approx(recipes.CLASS_WEIGHTS)


def test_frames_are_mixed_at_first_and_mostly_still_at_last(pool, scenes, monkeypatch):
    view, still, mixed = batches.frame_view(scenes, 0, (64, 96), None), {}, {}
    recipe = replace(RECIPE, steps=120)
    for step in range(recipe.steps):
        seen, pairs = [], []
        monkeypatch.setattr(batches, "frame_view", lambda *a, seen=seen: seen.append(a[4]) or view)
        monkeypatch.setattr(batches, "mix_views", lambda *a, pairs=pairs: pairs.append(1) or view)
        monkeypatch.setattr(batches, "disturb", lambda view, rng: view)
        monkeypatch.setattr(batches, "batch_of", lambda *_: None)
        recipes.draw_region(pool, TINY, recipe, 0, step, WHOLE)
        assert len(set(seen)) == 1  # a batch as a whole
        still[step], mixed[step] = seen[0], len(pairs) / recipe.batch
    begins = 60
    assert not any(still[k] for k in range(begins)) and 0.25 < np.mean([mixed[k] for k in range(begins)]) < 0.55
    last = range(begins, recipe.steps)
    assert 0.5 < np.mean([still[k] for k in last]) < 0.9
    assert not any(mixed[k] for k in last if still[k])


def test_crops_begin_where_latent_cells_do(pool, monkeypatch):
    v, u = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    ramp = (100 * v + u).expand(8, 1, 64, 96)
    drawn = SimpleNamespace(gt_n=ramp, gt_known=torch.ones_like(ramp))
    monkeypatch.setattr(recipes, "branch_batch", lambda *_: drawn)
    firsts = []
    for step in range(4):
        gt, known = recipes.draw_crops(pool, TINY, RECIPE, 0, 32, 4, step, WHOLE)
        assert torch.equal(gt - gt[:, :, :1, :1], (ramp - ramp[0, 0, 0, 0])[:, :, :32, :32]) and known.all()
        firsts += gt[:, 0, 0, 0].tolist()
    rows, columns = np.divmod(np.array(firsts), 100)
    assert not (rows % 4).any() and not (columns % 4).any()
    assert len(set(rows)) > 3 and rows.max() <= 32 and len(set(columns)) > 3 and columns.max() <= 64


@pytest.mark.parametrize("shown", [True, False])
def test_the_final_step_sees_readings_inside_the_region_only_where_it_may(scenes, shown):
    batch, config = plain(scenes), override(TINY, evidence=shown)
    assert (batch.valid * batch.region).any()
    other = replace(batch, depth_n=batch.depth_n + 0.2 * batch.region)
    decoded = torch.zeros_like(batch.depth_n)
    one, two = (recipes.sharpened(lambda x: x, decoded, b, config) for b in (batch, other))
    assert torch.equal(one, two) != shown


def test_the_final_step_is_scored_by_mean_and_rms_of_what_was_painted(scenes, monkeypatch):
    batch, seeds = plain(scenes), []
    off = torch.zeros_like(batch.gt_n)
    off[:, :, ::2] = 0.1
    paint_here = batch.region.clone()
    paint_here[1] = 0  # a view in which nothing was to be painted counts no more than that
    sharp = batch.bounds.normalise(batch.truth_m.clamp(min=0.1) * off.exp())
    monkeypatch.setattr(recipes, "one_step", lambda *_, seed, share: seeds.append(seed) or (sharp, paint_here))
    monkeypatch.setattr(recipes, "sharpened", lambda model, decoded, *_: decoded)
    for step in (3, 4):
        losses = recipes.score_detail(None, {"optical": None}, TINY, ("optical", batch), step, WHOLE)
    error = off[0][(paint_here * batch.gt_known)[0] > 0]
    mean, rms = float(error.mean()), float(error.square().mean().sqrt())
    assert 0 < mean < 0.9 * rms
    assert float(losses["l1"]) == pytest.approx(mean, rel=1e-3) and float(losses["rms"]) == pytest.approx(rms, rel=1e-3)
    assert float(losses["total"]) == pytest.approx(10 * (mean + rms), rel=1e-3)
    assert seeds == [3, 4]  # other noise at every step
