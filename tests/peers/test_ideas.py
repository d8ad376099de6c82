import numpy as np
import pytest
import torch

from ditr_lite.boundary import get_backend
from ditr_lite.conditioning import Bounds
from ditr_lite.config import preset
from ditr_lite.data import SAMPLES
from ditr_lite.peers import ideas
from ditr_lite.peers.train import shown_views
from ditr_lite.training import recipes
from ditr_lite.training.scenes import Pool, load_scenes

TINY = preset("tiny")


@pytest.fixture(scope="module")
def pool():
    return Pool([load_scenes(SAMPLES / "train", 2)])


@pytest.fixture(scope="module")
def batch(pool):
    return recipes.branch_batch("optical", pool, TINY, 2, np.random.default_rng(0), get_backend("classical"))


@pytest.fixture(scope="module")
def shown(batch):
    return shown_views("optical", batch)


def build(name, std=0.0):
    torch.manual_seed(0)
    idea = ideas.build_idea(name, TINY)
    for p in idea.parameters() if std else ():
        torch.nn.init.normal_(p, std=std)
    return idea


@pytest.mark.parametrize("name", ideas.IDEAS)
def test_every_idea_paints_metres_and_learns(name, batch, shown):
    views, paint = shown
    idea = build(name, 0.02)
    losses = idea.losses(views, [], batch, paint)
    losses["total"].backward()
    assert torch.isfinite(losses["total"]) and all(torch.isfinite(v) for v in losses.values())
    still = [n for n, p in idea.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert set(still) <= {"critic.layers.6.bias"}, still  # it cancels as long as no patch is beyond the hinge
    with torch.no_grad():
        metres = idea.eval().metres(views, [], batch.bounds)
    assert metres.shape == (2, 1, 64, 64) and torch.isfinite(metres).all() and (metres > 0).all()


@pytest.mark.parametrize("name", ["rgb_only", "self_supervised"])
def test_colour_alone_is_shown_no_depth(name, shown):
    views, _ = shown
    seen = []
    idea = build(name)
    idea.net.register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    idea(views, [])
    assert torch.equal(seen[0], views.rgb)


@pytest.mark.parametrize("name", ["regression", "adversarial", "point_completion"])
def test_untrained_a_painter_begins_at_the_fill(name, shown):
    views, _ = shown
    painted = build(name)(views, [])
    assert (painted - ideas.seen(views)[1]).abs().median() < 0.1


def test_a_ray_begins_at_the_fill_and_ends_where_it_is_told(shown):
    views, _ = shown
    idea = build("implicit_rays")
    everything = ideas.seen(views)[1]
    inside = everything.abs() < 1.2
    assert (idea(views, []) - everything)[inside].abs().median() < 0.1
    with torch.no_grad():
        idea.ends.bias[4:] = 1.0  # offsets: every point is moved by tanh(1) of a step
    step = 2 * idea.REACH / (idea.POINTS - 1)
    moved = idea(views, []) - build("implicit_rays")(views, [])
    assert torch.allclose(moved, torch.full_like(moved, step * np.tanh(1.0)), atol=1e-4)


def test_confidence_decides_between_prediction_and_sensor():
    sensor = torch.full((1, 1, 4, 4), 0.5)
    out = torch.zeros(1, 3, 4, 4)
    out[:, 0], out[:, 1, :2], out[:, 2, 2:] = -1, 50, 50
    depth = ideas.blend(out, sensor)
    assert torch.allclose(depth[..., :2, :], torch.tensor(-1.0))
    assert torch.allclose(depth[..., 2:, :], torch.tensor(0.5))


def test_a_projected_cloud_is_its_depth_map_and_near_points_hide_far_ones():
    y, x = torch.meshgrid(torch.linspace(-1, 1, 4), torch.linspace(-1, 1, 6), indexing="ij")
    depth = 0.3 * x + 0.2 * y
    points = torch.stack([x, y, depth]).flatten(1)[None]
    found, weight = ideas.project(points, (4, 6))
    assert torch.allclose(found[0, 0], depth, atol=1e-5) and torch.allclose(weight, torch.ones_like(weight), atol=1e-4)
    behind = torch.cat([points[..., :1], points[..., :1] + torch.tensor([[[0.0], [0.0], [2.0]]])], dim=2)
    found, weight = ideas.project(behind, (4, 6))
    assert abs(float(found[0, 0, 0, 0] - depth[0, 0])) < 0.01 and not weight[0, 0, 1:].any()


def test_the_cloud_holds_readings_at_their_places(shown):
    views, _ = shown
    cloud = build("point_completion").cloud(views)
    assert cloud.shape == (2, 4, 1024)
    column = ((cloud[0, 0] + 1) * 32).round().long()
    row = ((cloud[0, 1] + 1) * 32).round().long()
    assert views.valid[0, 0, row, column].all()
    assert torch.equal(views.depth_n[0, 0, row, column], cloud[0, 2])


def test_chamfer_is_nought_for_the_same_cloud_only():
    points = torch.rand(1, 3, 60, generator=torch.Generator().manual_seed(0))
    assert ideas.chamfer(points, points) < 1e-3
    assert ideas.chamfer(points + torch.tensor([[[0.0], [0.0], [1.0]]]), points) > 0.5


def test_the_critic_is_held_while_it_judges_the_painter(batch, shown):
    views, paint = shown
    idea = build("adversarial", 0.05)
    losses = idea.losses(views, [], batch, paint)
    (gradient,) = torch.autograd.grad(losses["deceived"], [idea.critic.layers[0].weight], allow_unused=True)
    assert gradient is None
    assert torch.autograd.grad(idea.losses(views, [], batch, paint)["critic"], [idea.critic.layers[0].weight])[0].any()
    painter = idea.painter.net.out.weight
    assert torch.autograd.grad(idea.losses(views, [], batch, paint)["critic"], [painter], allow_unused=True)[0] is None


def test_self_supervision_uses_no_truth_and_nothing_inside_the_region(batch, shown):
    views, paint = shown
    idea = build("self_supervised", 0.05)
    usual = idea.losses(views, [], batch, paint)["total"]
    other = ideas.Views(**{**vars(views), "depth_n": views.depth_n + 3 * views.region * views.valid})
    assert torch.allclose(idea.losses(other, [], None, paint)["total"], usual)


def test_alignment_undoes_a_scale_and_a_shift():
    truth = torch.rand(2, 1, 8, 8, generator=torch.Generator().manual_seed(1))
    trusted = (truth > 0.4).float()
    assert torch.allclose(ideas.align(2 * truth - 0.3, truth, trusted), truth, atol=0.02)
    assert torch.equal(ideas.align(truth, truth + 1, torch.zeros_like(truth)), truth)  # nothing to go by


def test_readings_inside_the_region_do_not_steer_solve_and_alignment(shown):
    views, _ = shown
    bounds = Bounds(torch.full((2, 1, 1, 1), 0.4), torch.full((2, 1, 1, 1), 1.0))
    outside = ideas.trusted_metres(views, bounds)
    assert not outside[(views.region * views.valid)[:, 0].numpy() > 0].any() and outside.any(axis=(1, 2)).all()
    everywhere = ideas.Views(**{**vars(views), "region": torch.ones_like(views.region)})
    assert ideas.trusted_metres(everywhere, bounds).any(axis=(1, 2)).all()  # nothing is left outside: all are taken


def test_the_true_orientation_costs_nothing_and_a_wrong_one_does(batch, shown):
    log = batch.truth_m.clamp(min=0.05).log()
    out = torch.zeros(2, 3, *log.shape[2:])
    out[:, 0, :, :-1], out[:, 1, :-1] = (log[..., 1:] - log[..., :-1])[:, 0], (log[..., 1:, :] - log[..., :-1, :])[:, 0]
    assert ideas.orientation_loss(out, batch, shown[1])["gradient_l1"] < 1e-7
    assert ideas.orientation_loss(out + 0.01, batch, shown[1])["gradient_l1"] > 0.005


def test_a_perfect_prediction_scores_next_to_nothing_and_what_is_painted_counts_most(batch, shown):
    paint = shown[1]
    assert ideas.painted_loss(batch.relative_error(batch.gt_n), paint, batch.gt_known)["total"] < 0.01
    wrong = 0.1 * torch.ones_like(paint)
    inside = ideas.painted_loss(wrong * paint, paint, batch.gt_known)["l1"]
    outside = ideas.painted_loss(wrong * (1 - paint), paint, batch.gt_known)["l1"]
    assert inside > 2 * outside > 0


def test_an_unknown_idea_is_refused():
    with pytest.raises(ValueError, match="unknown peer 'oracle'; choose one of regression"):
        ideas.build_idea("oracle", TINY)
