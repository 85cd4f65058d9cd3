"""The image side: plain convolutions down to stride 32 and back up to stride 4; and the linear head of the text side.

Plain convolutions train and run faster on processors than depthwise ones of fewer weights.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

DIM = 64
_WIDTHS = (32, 64, 96, 160)  # at strides 4, 8, 16, 32
_DILATIONS = ((), (1,), (1, 2), (1, 2, 4))  # of the residual blocks there
_NECKS = (32, 48, 64)  # on the way back up, at strides 4, 8, 16


def _conv(inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, dilation, dilation, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class Residual(nn.Module):
    """Two convolutions beside the identity."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.first = _conv(channels, channels, dilation=dilation)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Add what the convolutions find."""
        return functional.relu(x + self.second(self.first(x)))


class Segmenter(nn.Module):
    """RGB in 0..1, sides multiples of 32, to unit features every 4 pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _conv(3, 16, stride=2)
        stages = [
            nn.Sequential(_conv(a, b, stride=2), *(Residual(b, dilation) for dilation in dilations))
            for (a, b), dilations in zip(pairwise((16, *_WIDTHS)), _DILATIONS, strict=True)
        ]
        self.stages = nn.ModuleList(stages)
        self.top = nn.Conv2d(_WIDTHS[-1], _NECKS[-1], 1)
        self.laterals = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in zip(_WIDTHS, _NECKS, strict=False))
        self.narrow = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairwise((*_NECKS, _NECKS[-1])))
        self.merges = nn.ModuleList(_conv(n, n) for n in _NECKS)
        self.head = nn.Conv2d(_NECKS[0], DIM, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Return [n, 64, h / 4, w / 4]."""
        x = self.stem((image - 0.45) / 0.25)
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        y = self.top(levels[-1])
        for i in reversed(range(len(_NECKS))):
            y = functional.interpolate(self.narrow[i](y), scale_factor=2.0, mode="bilinear", align_corners=False)
            y = self.merges[i](y + self.laterals[i](levels[i]))
        return functional.normalize(self.head(y).float(), dim=1)


class WordHead(nn.Module):
    """Word vectors to the space of the image side: a linear map, and every word as long as any other.

    A text is the mean of its words, so that a blue van is as much a van as it is blue.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, DIM, bias=False)
        self.log_scale = nn.Parameter(torch.tensor(2.5))
        self.bias = nn.Parameter(torch.tensor(-6.0))

    def forward(self, vectors: Tensor, share: Tensor) -> Tensor:
        """Return unit vectors of texts, given the vectors of words and the share [texts, words] of each in a text."""
        return functional.normalize(share @ self.words(vectors), dim=1)

    def words(self, vectors: Tensor) -> Tensor:
        """Return unit vectors of words; silent words stay zero."""
        return functional.normalize(self.linear(vectors), dim=1)
