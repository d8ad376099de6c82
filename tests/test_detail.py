import numpy as np
import pytest
import torch

from ditr_lite.conditioning import fill
from ditr_lite.config import DetailConfig, preset
from ditr_lite.detail import CHANNELS, DILATIONS, ROUNDS, DetailNet, detail_input, neighbours, propagate
from ditr_lite.evaluation.costs import count_flops


def build():
    torch.manual_seed(0)
    net = DetailNet(preset("tiny").detail)
    torch.nn.init.normal_(net.out.weight, std=0.1)
    return net, torch.randn(2, len(CHANNELS), 64, 96)


def test_untrained_network_smooths_and_holds_readings():
    net, x = DetailNet(DetailConfig(8)), torch.randn(1, len(CHANNELS), 32, 40)
    x[:, 2:4] = 0
    out, smooth = net(x), torch.lerp(x[:, :1], x[:, -1:], torch.sigmoid(torch.tensor(-2.0)))
    for dilation in DILATIONS:
        for _ in range(ROUNDS):
            smooth = sum(neighbours(smooth, dilation))[:, None] / 9
    assert torch.allclose(out, smooth, atol=1e-5)
    x[:, 1], x[:, 2] = 5.0, 1.0
    outside = net(x)
    assert bool((outside > 4.5).all())  # at first a reading outweighs what flows in by twenty to one
    x[:, 2], x[:, 3] = 0.0, 1.0
    inside = net(x)  # and one inside the region is trusted less, but not thrown away
    assert bool((inside < outside).all()) and bool((inside > smooth).all())


def test_where_the_network_says_so_the_smooth_fill_takes_the_place_of_the_decoded_depth():
    net, x = DetailNet(DetailConfig(8)), torch.randn(1, len(CHANNELS), 32, 40)
    x[:, 2:4] = 0
    outputs = net.out.bias.view(-1, 4)  # (outputs, pixels of a 2x2 block)
    for bias, taken in ((30.0, x[:, -1:]), (-30.0, x[:, :1])):
        with torch.no_grad():
            outputs[1] = bias
        net.eval()
        equal = [torch.full((1, 9, 32, 40), 1 / 9)] * len(DILATIONS)
        assert torch.allclose(net(x), propagate(taken, taken, torch.zeros_like(taken), equal), atol=1e-5)


def test_the_fill_shown_is_that_of_readings_outside_the_region():
    torch.manual_seed(0)
    depth, valid, region = torch.randn(1, 1, 16, 24), torch.ones(1, 1, 16, 24), torch.zeros(1, 1, 16, 24)
    region[..., 4:9, 5:15] = 1
    given = detail_input(torch.randn(3, 1, 16, 24), depth, valid, region, torch.randn(1, 3, 16, 24), region)
    assert given.shape == (3, len(CHANNELS), 16, 24)
    assert torch.equal(given[:, -1:], fill(depth, 1 - region).expand(3, -1, -1, -1))


def test_trust_inside_the_region_is_learnt_apart_from_that_outside():
    net, x = build()
    trust = net.predict(x)[2]
    assert trust.shape == (2, 2, 64, 96) and bool((trust > 0).all()) and bool((trust < 1).all())
    x[:, 1], x[:, 2:4] = 5.0, 0.0
    none = net(x)
    for channel in (2, 3):
        held = x.clone()
        held[:, channel] = 1
        residual, blend, trusts, affinities = net.predict(held)
        start = torch.lerp(held[:, :1], held[:, -1:], blend) + residual
        wanted = propagate(start, held[:, 1:2], trusts[:, channel - 2 : channel - 1], affinities)
        assert torch.allclose(net(held), wanted) and not torch.allclose(wanted, none)


def test_shape_and_gradient_to_every_parameter():
    net, x = build()
    out = net(x)
    assert out.shape == (2, 1, 64, 96)
    (out**2).sum().backward()
    assert not [n for n, p in net.named_parameters() if p.grad is None or not bool(p.grad.abs().max() > 0)]


def test_equal_affinities_relax_towards_the_membrane():
    # a plane is harmonic: with its border held it must come back from any start, given time
    plane = (torch.arange(24.0)[:, None] + 2 * torch.arange(32.0))[None, None] / 30
    trust = torch.ones_like(plane)
    trust[..., 4:-4, 4:-4] = 0
    equal = [torch.full((1, 9, 24, 32), 1 / 9)] * len(DILATIONS)
    depth = torch.where(trust > 0, plane, 0.0)
    errors = []
    for _ in range(60):
        depth = propagate(depth, plane, trust, equal)
        errors.append(float((depth - plane).abs().max()))
    assert errors[-1] < 0.02 < errors[0] and errors == sorted(errors, reverse=True)


def test_propagation_agrees_with_a_loop_over_pixels():
    torch.manual_seed(0)
    height, width = 6, 7
    start, readings, trust = (torch.rand(1, 1, height, width) for _ in range(3))
    affinities = [torch.randn(1, 9, height, width).softmax(1) for _ in DILATIONS]
    want = start[0, 0].clone()
    for dilation, a in zip(DILATIONS, affinities, strict=True):
        for _ in range(ROUNDS):
            old, want = want, torch.empty_like(want)
            for v, u in np.ndindex(height, width):
                total = 0.0
                for k, (dv, du) in enumerate((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)):
                    y, x = min(max(v + dv * dilation, 0), height - 1), min(max(u + du * dilation, 0), width - 1)
                    total += a[0, k, v, u] * old[y, x]
                t = trust[0, 0, v, u]
                want[v, u] = t * readings[0, 0, v, u] + (1 - t) * total
    assert torch.allclose(propagate(start, readings, trust, affinities)[0, 0], want, atol=1e-5)


def test_an_affinity_of_one_for_itself_stops_the_flow():
    torch.manual_seed(0)
    start = torch.rand(1, 1, 8, 8)
    itself = torch.zeros(1, 9, 8, 8)
    itself[:, 4] = 1
    out = propagate(start, start.flip(2), torch.zeros_like(start), [itself] * len(DILATIONS))
    assert torch.allclose(out, start)


@pytest.mark.parametrize("channel", range(len(CHANNELS)), ids=CHANNELS)
def test_every_channel_matters(channel):
    net, x = build()
    changed = x.clone()
    changed[:, channel] = changed[:, channel].flip(1)
    assert (net(x) - net(changed)).abs().max() > 1e-4


def test_every_pixel_has_its_own_value():
    # gradient descent on the output convolution alone can write any 2x2 pattern: pixels of a block are not tied
    net, x = build()
    residual, blend, trust, affinities = net.predict(x)
    for out in (residual, blend, trust, affinities[0][:, :1]):
        block = out[0, 0, :2, :2].flatten()
        rows = [torch.autograd.grad(v, net.out.weight, retain_graph=True)[0].flatten() for v in block]
        assert torch.linalg.matrix_rank(torch.stack(rows)) == 4
    assert all(torch.allclose(a.sum(1), torch.ones(2, 64, 96)) and bool((a > 0).all()) for a in affinities)


def test_fine_detail_passes_by_the_skips():
    net, x = build()
    for upsample in net.upsample:  # nothing comes up from the coarser levels
        torch.nn.init.zeros_(upsample.weight)
        torch.nn.init.zeros_(upsample.bias)
    assert (net(x) - net(x.flip(0))).abs().max() > 1e-2


def test_lite_meets_its_budget():
    with torch.device("meta"):
        net = DetailNet(preset("lite").detail)
        assert count_flops(net, torch.zeros(1, len(CHANNELS), 192, 256)) <= 1.4e9
    assert sum(p.numel() for p in net.parameters()) < 0.3e6


def test_bad_inputs_are_refused():
    net, x = build()
    for bad in (x[:, :7], x[..., :-1], x[0]):
        with pytest.raises(ValueError, match="x: expected"):
            net(bad)
    with pytest.raises(ValueError, match="leave it out"):
        DetailNet(DetailConfig(0))


def test_samples_of_one_image_share_what_the_network_says_of_it():
    net = DetailNet(DetailConfig(width=8)).eval()
    torch.nn.init.normal_(net.out.weight, std=0.1)
    x, decoded = torch.rand(1, len(CHANNELS), 16, 24), torch.rand(3, 1, 16, 24)
    together = net.spread(x, decoded)
    each = torch.cat([net.spread(x, d[None]) for d in decoded])
    assert together.shape == decoded.shape and torch.allclose(together, each, atol=1e-6)
    assert torch.allclose(net.spread(x, x[:, :1]), net(x))
