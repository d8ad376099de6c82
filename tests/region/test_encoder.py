"""The pretrained half of EfficientNet-Lite0: padding and shapes."""

import pytest
import torch
import torch.nn.functional as F

from ditr_lite.region.encoder import CHANNELS, ColourEncoder, InvertedResidual, SameConv


def same_pad(x, kernel, stride):
    """TensorFlow's SAME: the total is what the last window lacks, its odd pixel goes to the right and below."""
    height, width = x.shape[2:]
    pads = [max((-(-n // stride) - 1) * stride + kernel - n, 0) for n in (width, height)]
    return F.pad(x, (pads[0] // 2, pads[0] - pads[0] // 2, pads[1] // 2, pads[1] - pads[1] // 2))


@pytest.mark.parametrize(("kernel", "stride"), [(1, 1), (3, 1), (5, 1), (3, 2), (5, 2)])
def test_padding_is_tensorflows(kernel, stride):
    torch.manual_seed(0)
    conv = SameConv(2, 3, kernel, stride)
    x = torch.randn(1, 2, 16, 32)
    wanted = F.conv2d(same_pad(x, kernel, stride), conv.weight, conv.bias, stride)
    out = conv(x)
    assert out.shape == (1, 3, 16 // stride, 32 // stride) and torch.allclose(out, wanted, atol=1e-5)


def test_at_stride_two_the_odd_pixel_lies_to_the_right_and_below():
    conv = SameConv(1, 1, 3, 2)
    torch.nn.init.ones_(conv.weight)
    torch.nn.init.zeros_(conv.bias)
    out = conv(torch.ones(1, 1, 8, 8))[0, 0]
    assert out[0, 0] == 9 and out[-1, -1] == 4 and out[-1, 0] == 6  # only the last windows look beyond the picture


def test_the_pyramid_has_the_promised_sizes_and_blocks_add_their_input_where_they_can():
    shapes = [tuple(f.shape) for f in ColourEncoder()(torch.zeros(1, 3, 32, 64))]
    assert shapes == [(1, c, 16 // 2**k, 32 // 2**k) for k, c in enumerate(CHANNELS)]
    few = ColourEncoder(3)
    assert len(few.stages) == 3 and [f.shape[1] for f in few(torch.zeros(1, 3, 32, 64))] == [16, 24, 40]
    assert len(ColourEncoder()(torch.zeros(1, 3, 32, 64), levels=4)) == 4
    block = InvertedResidual(4, 4, 3, 1, 6)
    torch.nn.init.zeros_(block.project.weight)
    torch.nn.init.zeros_(block.project.bias)
    x = torch.randn(1, 4, 8, 8)
    assert torch.equal(block(x), x) and not InvertedResidual(4, 8, 3, 1, 6).residual
    assert not InvertedResidual(4, 4, 3, 2, 6).residual


def test_a_block_narrows_without_a_bend():
    torch.manual_seed(0)
    block, x = InvertedResidual(4, 6, 3, 1, 6), torch.randn(1, 4, 8, 8)
    wide = F.relu6(block.depthwise(F.relu6(block.expand(x))))
    assert torch.equal(block(x), block.project(wide)) and (block(x) < 0).any()
