from functools import partial

import pytest
import torch

from ditr_lite import stage_two
from ditr_lite.boundary import M_DA, M_RGB
from ditr_lite.conditioning import condition
from ditr_lite.config import override, preset
from ditr_lite.diffusion import sample
from ditr_lite.pipeline import build
from ditr_lite.schedule import make_schedule
from ditr_lite.stage_two import BRANCHES, Painter, Plan, Views, paint, sharpen

TINY = preset("tiny")
SCHEDULE = make_schedule(TINY.schedule)


def painter(config=TINY, detail=True, evidence=True):
    torch.manual_seed(0)
    parts = build(config).eval().requires_grad_(False)
    for part in (parts["optical"], parts["detail"]):
        torch.nn.init.normal_(part.out.weight, std=0.1)
    encoder = parts["encoder"] if "encoder" in parts else None
    return Painter(parts["optical"], parts["autoencoder"], encoder, parts["detail"] if detail else None, evidence)


def views(count=2, seed=0, size=(32, 64)):
    g = torch.Generator().manual_seed(seed)
    rgb = 2 * torch.rand(count, 3, *size, generator=g) - 1
    depth = torch.rand(count, 1, *size, generator=g) - 0.5
    masks = [(torch.rand(count, 1, *size, generator=g) > share).float() for share in (0.3, 0.6, 0.8, 0.8)]
    return Views(rgb, depth, *masks)


def go(who, what, seed=3, **settings):
    return paint(who, what, SCHEDULE, generator=torch.Generator().manual_seed(seed), **settings)


class Named:
    """Writes down when it is called, and passes the call on."""

    def __init__(self, log, name, part):
        self.log, self.name, self.part = log, name, part

    def __getattr__(self, key):
        def called(*args, **kwargs):
            self.log.append(f"{self.name}.{key}")
            return getattr(self.part, key)(*args, **kwargs)

        return called

    def __call__(self, *args):
        self.log.append(self.name)
        return self.part(*args)


def test_the_steps_are_taken_in_the_papers_order(monkeypatch):
    log, who = [], painter()
    monkeypatch.setattr(stage_two, "condition", lambda *a: log.append("condition") or condition(*a))
    parts = (Named(log, "net", who.net), Named(log, "autoencoder", who.autoencoder), None)
    out = go(Painter(*parts, Named(log, "detail", who.detail), True), views(), steps=3, samples=2)
    before, after = ["condition", "autoencoder.encode", "net.features"], ["autoencoder.decode", "detail.spread"]
    assert log == [*before, *["net"] * 3, *after]
    assert out.shape == (2, 2, 1, 32, 64) and out.isfinite().all()


def test_painting_is_these_steps_and_nothing_else():
    who, what = painter(), views()
    image, filled, known = condition(what.rgb, what.depth_n, what.valid, what.region, what.guide, who.evidence)
    masked = who.autoencoder.encode(filled).repeat(2, 1, 1, 1)
    known = known.repeat(2, 1, 1, 1)
    features = [f.repeat(2, 1, 1, 1) for f in who.net.features(image)]
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(masked.shape, generator=generator)

    def net(x, t):
        return who.net(x, t, features, masked, known)

    latents = sample(net, masked.shape, SCHEDULE, 2, "x0", generator=generator, x_T=noise)
    wanted = sharpen(who.detail, who.autoencoder.decode(latents), what)
    assert torch.allclose(go(who, what, steps=2, samples=2).flatten(0, 1), wanted, atol=1e-4)


def test_views_of_a_batch_do_not_influence_each_other():
    who, what = painter(), views(2)
    both = go(who, what)
    first = Views(*(t[:1] for t in vars(what).values()))
    assert torch.allclose(both[:, :1], go(who, first), atol=1e-3)  # its noise is drawn first


def test_samples_share_residual_trust_and_affinities():
    who, what = painter(), views()
    calls = []
    hook = who.detail.out.register_forward_hook(lambda module, given, out: calls.append(len(out)))
    decoded = torch.randn(3, 2, 1, 32, 64, generator=torch.Generator().manual_seed(1))
    together = sharpen(who.detail, decoded.flatten(0, 1), what).unflatten(0, (3, 2))
    hook.remove()
    assert calls == [2]  # once for each view, whatever the samples
    backwards = sharpen(who.detail, decoded.flip(0).flatten(0, 1), what).unflatten(0, (3, 2))
    assert torch.allclose(together.flip(0), backwards, atol=1e-5)


def test_the_final_step_is_told_which_area_is_painted():
    class Shown:
        def spread(self, given, decoded):
            return given[:, 2:5]  # readings outside the region, readings inside, the region

    what = views()
    outside, inside, region = sharpen(Shown(), torch.randn(4, 1, 32, 64), what).split(1, dim=1)
    assert torch.equal(region, what.region)
    assert torch.equal(outside, what.valid * (1 - what.region)) and torch.equal(inside, what.valid * what.region)


def test_a_seed_paints_the_same_and_samples_differ():
    who, what = painter(), views()
    one, again, other = (go(who, what, seed, samples=2) for seed in (1, 1, 2))
    assert torch.equal(one, again) and not torch.equal(one, other) and not torch.equal(one[0], one[1])


def test_a_seed_is_also_of_the_noise_that_the_steps_add():
    who, what, noisy = painter(), views(), partial(sample, eta=1.0)
    one, again, other = (go(who, what, seed, steps=3, sampler=noisy) for seed in (1, 1, 2))
    assert torch.equal(one, again) and not torch.equal(one, other)
    assert not torch.equal(one, go(who, what, 1, steps=3))


def test_many_samples_are_drawn_in_groups_and_are_the_same(monkeypatch):
    who, what, sizes = painter(), views(), []
    whole = go(who, what, steps=2, samples=7)
    monkeypatch.setattr(stage_two, "GROUP", 3)

    def counted(predict, shape, *args, **options):
        sizes.append(shape[0])
        return sample(predict, shape, *args, **options)

    groups = go(who, what, steps=2, samples=7, sampler=counted)
    assert sizes == [6, 6, 2] and torch.allclose(groups, whole, atol=1e-5)


@pytest.mark.parametrize("evidence", [True, False])
def test_readings_inside_the_region_matter_only_as_evidence(evidence):
    who, what = painter(detail=False, evidence=evidence), views()
    moved = torch.where(what.region > 0, what.depth_n + 0.3, what.depth_n)
    other = Views(what.rgb, moved, what.valid, what.region, what.guide, what.boundary)
    assert torch.equal(go(who, what), go(who, other)) != evidence


@pytest.mark.parametrize(
    ("name", "detail", "matters"), [("guide", False, True), ("boundary", False, False), ("boundary", True, True)]
)
def test_the_guide_guides_and_the_final_step_sees_colour_boundaries(name, detail, matters):
    who, what = painter(detail=detail), views()
    other = Views(**{**vars(what), name: 1 - getattr(what, name)})
    assert torch.equal(go(who, what), go(who, other)) != matters


def test_pretrained_features_reach_the_denoiser():
    lite = preset("lite").unet.colour_channels
    who = painter(override(preset("lite"), **{"unet.width": 8, "unet.cond_channels": 8, "detail.width": 8}), False)
    seen = []
    hook = who.net.extractor.register_forward_hook(lambda m, given, out: seen.extend(f.shape for f in given[1]))
    assert go(who, views(1)).isfinite().all()
    hook.remove()
    assert [tuple(s) for s in seen] == [(1, c, 8 // 2**k, 16 // 2**k) for k, c in enumerate(lite)]  # strides 4, 8, 16


def test_the_plan_of_the_paper():
    plan = Plan()
    assert plan.painters == BRANCHES == ("optical", "geometric")
    assert plan.guides == (M_DA, M_RGB) and plan.evidence and plan.detail  # S8
