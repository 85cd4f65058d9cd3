"""Necks: features of two scales become one."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from openvocab_occ.networks.resnet import conv3x3


class NamedConv(nn.Module):
    """A convolution with bias under the name `conv`, as public checkpoints have it."""

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h w"]:
        """Convolve."""
        return self.conv(x)


class ImageNeck(nn.Module):
    """Feature pyramid of which only the finest level is made: 1x1 laterals, nearest upsampling, sum, 3x3."""

    def __init__(self, inputs: Sequence[int], outputs: int = 256) -> None:
        super().__init__()
        self.lateral_convs = nn.ModuleList(NamedConv(channels, outputs, 1) for channels in inputs)
        self.fpn_convs = nn.ModuleList([NamedConv(outputs, outputs, 3)])

    def forward(self, features: Sequence[Tensor]) -> Float[Tensor, "n c h w"]:
        """Return features at the size of the first input."""
        fine, coarse = (lateral(x) for lateral, x in zip(self.lateral_convs, features, strict=True))
        return self.fpn_convs[0](fine + nn.functional.interpolate(coarse, size=fine.shape[2:], mode="nearest"))


class BevNeck(nn.Module):
    """FPN_LSS: the first and the last stage of the BEV backbone, at twice the size of the first (BEVDet)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        wide = 2 * outputs
        self.conv = nn.Sequential(
            conv3x3(inputs, wide), nn.BatchNorm2d(wide), nn.ReLU(inplace=True),
            conv3x3(wide, wide), nn.BatchNorm2d(wide), nn.ReLU(inplace=True),
        )  # fmt: skip
        self.up2 = nn.Sequential(
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True),
            conv3x3(wide, outputs), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True), nn.Conv2d(outputs, outputs, 1),
        )  # fmt: skip

    def forward(self, stages: Sequence[Tensor]) -> Float[Tensor, "b c y x"]:
        """Return the latent feature."""
        fine, coarse = stages[0], stages[-1]
        coarse = nn.functional.interpolate(coarse, size=fine.shape[2:], mode="bilinear", align_corners=True)
        return self.up2(self.conv(torch.cat([fine, coarse], dim=1)))
