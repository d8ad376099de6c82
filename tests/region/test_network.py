from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite.config import RegionConfig, preset
from ditr_lite.region import CrossModalFusion, RegionNet, level_widths, refine_region, region_probability
from ditr_lite.region.network import COLOUR_ENCODERS, BoundaryRefinement, LookAround, Residual

TINY = preset("tiny").region


def frame(batch=2, height=32, width=48, seed=0):
    g = torch.Generator().manual_seed(seed)
    rgb = torch.rand(batch, 3, height, width, generator=g) * 2 - 1
    depth = torch.rand(batch, 1, height, width, generator=g)
    return rgb, depth, (depth > 0.3).float()


# ---- the network


@pytest.mark.parametrize("size", [(32, 48), (33, 47)])
def test_outputs_have_the_promised_shapes(size):
    torch.manual_seed(0)
    out = RegionNet(TINY)(*frame(height=size[0], width=size[1]))
    assert out["logits"].shape == (2, 3, *size) and out["boundary"].shape == (2, 1, *size)
    assert len(out["side"]) == TINY.levels - 1
    assert [s.shape[1] for s in out["side"]] == [3, 3]
    assert out["side"][0].shape[2] < out["side"][1].shape[2] < size[0]


def test_fusion_by_hand():
    fusion = CrossModalFusion(1)
    with torch.no_grad():
        for conv in (fusion.gate_rgb, fusion.gate_depth):
            conv.weight.fill_(1.0)
            conv.bias.zero_()
    rgb, depth = torch.full((1, 1, 1, 1), 2.0), torch.full((1, 1, 1, 1), -3.0)
    sigmoid = lambda v: 1 / (1 + np.exp(-v))  # noqa: E731
    assert fusion(rgb, depth).item() == pytest.approx(2 * sigmoid(-3) - 3 * sigmoid(2))  # each gated by the other


def test_boundary_refinement_leaves_features_alone_off_the_boundary():
    torch.manual_seed(0)
    block = BoundaryRefinement(8)
    with torch.no_grad():
        block.predict.weight.zero_()
        block.predict.bias.fill_(-50.0)  # "no boundary anywhere"
    decoded, fine = torch.randn(1, 8, 6, 6), torch.randn(1, 8, 6, 6)
    assert torch.allclose(block(decoded, fine)[0], decoded)
    with torch.no_grad():
        block.predict.bias.fill_(50.0)
    assert not torch.allclose(block(decoded, fine)[0], decoded, atol=1e-2)


@pytest.mark.parametrize("block", [LookAround, Residual])
def test_added_blocks_change_nothing_at_first_and_can_learn(block):
    torch.manual_seed(0)
    block, x = block(64), torch.randn(2, 64, 5, 7)
    assert torch.equal(block(x), x)
    block(x).sum().backward()
    assert any(p.grad.abs().sum() > 0 for p in block.parameters())


def test_every_cell_is_looked_at_from_everywhere():
    torch.manual_seed(0)
    block = LookAround(32)
    torch.nn.init.normal_(block.out.weight)
    x = torch.randn(1, 32, 6, 9, requires_grad=True)
    block(x)[0, 0, 0, 0].backward()
    assert (x.grad[0].abs().sum(dim=0) > 0).all()  # a convolution of 3 x 3 would reach four of them


def test_more_blocks_begin_as_the_network_without():
    torch.manual_seed(0)
    small, large = RegionNet(TINY), RegionNet(replace(TINY, attention=1, blocks=2))
    missing, unexpected = large.load_state_dict(small.state_dict(), strict=False)
    assert missing and not unexpected
    assert torch.equal(small(*frame())["logits"], large(*frame())["logits"])


def test_depth_under_an_invalid_pixel_is_ignored_and_validity_is_not():
    torch.manual_seed(0)
    net = RegionNet(TINY).eval()
    rgb, depth, valid = frame()
    logits = net(rgb, depth, valid)["logits"]
    assert torch.equal(net(rgb, torch.where(valid > 0, depth, 123.0), valid)["logits"], logits)
    assert torch.equal(net(rgb, depth, valid.bool())["logits"], logits)
    assert not torch.allclose(net(rgb, depth * valid, torch.ones_like(valid))["logits"], logits)


def test_images_of_a_batch_do_not_influence_each_other():
    torch.manual_seed(0)
    net = RegionNet(TINY).train()  # also in training mode: no batch statistics
    rgb, depth, valid = frame()
    both, one = net(rgb, depth, valid)["logits"], net(rgb[:1], depth[:1], valid[:1])["logits"]
    assert torch.allclose(both[:1], one, atol=1e-5)


def test_probability_merges_the_two_classes():
    logits = torch.log(torch.tensor([0.5, 0.2, 0.3])).view(1, 3, 1, 1)
    assert region_probability({"logits": logits}).item() == pytest.approx(0.5)


def test_the_lite_preset_keeps_its_budget():
    from torch.nn.attention import SDPBackend, sdpa_kernel
    from torch.utils.flop_counter import FlopCounterMode

    net = RegionNet(preset("lite").region).eval()
    with FlopCounterMode(display=False) as counter, torch.no_grad(), sdpa_kernel(SDPBackend.MATH):
        net(*frame(1, 192, 256))
    assert counter.get_total_flops() <= 2e9
    assert sum(p.numel() for p in net.parameters()) <= 3_200_000  # 1.4 million of them pretrained


def test_levels_below_stride_16_are_no_wider():
    assert level_widths(16, 5) == [16, 32, 64, 128, 128] and level_widths(8, 2) == [8, 16]


def test_a_pretrained_encoder_has_the_widths_of_the_other_one():
    torch.manual_seed(0)
    rgb = torch.randn(1, 3, 32, 64)
    pretrained, scratch = (COLOUR_ENCODERS[kind](3, [8, 16, 32])(rgb) for kind in ("pretrained", "scratch"))
    assert [f.shape for f in pretrained] == [f.shape for f in scratch]
    with pytest.raises(ValueError, match="at up to 5 levels, got 6"):
        COLOUR_ENCODERS["pretrained"](3, 6 * [8])


# ---- refinement (S2)


def naive_median(mask, size):
    half = size // 2
    padded = np.pad(mask, half, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size))
    return windows.sum(axis=(2, 3)) * 2 > size * size


def naive_dilate(mask, size):
    padded = np.pad(mask, size // 2)
    return np.lib.stride_tricks.sliding_window_view(padded, (size, size)).any(axis=(2, 3))


@settings(max_examples=60, deadline=None)
@given(arrays(bool, st.tuples(st.just(9), st.just(9))), st.sampled_from([0, 3, 7]), st.sampled_from([0, 3, 5]))
def test_refinement_agrees_with_the_naive_one(mask, median, dilate):
    expected = naive_median(mask, median) if median else mask
    for _ in range(3 if dilate else 0):
        expected = naive_dilate(expected, dilate)
    assert (refine_region(mask, median, dilate, 3) == expected).all()


def test_a_speck_goes_and_a_hole_closes():
    mask = np.zeros((40, 40), bool)
    mask[2, 2] = True
    mask[15:30, 15:30] = True
    mask[22, 22] = False
    out = refine_region(mask)
    assert not out[:8, :8].any() and out[22, 22]


def test_dilation_grows_six_pixels_a_side():
    mask = np.zeros((60, 60), bool)
    mask[20:40, 20:40] = True
    out = refine_region(mask, median=0)
    rows = np.flatnonzero(out.any(1))
    assert (rows[0], rows[-1]) == (14, 45) and out.sum() == 32 * 32


@settings(max_examples=30, deadline=None)
@given(arrays(bool, (12, 15)))
def test_dilation_never_misses_and_steps_switch_off(mask):
    assert (refine_region(mask, median=0) | ~mask).all()
    for off in ({"median": 0, "iterations": 0}, {"median": 1, "dilate": 1}, {"median": 0, "dilate": 0}):
        assert (refine_region(mask, **off) == mask).all()


@pytest.mark.parametrize("bad", [{"median": 6}, {"dilate": 4}, {"median": -1}, {"iterations": -1}])
def test_bad_kernels_are_refused(bad):
    with pytest.raises(ValueError, match="expected"):
        refine_region(np.zeros((9, 9), bool), **bad)


@pytest.mark.parametrize(
    "call",
    [
        lambda: refine_region(np.zeros((9, 9), np.uint8)),
        lambda: refine_region(np.zeros((3, 9, 9), bool)),
        lambda: RegionNet(RegionConfig(levels=1)),
        lambda: RegionNet(RegionConfig(attention=-1)),
        lambda: RegionNet(TINY)(torch.zeros(1, 3, 8, 8), torch.zeros(1, 1, 8, 9), torch.zeros(1, 1, 8, 8)),
        lambda: RegionNet(TINY)(torch.zeros(3, 8, 8), torch.zeros(1, 8, 8), torch.zeros(1, 8, 8)),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(ValueError, match="expected"):
        call()
