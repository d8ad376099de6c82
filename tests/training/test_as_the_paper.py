"""The paper's rate for its denoiser, and one step of training of every part at the paper's widths."""

import sys

import pytest
import torch
import torch.nn.functional as F

from ditr_lite import diffusion
from ditr_lite.autoencoder import VQAutoencoder, autoencoder_loss
from ditr_lite.conditioning import CHANNELS
from ditr_lite.config import preset
from ditr_lite.region import RegionNet, region_loss
from ditr_lite.schedule import make_schedule
from ditr_lite.training import as_the_paper as recipes
from ditr_lite.unet import DenoisingUNet

PAPER = preset("paper")
SIZE = (64, 96)  # the widths are the paper's, the image is small


def test_the_stated_rate_and_the_scaled_one():
    assert (recipes.BATCH, recipes.BASE_RATE) == (64, 1e-6)
    assert recipes.scaled_rate() == pytest.approx(6.4e-5) and recipes.scaled_rate(gpus=2) == pytest.approx(1.28e-4)
    for bad in ({"base": 0.0}, {"batch": 0}, {"gpus": 0}):
        with pytest.raises(ValueError, match="expected a positive base"):
            recipes.scaled_rate(**bad)


def test_only_what_is_not_frozen_is_optimised():
    model = torch.nn.Linear(2, 2)
    model.bias.requires_grad_(False)
    (group,) = recipes.make_optimiser(model).param_groups
    assert group["lr"] == 1e-6 and [p.shape for p in group["params"]] == [(2, 2)]
    assert recipes.make_optimiser(model, 2e-4).param_groups[0]["lr"] == 2e-4
    with pytest.raises(ValueError, match="all of them are frozen"):
        recipes.make_optimiser(model.requires_grad_(False))


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


@pytest.mark.parametrize(("case", "lr"), [(region_case, 1e-3), (autoencoder_case, 1e-5), (denoiser_case, 6.4e-5)])
def test_a_step_of_training_runs_at_the_papers_widths(case, lr):
    torch.manual_seed(0)
    resource = pytest.importorskip("resource", reason="Windows does not tell the peak of a process's memory")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    model, loss = case()
    optimiser = recipes.make_optimiser(model.train(), lr)
    before = loss()
    before.backward()
    without = [name for name, p in model.named_parameters() if p.grad is None]
    optimiser.step()
    assert not without and torch.isfinite(before) and loss() < before
    more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak
    assert more < 2e6 * (1024 if sys.platform == "darwin" else 1)  # under 2 GB; kilobytes, on macOS bytes
