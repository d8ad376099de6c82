import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ditr_lite import pipeline
from ditr_lite.conditioning import depth_bounds
from ditr_lite.config import RefineConfig, preset
from ditr_lite.pipeline import Ditr, build
from ditr_lite.region import class_boundary, refine_region
from ditr_lite.training import finetune
from ditr_lite.training.batches import Scenes, draw
from ditr_lite.training.finetune import final_rmse, finetune_region, paint, paint_once, soft_compose, soft_region
from ditr_lite.training.recipes import batches

TINY = preset("tiny")
KERNELS = [RefineConfig(), RefineConfig(3, 3, 1), RefineConfig(0, 5, 2), RefineConfig(5, 0, 3), RefineConfig(3, 3, 0)]


def make_scenes(count, shape):
    """Tilted planes at 0.5 to 0.8 m with a bright box of glass or metal, half missing, half 5 cm too far."""
    rng = np.random.default_rng(0)
    gt = np.tile(np.linspace(500, 800, shape[1]).astype(np.uint16), (count, shape[0], 1))
    rgb, material = rng.integers(0, 120, (count, *shape, 3), np.uint8), np.zeros((count, *shape), np.uint8)
    depth = gt.copy()
    gt[:, :3] = 0  # unknown
    for k in range(count):
        top, left = (int(rng.integers(0, n // 2)) for n in shape)
        box = np.s_[k, top : top + shape[0] // 3, left : left + shape[1] // 3]
        rgb[box] += 120
        material[box] = 1 + k % 2
        depth[box] += 50
        depth[k, top : top + shape[0] // 6, left : left + shape[1] // 3] = 0
    guides = np.stack([class_boundary(torch.from_numpy(material).long()).numpy()] * 2, axis=1).astype(np.uint8)
    return Scenes([f"made_{k}" for k in range(count)], rgb, depth, gt, material, guides)


@pytest.fixture(scope="module")
def scenes():
    return make_scenes(2, (64, 96))


@pytest.fixture(scope="module")
def parts():
    torch.manual_seed(0)
    parts = build(TINY).eval().requires_grad_(False)
    for branch in ("optical", "geometric"):
        torch.nn.init.normal_(parts[branch].out.weight, std=0.05)
    torch.nn.init.normal_(parts["detail"].out.weight, std=0.05)
    return parts


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 999), share=st.floats(0.02, 0.98), refine=st.sampled_from(KERNELS))
def test_straight_through_has_the_values_of_the_real_refinement(seed, share, refine):
    probability = np.random.default_rng(seed).random((17, 23)).astype(np.float32) ** (1 / share)
    found = soft_region(torch.from_numpy(probability)[None, None], refine, straight_through=True)[0, 0].numpy()
    wanted = refine_region(probability > 0.5, refine.median, refine.dilate, refine.iterations)
    np.testing.assert_allclose(found, wanted, atol=1e-6)


@pytest.mark.parametrize("refine", KERNELS)
def test_the_soft_region_becomes_the_real_one_as_it_steepens(refine):
    probability = np.random.default_rng(1).random((20, 30)).astype(np.float32)
    probability = np.where(np.abs(probability - 0.5) < 0.05, 0.6, probability)  # nobody steepens a tie
    wanted = refine_region(probability > 0.5, refine.median, refine.dilate, refine.iterations)
    far = [
        np.abs(soft_region(torch.from_numpy(probability)[None, None].double(), refine, k)[0, 0].numpy() - wanted).max()
        for k in (5.0, 50.0, 500.0)
    ]
    assert far[0] > far[1] and far[2] < 1e-3


@pytest.mark.parametrize("straight_through", [False, True])
def test_gradient_asks_for_the_pixels_that_would_gain(straight_through):
    probability = torch.full((1, 1, 9, 9), 0.5)
    probability[..., 4, 4] = 0.55
    probability.requires_grad_()
    region = soft_region(probability, RefineConfig(3, 3, 1), 10.0, straight_through)
    region.sum().backward()
    assert (probability.grad >= 0).all() and probability.grad[0, 0, 4, 4] > 0


def test_the_soft_gradient_is_what_differences_say():
    probability = torch.rand(1, 1, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    assert torch.autograd.gradcheck(
        lambda p: soft_region(p, RefineConfig(3, 3, 2), 4.0), probability.requires_grad_(), eps=1e-7
    )


def test_the_soft_region_refuses_nonsense():
    with pytest.raises(ValueError, match="expected a probability"):
        soft_region(torch.zeros(3, 4), RefineConfig())
    with pytest.raises(ValueError, match="steepness above 0"):
        soft_region(torch.zeros(1, 1, 3, 4), RefineConfig(), 0)


def test_a_hard_region_composes_as_the_pipeline_does():
    rng = np.random.default_rng(2)
    depth = np.where(rng.random((8, 9)) < 0.3, 0, rng.uniform(0.4, 0.9, (8, 9))).astype(np.float32)
    optical, geometric = rng.uniform(0.4, 0.9, (2, 8, 9)).astype(np.float32)
    region = rng.random((8, 9)) < 0.4
    tensors = [torch.from_numpy(np.asarray(a, np.float32))[None, None] for a in (region, depth, depth > 0)]
    painted = [torch.from_numpy(a)[None, None] for a in (optical, geometric)]
    got = soft_compose(*tensors, *painted)[0, 0].numpy()
    np.testing.assert_array_equal(got, pipeline.compose(depth, optical, geometric, region))
    half = soft_compose(torch.full_like(tensors[0], 0.5), *tensors[1:], *painted)[0, 0].numpy()
    np.testing.assert_allclose(half, (optical + np.where(depth > 0, depth, geometric)) / 2, rtol=1e-6)


def test_final_rmse_is_in_metres_per_frame_over_known_pixels(scenes):
    batch = draw(scenes, np.arange(2), np.random.default_rng(0), augment=False)
    metres = torch.tensor([0.02, 0.06]).view(2, 1, 1, 1)
    wrong = batch.gt_n + metres / batch.scale_m + 99 * (1 - batch.gt_known)
    assert final_rmse(wrong, batch).item() == pytest.approx(0.04, rel=1e-4)
    exact = batch.gt_n.clone().requires_grad_()
    final_rmse(exact, batch).backward()
    assert torch.isfinite(exact.grad).all()


def test_painting_is_what_the_pipeline_paints(scenes, parts):
    batch = draw(scenes, np.arange(1), np.random.default_rng(0), augment=False)
    region = (batch.material > 0)[:, None].float()
    ditr = Ditr(copy.deepcopy(parts), TINY)
    image = scenes.rgb[0]
    depth = scenes.depth[0].astype(np.float32) / 1000
    m_rgb, m_da = scenes.guides[0] > 0
    bounds = depth_bounds(depth)
    # the branches draw noise of their own in the pipeline; an untrained net of these sizes hardly hears it
    wanted = ditr.inpaint(image, depth, scenes.material[0] > 0, (m_rgb, m_rgb, m_da), bounds, 1, 1, 0)
    got = [bounds.denormalise(p[0, 0].numpy()) for p in paint(parts, batch, region, TINY)]
    optical_off, geometric_off = (np.abs(g - w[0]).mean() for g, w in zip(got, wanted, strict=True))
    assert optical_off < 0.02 and geometric_off < 0.02
    assert np.abs(got[0] - wanted[1][0]).mean() > 2 * optical_off  # and not the other branch's


def test_paintings_are_looked_up_and_mirrored(scenes, parts):
    painted = paint_once(parts, scenes, TINY)
    plain = next(batches(scenes, 2))
    optical, geometric = painted(plain)
    assert optical.shape == plain.gt_n.shape and not torch.equal(optical, geometric)
    drawn = (draw(scenes, np.array([1]), np.random.default_rng(seed)) for seed in range(20))
    mirrored = next(batch for batch in drawn if batch.flipped.all())
    assert torch.equal(painted(mirrored)[0][0], optical[1].flip(2))


def test_the_painting_region_joins_found_and_true(scenes, parts, monkeypatch):
    seen = []
    monkeypatch.setattr(finetune, "paint", lambda p, b, region, c, s: seen.append(region) or paint(p, b, region, c, s))
    paint_once(parts, scenes, TINY)
    true = torch.from_numpy(scenes.material > 0)[:, None]
    assert (seen[0][true] == 1).all() and set(seen[0].unique().tolist()) <= {0.0, 1.0}


@pytest.mark.parametrize("straight_through", [False, True])
def test_the_region_moves_to_where_final_depth_gains(scenes, parts, straight_through):
    """All readings are off and the painting is right everywhere: the region should grow, whatever the labels say."""
    scenes = replace(scenes, depth=np.where(scenes.depth > 0, scenes.depth + 30, 0).astype(np.uint16))
    model = copy.deepcopy(parts["region"])

    def perfect(batch):
        return batch.gt_n, batch.gt_n

    def shares(net):
        batch = next(batches(scenes, 2))
        return float(finetune.region_probability(net(batch.rgb, batch.depth_n, batch.valid)).detach().mean())

    control, before = copy.deepcopy(model), shares(model)
    settings = {"batch": 2, "rate": 0.05, "straight_through": straight_through}
    finetune_region(control, scenes, perfect, RefineConfig(3, 3, 1), 6, rmse_weight=0, **settings)
    rows = finetune_region(model, scenes, perfect, RefineConfig(3, 3, 1), 6, rmse_weight=50, **settings)
    assert shares(model) > shares(control) and rows[-1]["rmse_m"] < rows[0]["rmse_m"]
    assert len(rows) == 6 and before < 1
    for row in rows:
        assert row["total"] == pytest.approx(row["segmentation"] + 50 * row["rmse_m"], rel=1e-5)


def test_stage_two_stays_frozen_and_stage_one_moves(scenes, parts):
    model, before = copy.deepcopy(parts["region"]), copy.deepcopy(parts.state_dict())
    finetune_region(model, scenes, paint_once(parts, scenes, TINY), TINY.refine, 1, batch=2)
    assert all(torch.equal(v, before[k]) for k, v in parts.state_dict().items())
    assert not torch.equal(model.classify.weight, parts["region"].classify.weight)
    assert not model.training and not any(p.requires_grad for p in model.parameters())


@pytest.mark.parametrize("steps, batch", [(0, 1), (1, 0)])
def test_nothing_to_do_is_refused(scenes, parts, steps, batch):
    with pytest.raises(ValueError, match="at least 1"):
        finetune_region(parts["region"], scenes, None, TINY.refine, steps, batch=batch)


def test_constants_are_the_papers():
    assert (finetune.RATE, finetune.EPOCHS) == (1e-3, 50)
