"""Deformable convolution (Dai et al. 2017, v1) from `grid_sample`: no compiled operator, any device."""

import torch
from jaxtyping import Float
from torch import Tensor, nn


def deform_conv2d(
    x: Float[Tensor, "b c h w"],
    offset: Float[Tensor, "b k2 h w"],
    weight: Float[Tensor, "o i kh kw"],
    *,
    groups: int = 1,
) -> Float[Tensor, "b o h w"]:
    """Convolve with taps moved by `offset`, stride 1, padded to the same size, zero outside.

    out(p) = sum_k w_k x(p + p_k + d_k), x read bilinearly. Channels of `offset` are (dy, dx) of each tap, row by row.
    """
    b, c, h, w = x.shape
    kh, kw = weight.shape[2:]
    rows = torch.arange(h, device=x.device, dtype=x.dtype)
    columns = torch.arange(w, device=x.device, dtype=x.dtype)
    moved = offset.reshape(b, kh * kw, 2, h, w)
    taps: list[Tensor] = []
    for k in range(kh * kw):
        at_y = rows[None, :, None] + (k // kw - kh // 2) + moved[:, k, 0]
        at_x = columns[None, None, :] + (k % kw - kw // 2) + moved[:, k, 1]
        # to the [-1, 1] of grid_sample, where with align_corners the outermost pixel centres lie at -1 and 1
        grid = torch.stack([2 * at_x / max(w - 1, 1) - 1, 2 * at_y / max(h - 1, 1) - 1], dim=-1)
        taps.append(nn.functional.grid_sample(x, grid, mode="bilinear", padding_mode="zeros", align_corners=True))
    stacked = torch.stack(taps, dim=2).reshape(b, c * kh * kw, h, w)  # taps of a channel side by side, as in `weight`
    return nn.functional.conv2d(stacked, weight.reshape(weight.shape[0], -1, 1, 1), groups=groups)


class DeformConv2d(nn.Module):
    """3x3 deformable convolution that predicts its own offsets; they begin at zero, as a plain convolution."""

    def __init__(self, inputs: int, outputs: int, *, groups: int = 1) -> None:
        super().__init__()
        self.groups = groups
        self.weight = nn.Parameter(torch.empty(outputs, inputs // groups, 3, 3))
        nn.init.kaiming_uniform_(self.weight, a=5**0.5)
        self.conv_offset = nn.Conv2d(inputs, 18, 3, padding=1)
        nn.init.zeros_(self.conv_offset.weight)
        if self.conv_offset.bias is not None:
            nn.init.zeros_(self.conv_offset.bias)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b o h w"]:
        """Convolve."""
        return deform_conv2d(x, self.conv_offset(x), self.weight, groups=self.groups)
