import pytest
import torch

from ditr_lite import autoencoder
from ditr_lite.autoencoder import autoencoder_loss, depth_steps


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


def test_the_autoencoder_offers_it_too():
    assert autoencoder.autoencoder_loss is autoencoder_loss and autoencoder.depth_steps is depth_steps
