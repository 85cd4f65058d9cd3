"""Lift, splat: image features onto a ground grid by a predicted depth distribution (Philion and Fidler 2020).

No custom operator: the sum over all points that fall into a cell is one `index_add`, on the CPU and the GPU alike.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


@dataclass(frozen=True, eq=False)
class Rig:
    """The cameras of a batch, as the view transform needs them; float32 tensors."""

    K: Float[Tensor, "b n 3 3"]
    """Intrinsics of the original images."""
    T_ego_cam: Float[Tensor, "b n 4 4"]
    """Camera to the key ego frame, with the ego's motion between the two times."""
    T_net_image: Float[Tensor, "b n 3 3"]
    """Homogeneous pixel of the original image to pixel of the network's input: resize, crop, flip, turn."""
    T_bev_ego: Float[Tensor, "b 3 3"]
    """Augmentation of the ground plane; the identity where there is none."""

    def to(self, device: torch.device | str) -> "Rig":
        """Return the rig on a device."""
        return Rig(*(t.to(device) for t in (self.K, self.T_ego_cam, self.T_net_image, self.T_bev_ego)))


@dataclass(frozen=True)
class BevGrid:
    """Cells that points are added up in, in metres of the ego frame; z layers go into channels."""

    lower: tuple[float, float, float]
    cell: tuple[float, float, float]
    shape: tuple[int, int, int]
    """Cells along x, y, z."""

    def index(
        self, points: Float[Tensor, "b p 3"], *, truncate: bool = False
    ) -> tuple[Int[Tensor, "b p"], Int[Tensor, "b p"]]:
        """Return the flat index ((z, y, x) order) of the cell of each point, and 1 where it lies in the grid, else 0.

        Truncation toward zero, as public training code has it, also puts points up to one cell below the lower border
        into the first cell.
        """
        scaled = (points - points.new_tensor(self.lower)) / points.new_tensor(self.cell)
        cells = scaled.trunc().long() if truncate else scaled.floor().long()
        limit = torch.tensor(self.shape, device=points.device)
        inside = ((cells >= 0) & (cells < limit)).all(dim=-1)
        x, y, z = cells.unbind(-1)
        flat = (z * self.shape[1] + y) * self.shape[0] + x
        return torch.where(inside, flat, 0), inside.long()


def inverse_3x3(m: Float[Tensor, "b n 3 3"]) -> Float[Tensor, "b n 3 3"]:
    """Return inverses by cross products of the rows: ONNX has no operator that inverts."""
    a, b, c = m.unbind(-2)

    def cross(u: Tensor, v: Tensor) -> Tensor:
        return u[..., [1, 2, 0]] * v[..., [2, 0, 1]] - u[..., [2, 0, 1]] * v[..., [1, 2, 0]]

    columns = torch.stack([cross(b, c), cross(c, a), cross(a, b)], dim=-1)
    return columns / (a * cross(b, c)).sum(dim=-1)[..., None, None]


class LiftSplat(nn.Module):
    """Predict depth and context for each feature pixel, and add them up in the cells of a grid."""

    def __init__(
        self,
        inputs: int,
        context: int,
        depth_range: tuple[float, float, float],
        grid: BevGrid,
        *,
        truncate: bool = False,
    ) -> None:
        super().__init__()
        near, far, step = depth_range
        self.depths = [near + i * step for i in range(round((far - near) / step))]
        self.context = context
        self.grid = grid
        self.truncate = truncate
        self.depth_net = nn.Conv2d(inputs, len(self.depths) + context, 1)

    def forward(
        self, features: Float[Tensor, "b n c h w"], rig: Rig, size: tuple[int, int]
    ) -> tuple[Float[Tensor, "b c2 y x"], Float[Tensor, "b n d h w"]]:
        """Return the ground feature and the depth distribution; `size` is (height, width) of the input images."""
        depth, context = self.predict(features)
        return self.splat(depth, context, self.points(rig, features.shape[3:], size), self.grid), depth

    def predict(
        self, features: Float[Tensor, "b n c h w"]
    ) -> tuple[Float[Tensor, "b n d h w"], Float[Tensor, "b n k h w"]]:
        """Return the depth distribution and the context of each feature pixel."""
        b, n = features.shape[:2]
        both = self.depth_net(features.flatten(0, 1)).unflatten(0, (b, n))
        return both[:, :, : len(self.depths)].softmax(dim=2), both[:, :, len(self.depths) :]

    def points(
        self, rig: Rig, cells: torch.Size | tuple[int, int], size: tuple[int, int]
    ) -> Float[Tensor, "b n d h w 3"]:
        """Return where each feature pixel lies in the key ego frame at each depth, metres."""
        h, w = cells
        K, device = rig.K, rig.K.device
        v, u = torch.meshgrid(
            torch.linspace(0, size[0] - 1, h, device=device),
            torch.linspace(0, size[1] - 1, w, device=device),
            indexing="ij",
        )
        pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).reshape(-1, 3)
        rays = torch.einsum("bnij,pj->bnpi", inverse_3x3(rig.T_net_image @ K), pixels)
        depths = torch.tensor(self.depths, device=device)
        local = rays[:, :, None] * depths[None, None, :, None, None]  # b n d p 3; z is the depth
        ego = torch.einsum("bnij,bndpj->bndpi", rig.T_ego_cam[..., :3, :3], local)
        ego = ego + rig.T_ego_cam[:, :, None, None, :3, 3]
        return torch.einsum("bij,bndpj->bndpi", rig.T_bev_ego, ego).unflatten(3, (h, w))

    def splat(
        self,
        depth: Float[Tensor, "b n d h w"],
        context: Float[Tensor, "b n k h w"],
        points: Float[Tensor, "b n d h w 3"],
        grid: BevGrid,
    ) -> Float[Tensor, "b kz y x"]:
        """Add depth x context up in the cells of a grid; layers of z are stacked in the channels, lowest first."""
        b, _, _, _, _ = depth.shape
        k = context.shape[2]
        X, Y, Z = grid.shape
        index, inside = grid.index(points.reshape(b, -1, 3), truncate=self.truncate)
        offset = torch.arange(b, device=depth.device)[:, None] * (X * Y * Z)
        values = torch.einsum("bndhw,bnkhw->bndhwk", depth, context).reshape(b, -1, k)
        values = values * inside[..., None].to(values.dtype)
        cells = values.new_zeros(b * X * Y * Z, k).index_add(0, (index + offset).reshape(-1), values.reshape(-1, k))
        return cells.reshape(b, Z, Y, X, k).permute(0, 1, 4, 2, 3).reshape(b, Z * k, Y, X)
