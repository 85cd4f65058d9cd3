"""ResNet-50 and the smaller residual networks of the baselines, with torchvision's names in their state dicts."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn


def conv3x3(inputs: int, outputs: int, stride: int = 1) -> nn.Conv2d:
    """Return a 3x3 convolution without bias, as one that a batch norm follows has it."""
    return nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut (He et al. 2016)."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, downsample: nn.Module | None = None) -> None:
        super().__init__()
        self.conv1, self.bn1 = conv3x3(inputs, outputs, stride), nn.BatchNorm2d(outputs)
        self.conv2, self.bn2 = conv3x3(outputs, outputs), nn.BatchNorm2d(outputs)
        self.downsample = downsample

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        """Return relu(f(x) + shortcut(x))."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = torch.relu(self.bn1(self.conv1(x)))
        return torch.relu(self.bn2(self.conv2(x)) + shortcut)


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 convolutions and a shortcut; the stride is in the 3x3, as in torchvision."""

    expansion = 4

    def __init__(self, inputs: int, width: int, stride: int = 1) -> None:
        super().__init__()
        outputs = width * self.expansion
        self.conv1, self.bn1 = nn.Conv2d(inputs, width, 1, bias=False), nn.BatchNorm2d(width)
        self.conv2, self.bn2 = conv3x3(width, width, stride), nn.BatchNorm2d(width)
        self.conv3, self.bn3 = nn.Conv2d(width, outputs, 1, bias=False), nn.BatchNorm2d(outputs)
        self.downsample = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        """Return relu(f(x) + shortcut(x))."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = torch.relu(self.bn1(self.conv1(x)))
        x = torch.relu(self.bn2(self.conv2(x)))
        return torch.relu(self.bn3(self.conv3(x)) + shortcut)


class ResNet50(nn.Module):
    """The image backbone of FlashOcc and DHD-S: stages 3 and 4, at 1/16 and 1/32. 23.51 M parameters."""

    channels = (1024, 2048)

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = self._stage(64, 64, 3, 1)
        self.layer2 = self._stage(256, 128, 4, 2)
        self.layer3 = self._stage(512, 256, 6, 2)
        self.layer4 = self._stage(1024, 512, 3, 2)

    @staticmethod
    def _stage(inputs: int, width: int, blocks: int, stride: int) -> nn.Sequential:
        rest = [Bottleneck(width * Bottleneck.expansion, width) for _ in range(blocks - 1)]
        return nn.Sequential(Bottleneck(inputs, width, stride), *rest)

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> list[Tensor]:
        """Return features (n, 1024, h/16, w/16) and (n, 2048, h/32, w/32)."""
        x = torch.relu(self.bn1(self.conv1(images)))
        x = self.layer2(self.layer1(nn.functional.max_pool2d(x, 3, 2, 1)))
        middle = self.layer3(x)
        return [middle, self.layer4(middle)]


class TinyResNet(nn.Module):
    """A backbone of basic blocks for CPUs and tests; at 128 x 48 pixels strides of 16 would leave 8 x 3 features."""

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        self.channels = (4 * width, 8 * width)
        self.conv1, self.bn1 = nn.Conv2d(3, width, 5, 2, 2, bias=False), nn.BatchNorm2d(width)
        widths = (width, width, 2 * width, 4 * width, 8 * width)
        stages = zip(widths, widths[1:], (1, 2, 2, 2), strict=False)
        self.layer1, self.layer2, self.layer3, self.layer4 = (residual_stage(a, b, 1, stride=s) for a, b, s in stages)

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> list[Tensor]:
        """Return features at 1/8 and 1/16."""
        x = torch.relu(self.bn1(self.conv1(images)))
        middle = self.layer3(self.layer2(self.layer1(x)))
        return [middle, self.layer4(middle)]


def residual_stage(inputs: int, outputs: int, blocks: int, *, stride: int = 2) -> nn.Sequential:
    """Return basic blocks whose first one shrinks; its shortcut is a 3x3 convolution with bias and no norm (BEVDet)."""
    shrink = nn.Conv2d(inputs, outputs, 3, stride, 1)
    rest = [BasicBlock(outputs, outputs) for _ in range(blocks - 1)]
    return nn.Sequential(BasicBlock(inputs, outputs, stride, shrink), *rest)


class BevResNet(nn.Module):
    """The bird's-eye-view backbone: stages of two basic blocks, each at half the size of the one before (BEVDet)."""

    def __init__(self, inputs: int, widths: Sequence[int], blocks: int = 2) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            residual_stage(a, b, blocks) for a, b in zip((inputs, *widths), widths, strict=False)
        )

    def forward(self, bev: Float[Tensor, "b c y x"]) -> list[Tensor]:
        """Return the output of every stage."""
        outputs: list[Tensor] = []
        for layer in self.layers:
            bev = layer(bev)
            outputs.append(bev)
        return outputs
