"""The published EfficientNet-Lite0 and what is made of it, on random numbers."""

import pytest
import torch
import torch.nn.functional as F

from ditr_lite.region.encoder import STAGES, ColourEncoder, SameConv
from ditr_lite.training.pretrained import fold


def published(seed=0):
    """Return random tensors under the names of the published network, batch norms and all, for our stages."""
    generator = torch.Generator().manual_seed(seed)
    state = {}

    def conv(name, shape):
        state[f"{name}.weight"] = torch.randn(shape, generator=generator) / (shape[1] * shape[2] * shape[3]) ** 0.5

    def norm(name, width):
        state[f"{name}.weight"] = 0.5 + torch.rand(width, generator=generator)
        state[f"{name}.bias"] = torch.randn(width, generator=generator)
        state[f"{name}.running_mean"] = torch.randn(width, generator=generator)
        state[f"{name}.running_var"] = 0.5 + torch.rand(width, generator=generator)

    conv("_conv_stem", (32, 3, 3, 3))
    norm("_bn0", 32)
    width, index = 32, 0
    for kernel, _, expansion, channels, repeats in STAGES:
        for _ in range(repeats):
            here, wide = f"_blocks.{index}", width * expansion
            if expansion > 1:
                conv(f"{here}._expand_conv", (wide, width, 1, 1))
                norm(f"{here}._bn0", wide)
            conv(f"{here}._depthwise_conv", (wide, 1, kernel, kernel))
            norm(f"{here}._bn1", wide)
            conv(f"{here}._project_conv", (channels, wide, 1, 1))
            norm(f"{here}._bn2", channels)
            width, index = channels, index + 1
    return state


def padded(x, kernel, stride):
    """Pad as our convolutions do; that this is TensorFlow's way is tested where they are."""
    return F.pad(x, SameConv(1, 1, kernel, stride).margin)


def unfolded(state, x, eps=1e-3):
    """Run the published network layer by layer, each convolution followed by its batch norm."""

    def norm(name, x):
        keys = ("running_mean", "running_var", "weight", "bias")
        return F.batch_norm(x, *(state[f"{name}.{k}"] for k in keys), eps=eps)

    def block(name, x, kernel, stride, expansion):
        h = x
        if expansion > 1:
            h = F.relu6(norm(f"{name}._bn0", F.conv2d(h, state[f"{name}._expand_conv.weight"])))
        depthwise = state[f"{name}._depthwise_conv.weight"]
        h = F.conv2d(padded(h, kernel, stride), depthwise, stride=stride, groups=len(depthwise))
        h = norm(f"{name}._bn2", F.conv2d(F.relu6(norm(f"{name}._bn1", h)), state[f"{name}._project_conv.weight"]))
        return x + h if h.shape == x.shape else h

    x = F.conv2d(padded(x, 3, 2), state["_conv_stem.weight"], stride=2)
    x, outputs, index = F.relu6(norm("_bn0", x)), [], 0
    for kernel, stride, expansion, _, repeats in STAGES:
        for i in range(repeats):
            x = block(f"_blocks.{index}", x, kernel, 1 if i else stride, expansion)
            index += 1
        outputs.append(x)
    return [outputs[0], outputs[1], outputs[2], outputs[4], outputs[5]]


def test_folded_weights_compute_what_convolutions_and_batch_norms_did():
    state = published()
    net = ColourEncoder()
    net.load_state_dict(fold(state))
    x = 2 * torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(1)) - 1
    with torch.no_grad():
        for ours, theirs in zip(net(x), unfolded(state, x), strict=True):
            assert (ours - theirs).abs().max() < 1e-3 * theirs.abs().max()


def test_a_missing_tensor_is_named():
    state = published()
    del state["_blocks.3._bn1.running_var"]
    with pytest.raises(ValueError, match="_blocks.3._bn1.running_var.*EfficientNet-Lite0"):
        fold(state)
