import numpy as np
import pytest
import torch

from ditr_lite.conditioning import CHANNELS
from ditr_lite.config import preset
from ditr_lite.data import SAMPLES
from ditr_lite.pipeline import build
from ditr_lite.schedule import make_schedule
from ditr_lite.training import recipes
from ditr_lite.training.batches import Scenes, draw, load_scenes
from ditr_lite.training.loop import Recipe
from ditr_lite.training.parts import PARTS
from ditr_lite.training.recipes import batches, branch_inputs, encode_targets, one_step, paint_all, rng_of

TINY = preset("tiny")
RECIPE = Recipe(steps=40, batch=2, lr=1e-2)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Two validation scenes at half their size."""
    full = load_scenes(SAMPLES / "val", 2, "classical", tmp_path_factory.mktemp("guides") / "maps.npz")
    half = [getattr(full, k)[..., ::2, ::2] for k in ("depth", "depth_gt", "material", "guides")]
    return Scenes(full.names, full.rgb[:, ::2, ::2], *half)


@pytest.fixture
def parts():
    torch.manual_seed(0)
    parts = build(TINY)
    for branch in ("optical", "geometric"):
        torch.nn.init.normal_(parts[branch].out.weight, std=0.05)
    return parts


def step_of(part, parts, scenes):
    if part == "region":
        return recipes.region_step(parts[part], scenes, RECIPE)
    if part == "autoencoder":
        return recipes.autoencoder_step(parts[part], scenes, RECIPE, crop=32)
    if part == "detail":
        return recipes.detail_step(parts[part], paint_all(parts, scenes, TINY, seed=0), RECIPE, len(scenes))
    parts["autoencoder"].eval().requires_grad_(False)
    return recipes.branch_step(part, parts[part], parts["autoencoder"], scenes, TINY, RECIPE)


def test_every_part_has_a_recipe():
    assert tuple(recipes.RECIPES) == PARTS and set(PARTS) == set(build(TINY))


@pytest.mark.parametrize("part", PARTS)
def test_loss_falls_when_one_batch_is_learnt_by_heart(part, parts, scenes):
    step_loss, model = step_of(part, parts, scenes), parts[part].train()
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
def test_a_step_can_be_drawn_again(part, parts, scenes):
    step_loss, totals = step_of(part, parts, scenes), []
    parts[part].eval()
    for step in (4, 4, 5):
        torch.manual_seed(9)
        totals.append(float(step_loss(step)["total"].detach()))
    assert totals[0] == totals[1] != totals[2]


def test_branches_share_what_there_is_to_paint(scenes):
    batch = draw(scenes, np.array([0, 1]), rng_of(0, 0), augment=False)
    region = (batch.material > 0)[:, None].float()
    (optical, op_paint), (geometric, geo_paint) = (branch_inputs(b, batch, TINY) for b in ("optical", "geometric"))
    assert torch.equal(op_paint, region) and torch.equal(geo_paint, (1 - region) * (1 - batch.valid))
    # together with what is kept they are the whole picture, once (Eq. 1 and 2)
    assert torch.equal(op_paint + geo_paint + batch.valid * (1 - region), torch.ones_like(region))
    boundary, trusted = CHANNELS.index("boundary"), CHANNELS.index("trusted")
    assert torch.equal(optical[0][:, boundary], batch.guide_da[:, 0])  # S8: M_DA guides the optical branch
    assert torch.equal(geometric[0][:, boundary], batch.guide_rgb[:, 0])
    assert optical[0][:, trusted].sum() > 0 and geometric[0][:, trusted].sum() == 0


def test_training_shows_regions_that_are_off_and_sometimes_no_evidence(scenes):
    batch = draw(scenes, np.array([0]), rng_of(0, 0), augment=False)
    drawn = [branch_inputs("optical", batch, TINY, np.random.default_rng(k)) for k in range(60)]
    areas = {float(paint.sum()) for _, paint in drawn}
    true = float((batch.material > 0).sum())
    assert min(areas) < true < max(areas) and len(areas) == 6
    shown = np.mean([float(image[:, CHANNELS.index("trusted")].sum()) > 0 for (image, _, _), _ in drawn])
    assert 0.65 < shown < 0.95


def test_targets_are_the_encoded_truth_as_it_is_and_mirrored(parts, scenes):
    targets = encode_targets(parts["autoencoder"].eval(), scenes)
    assert targets.shape == (2, 2, TINY.autoencoder.latent_channels, 24, 32) and targets.dtype == torch.float16
    maps = (getattr(scenes, k)[..., ::-1].copy() for k in ("depth", "depth_gt", "material"))
    mirrored = encode_targets(parts["autoencoder"], Scenes(scenes.names, scenes.rgb, *maps))
    assert torch.allclose(mirrored[:, 0].float(), targets[:, 1].float(), atol=2e-3)
    assert not torch.allclose(targets[:, 0].float(), targets[:, 1].float(), atol=0.1)


def test_batches_run_through_all_frames_once(scenes):
    seen = [b.index.tolist() for b in batches(scenes, 1)]
    assert seen == [[0], [1]] and not any(b.flipped.any() for b in batches(scenes, 2))


def test_one_step_paints_alike_for_a_seed(parts, scenes):
    batch = draw(scenes, np.array([0]), rng_of(0, 0), augment=False)
    given, _ = branch_inputs("optical", batch, TINY)
    net, schedule = parts["optical"].eval(), make_schedule(TINY.schedule)
    one, again, other = (one_step(net, parts["autoencoder"].eval(), given, schedule, TINY, s) for s in (1, 1, 2))
    assert one.shape == (1, 1, 96, 128) and torch.equal(one, again) and not torch.equal(one, other)


def test_what_was_painted_is_drawn_by_index(parts, scenes):
    parts.eval()
    painted = paint_all(parts, scenes, TINY, seed=0)
    batch, decoded, region = painted(np.array([1, 0]), None)
    assert torch.equal(region, (batch.material > 0)[:, None].float())  # the first variant is the scene as it is
    swapped = painted(np.array([0, 1]), None)
    assert torch.equal(decoded, swapped[1].flip(0)) and batch.index.tolist() == [1, 0]
    draws = [painted(np.array([0]), np.random.default_rng(k)) for k in range(8)]
    assert len({float(r.sum()) for _, _, r in draws}) == 2  # and the other one has a region that is off
