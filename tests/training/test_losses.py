import numpy as np
import pytest
import torch

from ditr_lite.autoencoder import VQAutoencoder
from ditr_lite.config import preset
from ditr_lite.region import IGNORE, RegionNet
from ditr_lite.training.losses import autoencoder_loss, class_boundary, depth_steps, region_loss

TINY = preset("tiny")

# ---- stage one


def perfect(target, scale=50.0):
    logits = torch.nn.functional.one_hot(target, 3).movedim(-1, 1).float() * scale
    edge = (class_boundary(target)[:, None].float() * 2 - 1) * scale
    return {"logits": logits, "side": [logits], "boundary": edge}


def test_a_perfect_answer_costs_nothing_and_a_wrong_one_much():
    target = torch.zeros(1, 16, 16, dtype=torch.int64)
    target[:, 4:10, 4:10] = 1
    losses = region_loss(perfect(target), target)
    assert all(float(v) < 1e-3 for v in losses.values())
    wrong = region_loss(perfect(target.flip(1)), target)
    assert all(float(wrong[k]) > 0.1 for k in losses)


def test_class_weight_by_hand():
    target = torch.tensor([[[0, 1]]])
    logits = torch.zeros(1, 3, 1, 2)
    logits[0, :, 0, 1] = torch.tensor([0.0, 2.0, 0.0])  # only the second pixel has an opinion
    ce = torch.tensor([np.log(3.0), -np.log(np.e**2 / (np.e**2 + 2))], dtype=torch.float32)
    out = {"logits": logits, "side": [], "boundary": torch.zeros(1, 1, 1, 2)}
    weighted = region_loss(out, target, torch.tensor([1.0, 4.0, 1.0]))["ce"]
    assert float(weighted) == pytest.approx(float((ce[0] + 4 * ce[1]) / 5), rel=1e-5)


def test_unknown_pixels_are_not_scored():
    torch.manual_seed(0)
    target = torch.randint(0, 3, (1, 12, 12))
    target[:, :4] = IGNORE
    out = {"logits": torch.randn(1, 3, 12, 12, requires_grad=True), "side": [], "boundary": torch.zeros(1, 1, 12, 12)}
    region_loss(out, target)["total"].backward()
    assert (out["logits"].grad[:, :, :4] == 0).all() and (out["logits"].grad[:, :, 4:] != 0).any()


def test_dice_is_a_mean_over_the_foreground_classes():
    out = {"logits": torch.zeros(1, 3, 1, 2), "side": [], "boundary": torch.zeros(1, 1, 1, 2)}
    dice = region_loss(out, torch.tensor([[[0, 1]]]))["dice"]  # each class is given 1/3 everywhere
    there, absent = 1 - (2 / 3 + 1) / (2 / 3 + 1 + 1), 1 - 1 / (2 / 3 + 1)
    assert float(dice) == pytest.approx((there + absent) / 2)


def test_the_outline_is_scored_where_classes_are_known_and_its_own_pixels_count_more():
    target = torch.zeros(1, 5, 8, dtype=torch.int64)
    target[:, :, 3:] = 1
    target[:, :, 6:] = IGNORE
    edge = torch.zeros(1, 1, 5, 8)
    edge[..., 6:] = 99.0  # nobody knows better
    out = {"logits": torch.zeros(1, 3, 5, 8), "side": [], "boundary": edge}
    assert float(region_loss(out, target)["boundary"]) == pytest.approx((10 * 5 + 20) / 30 * np.log(2))
    even = region_loss(out, target, boundary_positive=1.0)["boundary"]
    assert float(even) == pytest.approx(np.log(2))


def test_the_total_weighs_sides_and_outline_and_sides_are_a_mean():
    torch.manual_seed(0)
    target = torch.randint(0, 3, (1, 8, 8))
    out = {"logits": torch.randn(1, 3, 8, 8), "side": [torch.randn(1, 3, 4, 4)], "boundary": torch.randn(1, 1, 8, 8)}
    found = region_loss(out, target)
    assert float(found["total"]) == pytest.approx(
        float(found["ce"] + found["dice"] + 0.4 * found["side"] + 0.5 * found["boundary"])
    )
    assert float(region_loss(out, target, side_weight=0, boundary_weight=0)["total"]) == pytest.approx(
        float(found["ce"] + found["dice"])
    )
    twice = region_loss(out | {"side": 2 * out["side"]}, target)
    assert float(twice["side"]) == pytest.approx(float(found["side"]))


def test_a_step_of_training_reaches_every_parameter_and_learns():
    torch.manual_seed(0)
    net = RegionNet(TINY.region)
    rgb, depth = torch.rand(2, 3, 32, 48) * 2 - 1, torch.rand(2, 1, 32, 48)
    valid = (depth > 0.3).float()
    target = torch.zeros(2, 32, 48, dtype=torch.int64)
    target[:, 8:20, 10:30] = 2
    rgb[:, 0, 8:20, 10:30] = 1.0
    optimiser = torch.optim.Adam(net.parameters(), 3e-3)
    totals = []
    for _ in range(25):
        losses = region_loss(net(rgb, depth, valid), target, torch.tensor([1.0, 2.0, 2.0]))
        optimiser.zero_grad()
        losses["total"].backward()
        assert all(p.grad is not None for p in net.parameters())
        optimiser.step()
        totals.append(losses["total"].item())
    assert totals[-1] < 0.5 * totals[0]


def test_class_boundary_by_hand():
    classes = torch.zeros(1, 5, 6, dtype=torch.int64)
    classes[:, :, 3:] = 1
    assert class_boundary(classes)[0].sum(0).tolist() == [0, 0, 5, 5, 0, 0]


def test_side_outputs_are_taught_where_the_outline_is():
    x = 2 * torch.arange(16) + 0.5  # columns of the full size that a coarse pixel lies at

    def cost(shift):
        total = 0
        for first in (14, 15):  # the column where glass begins, an even and an odd one
            target = (torch.arange(32) >= first).long().repeat(1, 8, 1)
            ramp = 3 * (x - (first - 0.5 + shift)).repeat(1, 1, 4, 1)
            logits = torch.cat([-ramp, ramp, -20 + 0 * ramp], dim=1)
            full = torch.zeros(1, 3, 8, 32)
            total += region_loss({"logits": full, "side": [logits], "boundary": full[:, :1]}, target)["side"]
        return float(total)

    before, right, after = (cost(shift) for shift in (-0.5, 0.0, 0.5))
    assert right < min(before, after) and abs(before - after) < 0.05 * after


@pytest.mark.parametrize("beside", [0, 1, 2])
def test_no_outline_runs_along_what_is_unknown(beside):
    classes = torch.full((1, 5, 6), beside)
    classes[:, :, 0] = IGNORE
    assert not class_boundary(classes).any()
    classes[0, 2, 4] = 2 - beside // 2
    assert class_boundary(classes)[0].sum() == 9 and not class_boundary(classes)[0, :, 0].any()


def test_targets_of_another_size_are_refused():
    with pytest.raises(ValueError, match="expected target_classes"):
        region_loss(perfect(torch.zeros(1, 4, 4, dtype=torch.int64)), torch.zeros(1, 4, 5, dtype=torch.int64))


# ---- the autoencoder


def test_depth_steps_by_hand():
    x = torch.tensor([[0.0, 0.0, 3.0], [0.0, 1.0, 3.0]]).view(1, 1, 2, 3)
    valid = torch.ones_like(x).bool()
    assert depth_steps(x, valid).view(2, 3).tolist() == [[0, 3, 3], [1, 2, 2]]
    valid[..., 0, 2] = False
    assert depth_steps(x, valid).view(2, 3).tolist() == [[0, 1, 0], [1, 2, 2]]


def loss_of(x, y, valid=None, **settings):
    out = {"reconstruction": y, "commitment": torch.zeros(())}
    return autoencoder_loss(x, out, torch.ones_like(x) if valid is None else valid, **settings)


def test_loss_of_a_constant_error_is_that_error():
    x = torch.rand(2, 1, 8, 8)
    half = torch.ones_like(x).bool()
    half[..., :4] = False
    for valid in (torch.ones_like(x), half):  # whatever the share of valid pixels
        losses = loss_of(x, x + 0.25, valid)
        assert losses["l1"] == pytest.approx(0.25) and losses["weighted_l1"] == pytest.approx(0.25)
        assert losses["gradient"] == pytest.approx(0, abs=1e-6)


def test_an_error_at_an_edge_costs_more_than_inside():
    x = torch.zeros(1, 1, 8, 8)
    x[..., 4:] = 1.0
    inside, edge = x.clone(), x.clone()
    inside[..., 4, 1] += 0.1
    edge[..., 4, 3] += 0.1
    ratio = loss_of(x, edge)["weighted_l1"] / loss_of(x, inside)["weighted_l1"]
    assert ratio == pytest.approx(5.0, rel=1e-5)  # 1 + edge_weight


def test_invalid_pixels_neither_cost_nor_get_a_gradient():
    x, y = torch.rand(1, 1, 6, 6), torch.rand(1, 1, 6, 6, requires_grad=True)
    valid = torch.ones_like(x).bool()
    valid[..., 2:4, 2:4] = False
    total = loss_of(x, y, valid)["total"]
    total.backward()
    assert (y.grad[~valid] == 0).all() and (y.grad[valid] != 0).any()
    changed = torch.where(valid, x, 99.0)
    assert loss_of(changed, y, valid)["total"].item() == pytest.approx(total.item())
    assert loss_of(x, y, torch.zeros_like(valid))["total"] == 0


def test_maps_of_different_size_are_refused():
    with pytest.raises(ValueError, match="expected one shape"):
        loss_of(torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 4, 8))


def test_training_reduces_the_loss_and_reaches_encoder_and_decoder():
    torch.manual_seed(0)
    model = VQAutoencoder(TINY.autoencoder)
    x = torch.zeros(4, 1, 32, 32)
    x[:, :, :, 13:] = 0.5
    optimiser = torch.optim.Adam(model.parameters(), 3e-3)
    totals = []
    for _ in range(60):
        losses = autoencoder_loss(x, model(x), torch.ones_like(x))
        optimiser.zero_grad()
        losses["total"].backward()
        optimiser.step()
        totals.append(losses["total"].item())
    assert totals[-1] < 0.3 * totals[0]
    assert all(p.grad is not None for p in model.parameters())
