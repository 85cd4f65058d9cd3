"""FlashOcc (Yu et al. 2023): images to a ground feature to voxels, without 3D convolutions."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from openvocab_occ.networks.head import OccHead
from openvocab_occ.networks.lift_splat import BevGrid, LiftSplat, Rig
from openvocab_occ.networks.necks import BevNeck, ImageNeck
from openvocab_occ.networks.resnet import BevResNet, ResNet50, TinyResNet


@dataclass(frozen=True)
class FlashOccConfig:
    """Sizes of a FlashOcc."""

    image_size: tuple[int, int] = (256, 704)
    """Height and width of the network's input."""
    latent: int = 128
    """Channels of the latent ground feature that enters the head."""
    depth_range: tuple[float, float, float] = (1.0, 45.0, 1.0)
    """First, end and step of the depth bins, metres."""
    context: int = 64
    neck: int = 256
    tiny: bool = False
    """A small backbone and BEV encoder, for CPUs."""
    lower: tuple[float, float, float] = (-40.0, -40.0, -1.0)
    cell: float = 0.4
    shape: tuple[int, int, int] = (200, 200, 16)
    """Voxels along x, y, z."""
    classes: int = 18
    public_quirks: bool = False
    """Reproduce what public weights were trained with: points truncated toward cell 0, colours in the other order."""

    def bev_grid(self, low: float | None = None, layers: int = 1, height: float | None = None) -> BevGrid:
        """Return the ground grid, by default one layer over the whole height."""
        height = self.cell * self.shape[2] if height is None else height
        lower = (self.lower[0], self.lower[1], self.lower[2] if low is None else low)
        return BevGrid(lower, (self.cell, self.cell, height), (self.shape[0], self.shape[1], layers))


M0 = FlashOccConfig()
M1 = FlashOccConfig(latent=256, depth_range=(1.0, 45.0, 0.5))
TINY = FlashOccConfig(
    image_size=(48, 128), latent=48, depth_range=(1.0, 41.0, 0.5), context=32, neck=48, tiny=True,
    cell=0.8, shape=(100, 100, 8),
)  # fmt: skip
"""For tests and CPUs: 0.8 m voxels, six images of 128 x 48."""
MICRO = replace(
    TINY, latent=32, depth_range=(1.0, 25.0, 1.0), context=24, neck=32, lower=(-20.0, -20.0, -1.0), shape=(50, 50, 8)
)
"""A quarter of TINY's ground, for smoke runs."""


class FlashOcc(nn.Module):
    """Names of its parts are those of public checkpoints."""

    def __init__(self, config: FlashOccConfig = M0) -> None:
        super().__init__()
        self.config = config
        width = (config.context, 2 * config.context, 4 * config.context, 8 * config.context)
        self.img_backbone = TinyResNet() if config.tiny else ResNet50()
        self.img_neck = ImageNeck(self.img_backbone.channels, config.neck)
        self.img_view_transformer = LiftSplat(
            config.neck, config.context, config.depth_range, config.bev_grid(), truncate=config.public_quirks
        )
        self.img_bev_encoder_backbone = BevResNet(config.context, width[1:], 1 if config.tiny else 2)
        self.img_bev_encoder_neck = BevNeck(width[1] + width[3], config.latent)
        self.occ_head = OccHead(config.latent, heights=config.shape[2], classes=config.classes)

    def latent(self, images: Float[Tensor, "b n 3 h w"], rig: Rig) -> Float[Tensor, "b c y x"]:
        """Return the current latent feature: what enters the head, and what a memory prior is fused with."""
        features = self.image_features(images)
        bev, _ = self.img_view_transformer(features, rig, self.config.image_size)
        return self.img_bev_encoder_neck(self.img_bev_encoder_backbone(bev))

    def image_features(self, images: Float[Tensor, "b n 3 h w"]) -> Float[Tensor, "b n c h2 w2"]:
        """Return features at 1/16 (tiny ones at 1/8) of normalised images."""
        flat = images.flatten(0, 1)
        if self.config.public_quirks:
            flat = flat.flip(1)
        return self.img_neck(self.img_backbone(flat)).unflatten(0, images.shape[:2])

    def forward(self, images: Float[Tensor, "b n 3 h w"], rig: Rig) -> Float[Tensor, "b x y z classes"]:
        """Return logits of every voxel."""
        return self.occ_head(self.latent(images, rig))


def count_parameters(network: nn.Module) -> int:
    """Return how many numbers a network learns."""
    return sum(p.numel() for p in network.parameters())


def on_meta(build: type[nn.Module], *arguments: object) -> nn.Module:
    """Build a network without memory for its weights, to count or to compare names."""
    with torch.device("meta"):
        return build(*arguments)
