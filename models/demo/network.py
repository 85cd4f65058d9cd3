"""The image side: convolutions down to stride 32 and back up to stride 4; and the linear head of the text side.

Plain convolutions train and run faster on processors than depthwise ones of fewer weights.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

DIM = 64
COLORS = 16
"""How many of the numbers, the last ones, tell colour; the others tell what a thing is, which part, and its material.

A word speaks of one or the other, so that a colour and a thing that were never seen together still add up."""
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
        self.scene = nn.Conv2d(_WIDTHS[-1], _NECKS[-1], 1)  # what all of the picture says about each part of it
        nn.init.zeros_(self.scene.weight)
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
        y = self.top(levels[-1]) + self.scene(levels[-1].mean(dim=(2, 3), keepdim=True))
        for i in reversed(range(len(_NECKS))):
            y = functional.interpolate(self.narrow[i](y), scale_factor=2.0, mode="bilinear", align_corners=False)
            y = self.merges[i](y + self.laterals[i](levels[i]))
        look, color = self.head(y).float().split((DIM - COLORS, COLORS), dim=1)
        return 0.5**0.5 * torch.cat([functional.normalize(look, dim=1), functional.normalize(color, dim=1)], dim=1)


class WordHead(nn.Module):
    """Word vectors to the space of the image side: one linear map for colours, one for other words; all of one length.

    A text is the mean of its words, so that a blue van is as much a van as it is blue.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.look = nn.Linear(inputs, DIM - COLORS, bias=False)
        self.color = nn.Linear(inputs, COLORS, bias=False)
        self.log_scale = nn.Parameter(torch.tensor(2.5))
        self.bias = nn.Parameter(torch.tensor(-6.0))

    def forward(self, vectors: Tensor, colors: Tensor, share: Tensor) -> Tensor:
        """Return unit vectors of texts, given words as `words` takes them and the share [texts, words] of each."""
        return functional.normalize(share @ self.words(vectors, colors), dim=1)

    def words(self, vectors: Tensor, colors: Tensor) -> Tensor:
        """Return unit vectors of words, given their vectors and which of them are colours; silent words stay zero."""
        of = colors[:, None]
        both = torch.cat([self.look(vectors) * ~of, self.color(vectors) * of], dim=1)
        return functional.normalize(both, dim=1)
