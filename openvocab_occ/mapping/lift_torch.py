"""The lift in torch: the same sparse matrix of voxels by cells, built and multiplied on a GPU.

Another way to the numbers of `lift`: no squares, but one entry for each pixel and cell, which torch sorts and adds up.
On a CPU it is slower than the kernels and needs more memory; there it serves to test that both agree.
"""

import numpy as np
import torch
from jaxtyping import Float32, Int32, UInt8

from openvocab_occ.mapping.lift import Lifted, PixelWeights, Segments, Sight, lens_rays, pixel_reach
from openvocab_occ.segmentation.encoder import FeatureMap

Tensor = torch.Tensor


def lift_on(
    device: str,
    rows: Int32[np.ndarray, "h w"],
    num_rows: int,
    features: FeatureMap | Segments,
    *,
    image: UInt8[np.ndarray, "h w 3"] | None,
    sight: Sight | None,
    view: int,
) -> Lifted:
    """Return what `lift` returns, computed by torch on a device such as `cuda`; arguments were checked."""
    row = torch.from_numpy(np.ascontiguousarray(rows)).to(device).reshape(-1).long()
    dense = isinstance(features, FeatureMap)
    if not dense:
        ids = torch.from_numpy(np.ascontiguousarray(features.ids)).to(device).reshape(-1).long()
        row = torch.where(ids >= 0, row, -1)
    used = torch.nonzero(row >= 0)[:, 0]
    row = row[used]
    stride = 1 / max(abs(features.scale[0]), 1e-9) if dense else 16.0
    weight, normal = _weights(device, rows.shape, used, sight, stride)
    if dense:
        cells, cell, share = _bilinear(device, rows.shape, used, features)
    else:
        cells, cell = torch.from_numpy(features.vectors).to(device), ids[used][:, None]
        share = torch.ones_like(cell, dtype=torch.float64)
    sums, mask = _product(row, cell, share * weight[:, None], cells, num_rows)
    total = torch.zeros(num_rows, dtype=torch.float64, device=device).index_add_(0, row, weight)
    pixels = torch.bincount(row, minlength=num_rows)
    color = None
    if image is not None:
        seen = torch.from_numpy(np.ascontiguousarray(image)).to(device).reshape(-1, 3)[used].double()
        color = _added(row, seen * weight[:, None], num_rows)
    turned = None
    if sight is not None:
        turn = torch.from_numpy(sight.camera.T_world_cam[:3, :3].copy()).to(device)
        turned = _added(row, normal * weight[:, None], num_rows) @ turn.T
    whole = total.float().cpu().numpy()
    told = None if dense else _told(mask.cpu().numpy(), features.vectors, view)
    return Lifted(
        sums.cpu().numpy(),
        whole,
        pixels.int().cpu().numpy(),
        None if color is None else color.float().cpu().numpy(),
        None if turned is None else turned.float().cpu().numpy(),
        _boxes(row, used, rows.shape[1], num_rows).int().cpu().numpy(),
        np.full(num_rows, view, dtype=np.int32),
        whole.copy(),
        told,
    )


def _added(row: Tensor, values: Tensor, num_rows: int) -> Tensor:
    return torch.zeros((num_rows, values.shape[1]), dtype=values.dtype, device=row.device).index_add_(0, row, values)


def _product(row: Tensor, cell: Tensor, share: Tensor, cells: Tensor, num_rows: int) -> tuple[Tensor, Tensor]:
    """Return W @ cells for entries W[row, cell] += share, and the cell that weighs most in each row, -1 for none."""
    index = torch.stack([row[:, None].expand_as(cell).reshape(-1), cell.reshape(-1)])
    shape = (num_rows, len(cells))
    W = torch.sparse_coo_tensor(index, share.reshape(-1), shape, check_invariants=False).coalesce()
    at, values = W.indices(), W.values()
    sums = torch.zeros((num_rows, cells.shape[1]), dtype=torch.float32, device=cells.device)
    if values.numel():
        sums = torch.sparse.mm(W.float(), cells)
    most = torch.zeros(num_rows, dtype=values.dtype, device=cells.device)
    most.scatter_reduce_(0, at[0], values, "amax", include_self=False)
    heaviest = values == most[at[0]]
    best = torch.full((num_rows,), -1, dtype=torch.long, device=cells.device)
    best.scatter_reduce_(0, at[0][heaviest], at[1][heaviest], "amin", include_self=False)  # of equals the first
    return sums, best


def _told(best: np.ndarray, vectors: np.ndarray, view: int) -> Int32[np.ndarray, " m"]:
    """Name masks as `Lifted.mask` does."""
    told = (best >= 0) & (vectors != 0).any(axis=1)[best] if len(vectors) else best >= 0
    return np.where(told, view * 65536 + best, -1).astype(np.int32)


def _bilinear(
    device: str, shape: tuple[int, ...], used: Tensor, features: FeatureMap
) -> tuple[Float32[Tensor, "k c"], Tensor, Tensor]:
    """Return the cells, and the four that each used pixel mixes with the share of each."""
    height, width, channels = features.cells.shape
    v, u = used // shape[1], used % shape[1]
    x = (features.scale[0] * u.double() + features.offset[0]).clamp(0, width - 1)
    y = (features.scale[1] * v.double() + features.offset[1]).clamp(0, height - 1)
    left, top = x.floor(), y.floor()
    fx, fy = x - left, y - top
    right, below = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
    cell = torch.stack([top * width + left, top * width + right, below * width + left, below * width + right], dim=1)
    share = torch.stack([(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx], dim=1)
    cells = torch.from_numpy(np.ascontiguousarray(features.cells, dtype=np.float32)).to(device)
    return cells.reshape(-1, channels), cell.long(), share


def _weights(
    device: str, shape: tuple[int, ...], used: Tensor, sight: Sight | None, stride: float
) -> tuple[Tensor, Tensor]:
    """Return the weight of each used pixel, and its normal in the camera's frame; see `PixelWeights`."""
    weight = torch.ones(len(used), dtype=torch.float64, device=device)
    if sight is None:
        return weight, torch.zeros((len(used), 3), dtype=torch.float64, device=device)
    options: PixelWeights = sight.weights
    (h, w), K = shape, sight.camera.K
    v, u = used // w, used % w
    if options.border > 0:
        edge = torch.minimum(torch.minimum(u, w - 1 - u), torch.minimum(v, h - 1 - v)).double() + 0.5
        weight = weight * (edge / (options.border * stride)).clamp(max=1.0)
    depth = torch.from_numpy(np.ascontiguousarray(sight.depth, dtype=np.float32)).to(device)
    inverse = torch.where(torch.isfinite(depth) & (depth > 0), 1 / depth, torch.zeros_like(depth)).double()
    here, reach = inverse[v, u], pixel_reach(1 / stride)
    good = here > 0
    safe = torch.where(good, here, torch.ones_like(here))
    steps = [_slope(inverse, v, u, here, safe, dv * reach, du * reach) for dv, du in ((0, 1), (1, 0))]
    (du, bend_u), (dv, bend_v) = steps
    factor = torch.ones_like(weight)
    if options.range > 0:
        factor = factor / (1 + 1 / (safe * options.range) ** 2)
    if options.bend > 0:
        factor = factor / (1 + (torch.maximum(bend_u, bend_v) / options.bend) ** 2)
    rays = lens_rays(sight.camera)
    if rays.size:
        x, y = torch.from_numpy(rays).to(device)[v, u].double().unbind(1)
    else:
        y = (v.double() - K[1, 2]) / K[1, 1]
        x = (u.double() - K[0, 2] - K[0, 1] * y) / K[0, 0]
    a, b = du * K[0, 0] / reach, dv * K[1, 1] / reach
    c = here - a * x - b * y
    length = torch.sqrt(a * a + b * b + c * c)
    flat = good & (length > 0)
    long = torch.where(flat, length, torch.ones_like(length))
    if options.grazing > 0:
        cosine = here / (long * torch.sqrt(x * x + y * y + 1))
        factor = torch.where(flat, factor * cosine.clamp(min=options.grazing), factor)
    normal = torch.where(flat[:, None], -torch.stack([a, b, c], dim=1) / long[:, None], torch.zeros(1, device=device))
    return torch.where(good, weight * factor, weight), normal


def _slope(
    inverse: Tensor, v: Tensor, u: Tensor, here: Tensor, safe: Tensor, dv: int, du: int
) -> tuple[Tensor, Tensor]:
    """Return the difference of inverse depth to the nearer of two neighbours, seen forwards, and the bend."""
    h, w = inverse.shape
    none = torch.zeros_like(here)
    before = torch.where((v >= dv) & (u >= du), inverse[(v - dv).clamp(min=0), (u - du).clamp(min=0)], none)
    ahead = torch.where(
        (v + dv < h) & (u + du < w), inverse[(v + dv).clamp(max=h - 1), (u + du).clamp(max=w - 1)], none
    )
    back, forth = here - before, ahead - here
    nearer = torch.where(back.abs() < forth.abs(), back, forth)
    one = torch.where(before > 0, back, torch.where(ahead > 0, forth, none))
    both = (before > 0) & (ahead > 0)
    return torch.where(both, nearer, one), torch.where(both, (forth - back).abs() / safe, none)


def _boxes(row: Tensor, used: Tensor, width: int, num_rows: int) -> Tensor:
    """Return left, top, right, bottom pixel of each row; zeros for a row without pixels."""
    at = torch.stack([used % width, used // width], dim=1)
    index = row[:, None].expand(-1, 2)
    low = torch.zeros((num_rows, 2), dtype=torch.long, device=row.device)
    high = low.clone()
    low.scatter_reduce_(0, index, at, "amin", include_self=False)
    high.scatter_reduce_(0, index, at, "amax", include_self=False)
    return torch.cat([low, high], dim=1)
