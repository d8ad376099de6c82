import pytest
import torch

from ditr_lite.config import DetailConfig, preset
from ditr_lite.detail import CHANNELS, DetailNet
from ditr_lite.unet import count_flops


def build():
    torch.manual_seed(0)
    net = DetailNet(preset("tiny").detail)
    torch.nn.init.normal_(net.out.weight, std=0.1)
    return net, torch.randn(2, 8, 64, 96)


def test_untrained_network_changes_nothing():
    assert bool((DetailNet(DetailConfig(8))(torch.randn(1, 8, 32, 40)) == 0).all())


def test_shape_and_gradient_to_every_parameter():
    net, x = build()
    out = net(x)
    assert out.shape == (2, 1, 64, 96)
    (out**2).sum().backward()
    assert not [n for n, p in net.named_parameters() if p.grad is None or not bool(p.grad.abs().max() > 0)]


@pytest.mark.parametrize("channel", range(len(CHANNELS)), ids=CHANNELS)
def test_every_channel_matters(channel):
    net, x = build()
    changed = x.clone()
    changed[:, channel] = changed[:, channel].flip(1)
    assert (net(x) - net(changed)).abs().max() > 1e-3


def test_every_pixel_has_its_own_value():
    # gradient descent on the output convolution alone can write any 2x2 pattern: pixels of a block are not tied
    net, x = build()
    out = net(x)[0, 0, :2, :2].flatten()
    rows = [torch.autograd.grad(v, net.out.weight, retain_graph=True)[0].flatten() for v in out]
    assert torch.linalg.matrix_rank(torch.stack(rows)) == 4


def test_fine_detail_passes_by_the_skips():
    net, x = build()
    for upsample in net.upsample:  # nothing comes up from the coarser levels
        torch.nn.init.zeros_(upsample.weight)
        torch.nn.init.zeros_(upsample.bias)
    assert (net(x) - net(x.flip(0))).abs().max() > 1e-2


def test_lite_meets_its_budget():
    with torch.device("meta"):
        net = DetailNet(preset("lite").detail)
        assert count_flops(net, torch.zeros(1, 8, 192, 256)) <= 1.0e9
    assert sum(p.numel() for p in net.parameters()) < 0.3e6


def test_bad_inputs_are_refused():
    net, x = build()
    for bad in (x[:, :7], x[..., :-1], x[0]):
        with pytest.raises(ValueError, match="x: expected"):
            net(bad)
    with pytest.raises(ValueError, match="leave it out"):
        DetailNet(DetailConfig(0))
