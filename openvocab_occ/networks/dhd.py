"""DHD-S (Wu et al. 2024): FlashOcc with a height prediction that sends features to three slabs of height."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from openvocab_occ.networks.deform import DeformConv2d
from openvocab_occ.networks.flashocc import TINY, FlashOcc, FlashOccConfig
from openvocab_occ.networks.lift_splat import BevGrid, Rig
from openvocab_occ.networks.resnet import BasicBlock, conv3x3

DHD_S = FlashOccConfig(latent=256)
SLABS = ((-1.0, 0.6), (0.6, 2.2), (2.2, 5.4))
"""Heights above the ego's ground, metres, whose features are kept apart."""
HEIGHT_STEP = 0.1
"""Metres between the bins of the height distribution, the first of which is the lowest slab's floor."""


def camera_vector(rig: Rig) -> Float[Tensor, "bn 27"]:
    """Return what HeightNet is told of each camera: intrinsics, image and BEV augmentation, extrinsics."""
    K, net, T, bev = rig.K, rig.T_net_image, rig.T_ego_cam, rig.T_bev_ego
    b, n = K.shape[:2]
    bev_rows = bev[:, None].expand(b, n, 3, 3)
    parts = [K[..., 0, 0], K[..., 1, 1], K[..., 0, 2], K[..., 1, 2]]
    parts += [net[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2))]
    parts += [bev_rows[..., i, j] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 2))]
    return torch.cat([torch.stack(parts, dim=-1), T[..., :3, :].reshape(b, n, 12)], dim=-1).flatten(0, 1)


class CameraMlp(nn.Module):
    """Two linear layers."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(inputs, outputs), nn.Linear(outputs, outputs)

    def forward(self, x: Float[Tensor, "n c"]) -> Float[Tensor, "n k"]:
        """Return fc2(relu(fc1(x)))."""
        return self.fc2(self.fc1(x).relu())


class CameraGate(nn.Module):
    """Squeeze-and-excitation by what is known of the camera."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv_reduce, self.conv_expand = nn.Conv2d(channels, channels, 1), nn.Conv2d(channels, channels, 1)

    def forward(self, x: Float[Tensor, "n c h w"], camera: Float[Tensor, "n c"]) -> Float[Tensor, "n c h w"]:
        """Scale the channels of x."""
        return x * self.conv_expand(self.conv_reduce(camera[..., None, None]).relu()).sigmoid()


class DilatedBranch(nn.Module):
    """One branch of the pyramid."""

    def __init__(self, channels: int, kernel: int, dilation: int) -> None:
        super().__init__()
        pad = 0 if kernel == 1 else dilation
        self.atrous_conv = nn.Conv2d(channels, channels, kernel, padding=pad, dilation=dilation, bias=False)
        self.bn = nn.BatchNorm2d(channels)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Convolve, normalise, rectify."""
        return self.bn(self.atrous_conv(x)).relu()


class DilatedPyramid(nn.Module):
    """Atrous spatial pyramid pooling (Chen et al. 2017): dilations 1, 6, 12, 18, and the image's mean."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.aspp1, self.aspp2, self.aspp3, self.aspp4 = (
            DilatedBranch(channels, kernel, dilation) for kernel, dilation in ((1, 1), (3, 6), (3, 12), (3, 18))
        )
        self.global_avg_pool = nn.Sequential(
            nn.AdaptiveAvgPool2d(1), nn.Conv2d(channels, channels, 1, bias=False), nn.BatchNorm2d(channels), nn.ReLU()
        )
        self.conv1, self.bn1 = nn.Conv2d(5 * channels, channels, 1, bias=False), nn.BatchNorm2d(channels)
        self.dropout = nn.Dropout(0.5)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Mix the branches."""
        mean = self.global_avg_pool(x).expand(-1, -1, *x.shape[2:])
        branches = [self.aspp1(x), self.aspp2(x), self.aspp3(x), self.aspp4(x), mean]
        return self.dropout(self.bn1(self.conv1(torch.cat(branches, dim=1))).relu())


class HeightNet(nn.Module):
    """Distribution over heights of each feature pixel."""

    def __init__(self, channels: int, bins: int) -> None:
        super().__init__()
        self.reduce_conv = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1), nn.BatchNorm2d(channels), nn.ReLU()
        )
        self.bn = nn.BatchNorm1d(27)
        self.depth_mlp = CameraMlp(27, channels)
        self.depth_se = CameraGate(channels)
        blocks = [BasicBlock(channels, channels) for _ in range(3)]
        tail = [DilatedPyramid(channels), DeformConv2d(channels, channels, groups=4), nn.Conv2d(channels, bins, 1)]
        self.depth_conv = nn.Sequential(*blocks, *tail)

    def forward(self, features: Float[Tensor, "b n c h w"], rig: Rig) -> Float[Tensor, "b n bins h w"]:
        """Return the softmax over the height bins."""
        x = self.reduce_conv(features.flatten(0, 1))
        x = self.depth_se(x, self.depth_mlp(self.bn(camera_vector(rig))))
        return self.depth_conv(x).softmax(dim=1).unflatten(0, features.shape[:2])


class DoubleConv(nn.Module):
    """Twice 3x3 convolution, norm, relu."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.double_conv = nn.Sequential(
            conv3x3(inputs, outputs), nn.BatchNorm2d(outputs), nn.ReLU(),
            conv3x3(outputs, outputs), nn.BatchNorm2d(outputs), nn.ReLU(),
        )  # fmt: skip

    def forward(self, x: Float[Tensor, "b c y x"]) -> Float[Tensor, "b k y x"]:
        """Convolve twice."""
        return self.double_conv(x)


class Down(nn.Module):
    """Halve, then convolve twice."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.maxpool_conv = nn.Sequential(nn.MaxPool2d(2), DoubleConv(inputs, outputs))

    def forward(self, x: Float[Tensor, "b c y x"]) -> Float[Tensor, "b k y2 x2"]:
        """Go down."""
        return self.maxpool_conv(x)


class Up(nn.Module):
    """Double, join what was passed over, convolve twice."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(inputs, inputs // 2, 2, 2)
        self.conv = DoubleConv(inputs, outputs)

    def forward(self, x: Float[Tensor, "b c y x"], skip: Float[Tensor, "b k y2 x2"]) -> Float[Tensor, "b o y2 x2"]:
        """Go up; odd sizes are padded."""
        x = self.up(x)
        rows, columns = skip.shape[2] - x.shape[2], skip.shape[3] - x.shape[3]
        x = nn.functional.pad(x, [columns // 2, columns - columns // 2, rows // 2, rows - rows // 2])
        return self.conv(torch.cat([skip, x], dim=1))


class UNet(nn.Module):
    """Four levels down and up (Ronneberger et al. 2015)."""

    def __init__(self, inputs: int, outputs: int, width: int = 64) -> None:
        super().__init__()
        w = width
        self.inc = DoubleConv(inputs, w)
        self.down1, self.down2, self.down3, self.down4 = (
            Down(w, 2 * w),
            Down(2 * w, 4 * w),
            Down(4 * w, 8 * w),
            Down(8 * w, 16 * w),
        )
        self.up1, self.up2, self.up3, self.up4 = Up(16 * w, 8 * w), Up(8 * w, 4 * w), Up(4 * w, 2 * w), Up(2 * w, w)
        self.outc = _OneByOne(w, outputs)

    def forward(self, x: Float[Tensor, "b c y x"]) -> Float[Tensor, "b k y x"]:
        """Return features of the same size."""
        a = self.inc(x)
        b = self.down1(a)
        c = self.down2(b)
        d = self.down3(c)
        x = self.up1(self.down4(d), d)
        return self.outc(self.up4(self.up3(self.up2(x, c), b), a))


class _OneByOne(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)


class ChannelAndPlaceGate(nn.Module):
    """Weigh the ground and the slab feature against each other, by channel, then by place."""

    def __init__(self, channels: int, squeeze: int = 32) -> None:
        super().__init__()
        self.fc = nn.Sequential(
            nn.Linear(2 * channels, squeeze, bias=False), nn.ReLU(), nn.Linear(squeeze, channels, bias=False)
        )
        self.spacial_leanring = nn.Sequential(  # the name is the public checkpoints' own
            nn.Conv2d(channels, channels, 1, bias=False), nn.BatchNorm2d(channels), nn.ReLU(),
            nn.Conv2d(channels, channels, 1, bias=False), nn.BatchNorm2d(channels),
        )  # fmt: skip

    def forward(self, bev: Float[Tensor, "b c y x"], slabs: Float[Tensor, "b c y x"]) -> Float[Tensor, "b c y x"]:
        """Return b a bev + (1 - b)(1 - a) slabs."""
        a = self.fc(torch.cat([bev, slabs], dim=1).mean(dim=(2, 3))).sigmoid()[..., None, None]
        b = self.spacial_leanring(a * bev + (1 - a) * slabs).sigmoid()
        return b * a * bev + (1 - b) * (1 - a) * slabs


class SlabFusion(nn.Module):
    """SFA: the gated mixture through a residual block whose shortcut is the plain concatenation."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mysk_7 = ChannelAndPlaceGate(channels)
        self.mix_residual = nn.Sequential(
            conv3x3(channels, channels),
            nn.BatchNorm2d(channels),
            nn.ReLU(),
            conv3x3(channels, channels),
            nn.BatchNorm2d(channels),
        )
        self.mix_shortcut = nn.Sequential(nn.Conv2d(2 * channels, channels, 1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, bev: Float[Tensor, "b c y x"], slabs: Float[Tensor, "b c y x"]) -> Float[Tensor, "b c y x"]:
        """Return the latent feature."""
        return (self.mix_residual(self.mysk_7(bev, slabs)) + self.mix_shortcut(torch.cat([bev, slabs], dim=1))).relu()


class Dhd(FlashOcc):
    """DHD-S; names of its parts are those of public checkpoints."""

    def __init__(self, config: FlashOccConfig = DHD_S) -> None:
        super().__init__(config)
        bins = round((SLABS[-1][1] - SLABS[0][0]) / HEIGHT_STEP) + 1
        self.heights = [SLABS[0][0] + i * HEIGHT_STEP for i in range(bins)]
        height_net = HeightNet(config.neck, bins)
        self.img_view_transformer.add_module("height_net", height_net)  # where public checkpoints have it
        self._height_net = [height_net]  # in a list, so that it is not listed twice
        self.slabs = [_slab(config, low, high) for low, high in SLABS]
        quarter = config.latent // 4
        width = 16 if config.tiny else 64
        nets = [
            UNet(config.context * grid.shape[2], outputs, width)
            for grid, outputs in zip(self.slabs, (quarter, 2 * quarter, quarter), strict=True)
        ]
        self.img_voxel_encoder0, self.img_voxel_encoder1, self.img_voxel_encoder2 = nets
        self.mix = SlabFusion(config.latent)

    def latent(self, images: Float[Tensor, "b n 3 h w"], rig: Rig) -> Float[Tensor, "b c y x"]:
        """Return the output of the slab fusion."""
        return self.latent_and_height(images, rig)[0]

    def latent_and_height(
        self, images: Float[Tensor, "b n 3 h w"], rig: Rig
    ) -> tuple[Float[Tensor, "b c y x"], Float[Tensor, "b n bins h2 w2"]]:
        """Return the latent feature, and for the height's own loss the distribution that chose the slabs."""
        view = self.img_view_transformer
        features = self.image_features(images)
        depth, context = view.predict(features)
        points = view.points(rig, features.shape[3:], self.config.image_size)
        bev = view.splat(depth, context, points, view.grid)
        bev = self.img_bev_encoder_neck(self.img_bev_encoder_backbone(bev))
        height = self._height_net[0](features, rig)
        kept = self.slab_masks(height)
        encoders = (self.img_voxel_encoder0, self.img_voxel_encoder1, self.img_voxel_encoder2)
        slabs = [
            encoder(view.splat(depth, context * mask.unsqueeze(2), points, grid))
            for encoder, mask, grid in zip(encoders, kept, self.slabs, strict=True)
        ]
        return self.mix(bev, torch.cat(slabs, dim=1)), height

    def slab_masks(self, height: Float[Tensor, "b n bins h w"]) -> list[Bool[Tensor, "b n h w"]]:
        """Tell for each slab which feature pixels lie in it by their likeliest height."""
        best = torch.tensor(self.heights, device=height.device)[height.argmax(dim=2)]
        return [(best >= low - 1e-4) & (best < high - 1e-4) for low, high in SLABS[:-1]] + [best >= SLABS[-1][0] - 1e-4]


def _slab(config: FlashOccConfig, low: float, high: float) -> BevGrid:
    layers = round((high - low) / config.cell)
    return config.bev_grid(low, layers, config.cell)


DHD_TINY = TINY
