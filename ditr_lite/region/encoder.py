"""The colour encoder: most of EfficientNet-Lite0 as ImageNet left it, with batch normalisation folded in.

Not in the paper, which trains TROSNet on each dataset; rendered scenes are too few to learn colour from.
Tan & Le 2019 (EfficientNet), the "Lite0" variant: no squeeze-and-excitation, ReLU6. Kept are the stages
up to stride 16, 0.7 million parameters, which stage two sees, too, and two of four blocks at stride 32, as many again.
The weights are Google's, under the Apache licence 2.0 (see ``weights/NOTICE``).
"""

import torch.nn.functional as F
from torch import Tensor, nn

# kernel, stride, expansion, channels, repeats of each stage
STAGES = ((3, 1, 1, 16, 1), (3, 2, 6, 24, 2), (5, 2, 6, 40, 2), (3, 2, 6, 80, 3), (5, 1, 6, 112, 3), (5, 2, 6, 192, 2))
STEM = 32
CHANNELS = (16, 24, 40, 112, 192)  # of the pyramid at strides 2, 4, 8, 16, 32
LAST_STAGE = (0, 1, 2, 4, 5)  # of each level


class SameConv(nn.Conv2d):
    """A convolution that pads as TensorFlow does: at stride 2 more to the right and below than to the left and above.

    The weights were trained so; symmetric padding would shift every feature by half a pixel.
    """

    def __init__(self, channels_in: int, channels_out: int, kernel: int, stride: int = 1, groups: int = 1):
        super().__init__(channels_in, channels_out, kernel, stride, groups=groups)
        total = kernel - stride
        self.margin = (total // 2, total - total // 2) * 2 if stride > 1 else (kernel // 2,) * 4

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, Cin, H, W) to (B, Cout, H / stride, W / stride)."""
        return super().forward(F.pad(x, self.margin) if self.margin[1] else x)


class InvertedResidual(nn.Module):
    """Widen (1x1), filter each channel (depthwise), narrow (1x1); added to the input where the shapes agree."""

    def __init__(self, channels_in: int, channels: int, kernel: int, stride: int, expansion: int):
        super().__init__()
        wide = channels_in * expansion
        self.expand = SameConv(channels_in, wide, 1) if expansion > 1 else None
        self.depthwise = SameConv(wide, wide, kernel, stride, groups=wide)
        self.project = SameConv(wide, channels, 1)
        self.residual = stride == 1 and channels_in == channels

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, Cin, H, W) to (B, C, H / stride, W / stride)."""
        h = x if self.expand is None else F.relu6(self.expand(x))
        h = self.project(F.relu6(self.depthwise(h)))
        return x + h if self.residual else h


class ColourEncoder(nn.Module):
    """Turn a picture into a pyramid of features at up to five strides, 2, 4, 8, ..., with :data:`CHANNELS` channels."""

    def __init__(self, levels: int = len(CHANNELS)):
        super().__init__()
        self.stem = SameConv(3, STEM, 3, 2)
        self.stages = nn.ModuleList()
        width = STEM
        for kernel, stride, expansion, channels, repeats in STAGES[: LAST_STAGE[levels - 1] + 1]:
            blocks = []
            for i in range(repeats):
                blocks.append(InvertedResidual(width, channels, kernel, 1 if i else stride, expansion))
                width = channels
            self.stages.append(nn.Sequential(*blocks))

    def forward(self, rgb: Tensor, levels: int = len(CHANNELS)) -> list[Tensor]:
        """Map (B, 3, H, W) in [-1, 1], H and W multiples of 2^levels, to (B, CHANNELS[k], H / 2^(k+1), W / 2^(k+1)).

        ``levels`` says how many of them are wanted; what is behind is not computed.
        """
        x = F.relu6(self.stem(rgb))
        pyramid = []
        for k, stage in enumerate(self.stages[: LAST_STAGE[levels - 1] + 1]):
            x = stage(x)
            if k in LAST_STAGE:
                pyramid.append(x)
        return pyramid
