import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from ditr_lite.config import override, preset
from ditr_lite.data import SAMPLES
from ditr_lite.pipeline import build
from ditr_lite.studies import denoiser_steps, denoisers
from ditr_lite.training import recipes
from ditr_lite.training.loop import WHOLE
from ditr_lite.training.scenes import Pool, load_scenes

TINY = preset("tiny")


@pytest.fixture(scope="module")
def pool():
    return Pool([load_scenes(SAMPLES / "train", 2)])


@pytest.fixture(scope="module")
def given():
    autoencoder = build(TINY)["autoencoder"].eval().requires_grad_(False)
    return {"autoencoder": autoencoder}


def test_every_variant_is_a_system_that_can_be():
    lite = preset("lite")
    changed = {name: override(lite, **v.settings) for name, v in denoisers.DENOISERS.items()}
    assert changed["default"] == lite and changed["concatenation"].unet.attention_levels == ()
    assert changed["eps"].sampler.prediction == "eps" and not changed["eps"].unet.anchor


@pytest.mark.parametrize("name", ["default", "decoded depth", "orientation", "distilled", "no average", "v"])
def test_a_variant_is_trained_and_scored(name, pool, given, tmp_path):
    painter, config, notes = denoisers.train_denoiser(name, 1e-5, pool, given, TINY, tmp_path)
    again = denoisers.train_denoiser(name, 1e-5, pool, given, TINY, tmp_path)[2]
    assert again == notes  # nothing is trained twice, and no step is timed anew
    assert notes["steps"] == 1 and notes["parameters"] > 0
    errors = denoisers.denoiser_errors(painter, config, pool.groups[0], 1, 2)
    assert len(errors) == 2 and (errors > 0).all()


def test_a_variant_does_not_go_on_above_another_autoencoder(pool, given, tmp_path):
    denoisers.train_denoiser("default", 1e-5, pool, given, TINY, tmp_path)
    torch.manual_seed(1)
    other = {"autoencoder": build(TINY)["autoencoder"].eval()}
    with pytest.raises(ValueError, match="belongs to another run, of other settings"):
        denoisers.train_denoiser("default", 1e-5, pool, other, TINY, tmp_path)


@pytest.fixture
def drawn(pool):
    backend = denoisers.get_backend("classical")
    return recipes.draw_branch("optical", pool, TINY, denoisers.RECIPE, backend, 0, 0, WHOLE)


@pytest.fixture
def painter(given):
    torch.manual_seed(0)
    return denoisers.build_denoiser(denoisers.DENOISERS["default"], given, TINY)[0]


def test_a_question_is_the_one_that_the_branch_asks(painter, drawn):
    torch.manual_seed(3)
    q = denoiser_steps.ask(painter, TINY, drawn, WHOLE)
    out = painter.net(q.x_t, q.t, *q.shown_to(painter))
    schedule = denoisers.make_schedule(TINY.schedule)
    here = denoiser_steps.diffusion.loss(out, q.x0, q.eps, q.t, schedule, TINY.sampler.prediction, mask=q.mask)
    torch.manual_seed(3)
    there = recipes.score_branch("optical", painter, TINY, schedule, drawn, 0, WHOLE)["total"]
    assert here.item() == pytest.approx(there.item(), rel=1e-6)


@pytest.mark.parametrize("kind", denoiser_steps.DECODED)
def test_the_true_depth_costs_nothing_and_a_wrong_one_does(kind, painter, drawn):
    measure, _ = denoiser_steps.DECODED[kind]
    q = denoiser_steps.ask(painter, TINY, drawn, WHOLE)
    assert measure(q.batch.gt_n, q.batch, q.where) < 1e-6
    sloped = q.batch.gt_n + 0.01 * torch.arange(q.where.shape[3])
    assert measure(sloped, q.batch, q.where) > 1e-4
    beside = torch.where(q.where > 0, q.batch.gt_n, q.batch.gt_n + 1)  # what need not be painted
    assert measure(beside, q.batch, q.where) < 1e-6


def test_gradients_do_not_see_a_wrong_level_and_edges_count_more(painter, drawn):
    batch = denoiser_steps.ask(painter, TINY, drawn, WHOLE).batch
    truth = torch.zeros(1, 1, 8, 8)
    truth[..., 4:] = 0.5  # one edge
    ones = torch.ones_like(truth)
    wide = replace(batch, gt_n=truth, gt_known=ones, bounds=type(batch.bounds)(0.5 * ones, 1.5 * ones))
    level = wide.bounds.normalise(1.1 * wide.bounds.denormalise(truth))  # 10 % too far, within the bounds
    assert denoiser_steps.gradient_error(level, wide, ones) < 1e-6
    assert denoiser_steps.depth_error(level, wide, ones).item() == pytest.approx(np.log(1.1), rel=1e-4)
    at_edge, beside = truth.clone(), truth.clone()
    at_edge[..., 4] += 0.1
    beside[..., 6] += 0.1
    errors = [denoiser_steps.edge_error(wrong, wide, ones).item() for wrong in (at_edge, beside)]
    assert errors[0] == pytest.approx((1 + denoiser_steps.EDGE_WEIGHT) * errors[1], rel=1e-4)


@pytest.mark.parametrize("kind", denoiser_steps.DECODED)
def test_decoded_depth_reaches_the_denoiser(kind, painter, pool):
    variant = next(v for v in denoisers.DENOISERS.values() if v.decoded == kind)
    losses = denoisers.variant_step(variant, painter, pool, TINY, 0)(0)
    losses[kind].backward()
    assert painter.net.out.weight.grad.abs().sum() > 0
    total, latent, error = (losses[key].item() for key in ("total", "latent", kind))
    assert total == pytest.approx(latent + denoiser_steps.DECODED[kind][1] * error)


def test_the_second_output_teaches_the_first_and_leaves_it_as_it_is(given, pool, drawn):
    painter, own = denoisers.build_denoiser(denoisers.DENOISERS["orientation"], given, TINY)
    torch.nn.init.normal_(painter.net.out.weight)
    q = denoiser_steps.ask(painter, own, drawn, WHOLE)
    shown = q.x_t, q.t, *q.shown_to(painter)
    latents, orientation = painter.net.both(*shown)
    assert torch.equal(latents, painter.net(*shown)) and latents.shape == q.x0.shape
    assert orientation.shape == (len(q.x0), 3, *q.where.shape[2:])
    losses = denoisers.variant_step(denoisers.DENOISERS["orientation"], painter, pool, own, 0)(0)
    losses["orientation"].backward()
    assert painter.net.orientation.weight.grad.abs().sum() > 0
    assert painter.net.stem.weight.grad.abs().sum() > 0 and painter.net.out.weight.grad is None
    total, latent, oriented = (losses[key].item() for key in ("total", "latent", "orientation"))
    assert total == pytest.approx(latent + denoiser_steps.ORIENTED * oriented)


def test_a_student_learns_the_mean_of_what_its_teacher_draws(painter, drawn, monkeypatch):
    asked = []

    def draw(net, masked, known, features, schedule, steps, samples, prediction, generator):
        asked.append((net, steps, samples))
        return torch.cat([masked + k for k in range(samples)])  # the mean is masked + 1.5

    monkeypatch.setattr(denoiser_steps, "denoise", draw)
    teacher = replace(painter, net=denoisers.copy.deepcopy(painter.net))
    painter.net.out.bias.data.fill_(1.5)  # anchored: what it predicts is masked + 1.5
    loss = denoiser_steps.score_student(painter, TINY, teacher, drawn, 0, WHOLE)["total"]
    assert loss < 1e-10
    assert asked == [(teacher.net, denoiser_steps.TEACHER_STEPS, denoiser_steps.TEACHER_SAMPLES)]
    painter.net.out.bias.data.fill_(2.5)
    loss = denoiser_steps.score_student(painter, TINY, teacher, drawn, 0, WHOLE)["total"]
    assert loss.item() == pytest.approx(1, rel=1e-4)


def test_teacher_and_student_share_the_time(pool, given, tmp_path):
    (tmp_path / "times.json").write_text(json.dumps(dict.fromkeys(denoisers.DENOISERS, 1.0) | {"distilled": 2.0}))
    painter, _, notes = denoisers.train_denoiser("distilled", 8 / 60, pool, given, TINY, tmp_path)
    assert notes["teacher_steps"] * 1.0 + notes["steps"] * 2.0 == 8 and notes["teacher_steps"] == 4
    assert not any(p.requires_grad for p in painter.net.parameters())
    names = {path.name.split(".")[0] for path in tmp_path.glob("*.jsonl")}
    assert names == {"distilled-default", "distilled-distilled"}


def test_all_variants_are_timed_once_and_in_turn(pool, given, tmp_path, monkeypatch):
    seen = []

    def timed(nets, steps):
        seen.append(set(nets))
        return {name: steps[name](0)["total"].item() ** 0 for name in ("default", "distilled", "orientation", "edges")}

    monkeypatch.setattr(denoisers, "time_steps", timed)
    kept = denoisers.variant_times(tmp_path / "times.json", pool, given, TINY)
    assert seen == [set(denoisers.DENOISERS)] and kept["distilled"] == 1
    assert denoisers.variant_times(tmp_path / "times.json", None, None, None) == kept


@pytest.mark.parametrize(("name", "minutes", "reason"), [("gan", 1, "unknown variant"), ("v", 0, "positive number")])
def test_what_cannot_be_is_refused(name, minutes, reason, pool, given, tmp_path):
    with pytest.raises(ValueError, match=reason):
        denoisers.train_denoiser(name, minutes, pool, given, TINY, tmp_path)


def test_the_table_pairs_every_variant_with_the_default():
    usual = np.linspace(0.02, 0.05, 8)
    ways = [denoisers.way_of(*asked) for asked in denoisers.ASKED]
    errors = {"default": dict.fromkeys(ways, usual), "x0": dict.fromkeys(ways, usual + 0.01)}
    summary = denoisers.summarise_denoisers(errors)
    assert summary["x0"][ways[0]]["minus_default"] == pytest.approx((0.01, 0.01, 0.01))
    head, default, x0 = denoisers.format_denoisers({"summary": summary}).splitlines()
    assert "5 steps, 1 sample" in head and "+1.00 [+1.00, +1.00]" in x0 and "3.50" in default
