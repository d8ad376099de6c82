import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from made_scenes import make_scenes

from ditr_lite import pipeline
from ditr_lite.boundary import get_backend
from ditr_lite.config import RefineConfig, override, preset
from ditr_lite.pipeline import Ditr, build
from ditr_lite.region import refine_region, region_probability
from ditr_lite.training import finetune
from ditr_lite.training.batches import frames_in_order
from ditr_lite.training.finetune import (
    at_first_look,
    final_depth,
    final_rmse,
    finetune_region,
    frame_painters,
    soft_compose,
    soft_region,
    whole_frames,
)
from ditr_lite.windows import at_centres

TINY = override(preset("tiny"), **{"window": 0, "sampler.samples": 1, "refine.median": 3, "refine.dilate": 3})
KERNELS = [RefineConfig(*k) for k in ((), (3, 3, 1), (0, 5, 2), (5, 0, 3), (3, 3, 0), (3, 3, 1, 0.4))]


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
    wanted = refine_region(probability > refine.threshold, refine.median, refine.dilate, refine.iterations)
    np.testing.assert_allclose(found, wanted, atol=1e-6)


@pytest.mark.parametrize("refine", KERNELS)
def test_the_soft_region_becomes_the_real_one_as_it_steepens(refine):
    probability = np.random.default_rng(1).random((20, 30)).astype(np.float32)
    cut = refine.threshold
    probability = np.where(np.abs(probability - cut) < 0.05, cut + 0.1, probability)  # nobody steepens a tie
    wanted = refine_region(probability > cut, refine.median, refine.dilate, refine.iterations)
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


def frames(scenes):
    return next(frames_in_order(scenes, TINY.size, backend=get_backend("classical")))


def test_final_rmse_is_in_metres_per_frame_over_known_pixels(scenes):
    batch = frames(scenes)
    metres = torch.tensor([0.02, 0.06]).view(2, 1, 1, 1)
    wrong = batch.truth_m + metres + 99 * (1 - batch.gt_known)
    assert final_rmse(wrong, batch).item() == pytest.approx(0.04, rel=1e-4)
    exact = batch.truth_m.clone().requires_grad_()
    final_rmse(exact, batch).backward()
    assert torch.isfinite(exact.grad).all()


def test_painting_is_what_the_pipeline_paints(scenes, parts):
    batch = frames(scenes)
    ditr = Ditr(copy.deepcopy(parts), TINY)
    depth = scenes.depth[0].astype(np.float32) / 1000
    # the branches draw noise of their own in the pipeline; an untrained net of these sizes hardly hears it
    wanted = ditr.inpaint(scenes.rgb[0], depth, scenes.material[0] > 0)
    got = whole_frames(frame_painters(parts, TINY), TINY)(batch, batch.region)
    optical_off = np.abs(got[0][0, 0].numpy() - wanted.optical).mean()
    holes = (depth == 0) & (scenes.material[0] == 0)
    assert optical_off < 0.02 and not holes.all()
    assert np.abs(got[0][0, 0].numpy() - got[1][0, 0].numpy()).mean() > 2 * optical_off  # and not the other branch's


@pytest.mark.parametrize("anchor", [True, False])
def test_painting_in_bfloat16_is_hardly_another(scenes, parts, anchor):
    batch, parts = frames(scenes), copy.deepcopy(parts)
    for branch in ("optical", "geometric"):
        parts[branch].config = replace(parts[branch].config, anchor=anchor)
    paints = whole_frames(frame_painters(parts, TINY), TINY)
    with torch.autocast("cpu", torch.bfloat16):
        coarse = paints(batch, batch.region)
    for found, wanted in zip(coarse, paints(batch, batch.region), strict=True):
        assert found.dtype == torch.float32 and torch.allclose(found, wanted, rtol=0.05)


def test_painters_have_the_finer_final_step_where_there_is_one(scenes, parts):
    painters = frame_painters(parts, TINY)
    assert all(p.detail is parts["detail"] for p in painters.values())
    assert painters["optical"].evidence and not painters["geometric"].evidence
    without = {k: v for k, v in parts.items() if k != "detail"}
    assert frame_painters(torch.nn.ModuleDict(without), TINY)["optical"].detail is None


def test_without_evidence_no_network_sees_a_reading_inside_the_region(scenes, parts):
    config, batch = override(TINY, evidence=False), frames(scenes)
    moved = replace(batch, depth_n=batch.depth_n + batch.region)
    paints = whole_frames(frame_painters(parts, config), config)
    for one, other in zip(paints(batch, batch.region), paints(moved, batch.region), strict=True):
        assert torch.equal(one, other)


def test_branches_paint_for_the_found_region_joined_with_the_true_one(scenes):
    batch = frames(scenes)
    seen = []

    def paints(given, region):
        seen.append(region)
        return torch.full_like(region, 2.0), torch.full_like(region, 3.0)

    soft = torch.full_like(batch.region, 0.2)
    soft[..., :5, :] = 0.7
    depth = final_depth(batch, soft, paints)
    found = (soft > 0.5) | (batch.region > 0)
    assert torch.equal(seen[0] > 0, found) and set(seen[0].unique().tolist()) == {0.0, 1.0}
    readings = batch.bounds.denormalise(batch.depth_n)
    wanted = soft * 2 + (1 - soft) * torch.where(batch.valid > 0, readings, 3.0)
    assert torch.allclose(depth, wanted)


@pytest.mark.parametrize("straight_through", [False, True])
def test_the_region_moves_to_where_final_depth_gains(scenes, parts, straight_through):
    """All readings are off and the painting is right everywhere: the region should grow, whatever the labels say."""
    scenes = replace(scenes, depth=np.where(scenes.depth > 0, scenes.depth + 30, 0).astype(np.uint16))
    model = copy.deepcopy(parts["region"])

    def perfect(batch, region):
        return batch.truth_m, batch.truth_m

    def shares(net):
        batch = frames(scenes)
        return float(region_probability(net(batch.rgb, batch.depth_n, batch.valid)).detach().mean())

    control, before = copy.deepcopy(model), shares(model)
    settings = {"batch": 2, "rate": 0.05, "straight_through": straight_through}
    finetune_region(control, scenes, perfect, TINY, 6, rmse_weight=0, **settings)
    rows = finetune_region(model, scenes, perfect, TINY, 6, rmse_weight=50, **settings)
    assert shares(model) > shares(control)
    assert len(rows) == 6 and before < 1
    for row in rows:
        assert row["total"] == pytest.approx(row["segmentation"] + 50 * row["rmse_m"], rel=1e-5)


def test_stage_two_stays_frozen_and_stage_one_moves(scenes, parts):
    model, before = copy.deepcopy(parts["region"]), copy.deepcopy(parts.state_dict())
    finetune_region(model, scenes, whole_frames(frame_painters(parts, TINY), TINY), TINY, 1, batch=2)
    assert all(torch.equal(v, before[k]) for k, v in parts.state_dict().items())
    assert not torch.equal(model.classify.weight, parts["region"].classify.weight)
    assert not model.training and not any(p.requires_grad for p in model.parameters())


def test_stage_one_is_shown_frames_at_the_size_of_its_first_look(scenes, parts):
    batch, sizes = frames(scenes), []

    def net(rgb, depth_n, valid):
        sizes.append({tuple(x.shape[2:]) for x in (rgb, depth_n, valid)})
        assert set(valid.unique().tolist()) <= {0, 1}
        return parts["region"](rgb, depth_n, valid)

    closer = override(TINY, **{"refine.looks": (1.5,)})
    plain, larger = at_first_look(net, batch, TINY), at_first_look(net, batch, closer)
    assert sizes == [{TINY.size}, {(96, 144)}]
    for key in ("logits", "boundary"):
        assert larger[key].shape == plain[key].shape and not torch.allclose(larger[key], plain[key])


def test_readings_are_brought_to_the_first_look_as_the_system_brings_them(scenes, parts):
    batch, seen = frames(scenes), {}

    def net(rgb, depth_n, valid):
        seen.update(depth_n=depth_n, valid=valid)
        return parts["region"](rgb, depth_n, valid)

    at_first_look(net, batch, override(TINY, **{"refine.looks": (1.5,)}))
    for name, found in seen.items():
        assert np.array_equal(found[0, 0], at_centres(getattr(batch, name)[0, 0].numpy(), (96, 144)))


def test_the_threshold_is_asked_of_the_calibrated_probability(scenes, parts, monkeypatch):
    asked, logits = [], torch.tensor([0.0, 2.0, 1.0])[None, :, None, None].expand(-1, -1, *TINY.size)
    monkeypatch.setattr(finetune, "at_first_look", lambda *_: {"logits": logits})
    monkeypatch.setattr(finetune, "region_loss", lambda *_: {"total": torch.zeros(())})
    monkeypatch.setattr(finetune, "soft_region", lambda p, *_, **how: asked.append(p) or p)
    monkeypatch.setattr(finetune, "final_depth", lambda drawn, region, paints: region)
    monkeypatch.setattr(finetune, "final_rmse", lambda *_: torch.zeros(()))
    config = override(TINY, **{"refine.temperature": 2.0})
    finetune.score_final(None, None, config, 1.0, False, frames(scenes), 0, None)
    assert torch.allclose(asked[0], 1 - (logits / 2).softmax(dim=1)[:, :1])


@pytest.mark.parametrize("steps, batch", [(0, 1), (1, 0)])
def test_nothing_to_do_is_refused(scenes, parts, steps, batch):
    with pytest.raises(ValueError, match="at least 1"):
        finetune_region(parts["region"], scenes, None, TINY, steps, batch=batch)


def test_constants_are_the_papers():
    assert (finetune.RATE, finetune.EPOCHS) == (1e-3, 50)
