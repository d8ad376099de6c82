"""The paper's training statements, the rates read into them, and one step of each part at the paper's widths."""

import math
import resource
import sys

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from ditr_lite import diffusion
from ditr_lite import paper_recipes as recipes
from ditr_lite.autoencoder import VQAutoencoder, autoencoder_loss
from ditr_lite.conditioning import CHANNELS
from ditr_lite.config import preset
from ditr_lite.region import RegionNet, region_loss
from ditr_lite.schedule import make_schedule
from ditr_lite.unet import DenoisingUNet

PAPER = preset("paper")
SIZE = (64, 96)  # the widths are the paper's, the image is small


def test_what_the_paper_states():
    region, tuning, denoiser = recipes.REGION, recipes.FINE_TUNING, recipes.DENOISER
    assert (region.batch, region.momentum, region.weight_decay, region.epochs) == (16, 0.9, 1e-4, 200)
    assert (tuning.batch, tuning.momentum, tuning.weight_decay) == (16, 0.9, 1e-4)  # "all settings are kept" ...
    assert (tuning.lr, tuning.epochs) == (1e-3, 50) and region.lr is None  # ... "except for"
    assert (denoiser.batch, denoiser.lr) == (64, 1e-6)


def test_optimisers_are_the_stated_ones():
    model = torch.nn.Linear(2, 2)
    model.bias.requires_grad_(False)
    sgd = recipes.make_optimiser(model, recipes.REGION, recipes.region_rate(0))
    (group,) = sgd.param_groups
    assert isinstance(sgd, torch.optim.SGD) and group["lr"] == recipes.region_rate(0)
    assert (group["momentum"], group["weight_decay"], len(group["params"])) == (0.9, 1e-4, 1)
    assert recipes.make_optimiser(model, recipes.FINE_TUNING).param_groups[0]["lr"] == 1e-3
    adam = recipes.make_optimiser(model, recipes.DENOISER)
    assert isinstance(adam, torch.optim.Adam) and adam.param_groups[0]["lr"] == 1e-6
    assert recipes.make_optimiser(model, recipes.DENOISER, 2e-4).param_groups[0]["lr"] == 2e-4


def test_what_cannot_be_optimised_is_refused():
    with pytest.raises(ValueError, match="states no learning rate"):
        recipes.make_optimiser(torch.nn.Linear(2, 2), recipes.REGION)
    with pytest.raises(ValueError, match="all of them are frozen"):
        recipes.make_optimiser(torch.nn.Linear(2, 2).requires_grad_(False), recipes.DENOISER)


@given(st.floats(0, 200))
def test_region_rate_is_cosine_times_exponential(epoch):
    rate = recipes.region_rate(epoch, lr=1.0, decay=0.97)
    assert math.isclose(rate, math.cos(math.pi * epoch / 400) ** 2 * math.exp(epoch * math.log(0.97)), abs_tol=1e-12)
    assert rate <= recipes.region_rate(max(0, epoch - 1), lr=1.0, decay=0.97)


def test_rates_by_hand():
    assert recipes.region_rate(0, lr=0.3) == 0.3 and recipes.region_rate(200) == pytest.approx(0, abs=1e-15)
    assert recipes.region_rate(100, lr=1.0, decay=1.0) == pytest.approx(0.5)
    assert recipes.trosnet_rate(0, 0) == 1e-3 and recipes.trosnet_rate(0, 57) == pytest.approx(1.5e-3)
    assert recipes.trosnet_rate(150, 171) == pytest.approx(0.6e-3 - 0.3e-3)
    assert recipes.scaled_rate() == pytest.approx(6.4e-5) and recipes.scaled_rate(gpus=2) == pytest.approx(1.28e-4)
    for bad in (-1, 201):
        with pytest.raises(ValueError, match="expected 0 to 200"):
            recipes.region_rate(bad)


def region_case():
    model, (height, width) = RegionNet(PAPER.region), SIZE
    rgb, depth, valid = torch.randn(2, 3, height, width), torch.randn(2, 1, height, width), torch.ones(2, 1, *SIZE)
    target = (depth[:, 0] > 0).long()
    return model, lambda: region_loss(model(rgb, depth, valid), target)["total"]


def autoencoder_case():
    model, depth = VQAutoencoder(PAPER.autoencoder), F.avg_pool2d(torch.randn(2, 1, *SIZE), 9, 1, 4)
    return model, lambda: autoencoder_loss(depth, model(depth), torch.ones_like(depth))["total"]


def denoiser_case():
    """Eq. 8 by way of Eq. 9: the network gives x0, what is scored is the noise that follows from it."""
    c = PAPER.autoencoder.latent_channels
    model, schedule = DenoisingUNet(PAPER.unet, c, len(CHANNELS)), make_schedule(PAPER.schedule)
    torch.nn.init.normal_(model.out.weight, std=0.05)  # zero at first, which would hide every other gradient
    cond, x0, eps = torch.randn(2, len(CHANNELS), *SIZE), *torch.randn(2, 2, c, SIZE[0] // 4, SIZE[1] // 4)
    t = torch.tensor([100, 900])
    x_t = diffusion.q_sample(x0, t, eps, schedule)

    def loss():
        pred_x0 = model(x_t, t, model.features(cond), x0, torch.ones_like(x0[:, :1]))
        return diffusion.loss(diffusion.eps_from_x0(x_t, t, pred_x0, schedule), x0, eps, t, schedule)

    return model, loss


@pytest.mark.parametrize(
    ("case", "stated", "lr"),
    [
        (region_case, recipes.REGION, recipes.region_rate(0)),
        (autoencoder_case, recipes.DENOISER, 1e-5),
        (denoiser_case, recipes.DENOISER, recipes.scaled_rate()),
    ],
    ids=["region", "autoencoder", "denoiser"],
)
def test_a_step_of_training_runs_at_the_papers_widths(case, stated, lr):
    torch.manual_seed(0)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    model, loss = case()
    optimiser = recipes.make_optimiser(model.train(), stated, lr)
    before = loss()
    before.backward()
    without = [name for name, p in model.named_parameters() if p.grad is None]
    optimiser.step()
    assert not without and torch.isfinite(before) and loss() < before
    more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak
    assert more < 2e6 * (1024 if sys.platform == "darwin" else 1)  # under 2 GB; kilobytes, on macOS bytes
