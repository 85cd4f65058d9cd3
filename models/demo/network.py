"""The image side: plain convolutions down to stride 32 and back up to stride 4; and the linear head of the text side.

Plain convolutions train and run faster on processors than depthwise ones of fewer weights.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

DIM = 64
_WIDTHS = (24, 48, 80, 112)  # at strides 4, 8, 16, 32
_NECK = 48


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class Residual(nn.Module):
    """Two convolutions beside the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _conv(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Add what the convolutions find."""
        return functional.relu(x + self.second(self.first(x)))


class Segmenter(nn.Module):
    """RGB in 0..1, sides multiples of 32, to unit features every 4 pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _conv(3, 16, stride=2)
        stages = [nn.Sequential(_conv(16, _WIDTHS[0], stride=2))]
        stages += [nn.Sequential(_conv(a, b, stride=2), Residual(b)) for a, b in pairwise(_WIDTHS)]
        self.stages = nn.ModuleList(stages)
        self.laterals = nn.ModuleList(nn.Conv2d(width, _NECK, 1) for width in _WIDTHS)
        self.merges = nn.ModuleList(_conv(_NECK, _NECK) for _ in _WIDTHS[1:])
        self.head = nn.Conv2d(_NECK, DIM, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Return [n, 64, h / 4, w / 4]."""
        x = self.stem((image - 0.45) / 0.25)
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        y = self.laterals[-1](levels[-1])
        for i in range(len(levels) - 2, -1, -1):
            y = functional.interpolate(y, scale_factor=2.0, mode="bilinear", align_corners=False)
            y = self.merges[i](y + self.laterals[i](levels[i]))
        return functional.normalize(self.head(y).float(), dim=1)


class WordHead(nn.Module):
    """Means of word vectors to the space of the image side; linear, so that it can be folded into the table."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, DIM, bias=False)
        self.log_scale = nn.Parameter(torch.tensor(2.5))
        self.bias = nn.Parameter(torch.tensor(-6.0))

    def forward(self, words: Tensor) -> Tensor:
        """Return unit vectors."""
        return functional.normalize(self.linear(words), dim=1)
