"""The walk of `_rays_kernels` as a Triton kernel, for rays that are torch tensors on a GPU.

A program walks a block of rays together, until the last of them is done. Crossings are computed from plane numbers in
float64 as on the CPU, so that both give the same voxels and, up to rounding where compilers fuse products, times.
"""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl

_RAYS = 128  # a program


@no_type_check
@triton.jit
def _axis(o, d, n, t):
    """Return the index that one axis is in from t on, t_enter <= t < t_leave, and when it leaves it."""
    i = tl.minimum(tl.maximum(tl.floor(o + t * d), 0.0), n - 1.0)
    safe = tl.where(d == 0.0, 1.0, d)
    up = d > 0.0
    for _ in tl.static_range(2):  # off by rounding at most, seen from within reach of the grid
        entered = (tl.where(up, i, i + 1.0) - o) / safe
        left = (tl.where(up, i + 1.0, i) - o) / safe
        back = (entered > t) & tl.where(up, i > 0.0, i < n - 1.0)
        on = ~back & (left <= t) & tl.where(up, i < n - 1.0, i > 0.0)
        i += tl.where(back, tl.where(up, -1.0, 1.0), 0.0) + tl.where(on, tl.where(up, 1.0, -1.0), 0.0)
    i = tl.where(d == 0.0, tl.floor(o), i)
    leave = tl.where(d == 0.0, float("inf"), (tl.where(up, i + 1.0, i) - o) / safe)
    return i, leave


@no_type_check
@triton.jit
def _clip(o, d, n, t_in, t_out):
    """Cut [t_in, t_out] down to where one axis is inside [0, n)."""
    safe = tl.where(d == 0.0, 1.0, d)
    a = -o / safe
    b = (n - o) / safe
    still = d == 0.0
    inside = (o >= 0.0) & (o < n)
    t_in = tl.where(still, t_in, tl.maximum(t_in, tl.minimum(a, b)))
    t_out = tl.where(still, tl.where(inside, t_out, -1.0), tl.minimum(t_out, tl.maximum(a, b)))
    return t_in, t_out


@no_type_check
@triton.jit
def _first_hits(origins, directions, occupied, end, count, X, Y, Z, out_t, out_voxel, shared: tl.constexpr,
                rays: tl.constexpr):  # fmt: skip
    t_max = tl.load(end)  # numbers among the arguments would be float32
    nx, ny, nz = X.to(tl.float64), Y.to(tl.float64), Z.to(tl.float64)
    r = tl.program_id(0) * rays + tl.arange(0, rays)
    there = r < count
    start = tl.where(there, 0 if shared else r, 0) * 3
    ox, oy, oz = tl.load(origins + start), tl.load(origins + start + 1), tl.load(origins + start + 2)
    go = tl.where(there, r, 0) * 3
    dx, dy, dz = tl.load(directions + go), tl.load(directions + go + 1), tl.load(directions + go + 2)
    sum_d = dx + dy + dz
    alive = there & (sum_d == sum_d)  # no NaN
    dx, dy, dz = tl.where(alive, dx, 1.0), tl.where(alive, dy, 1.0), tl.where(alive, dz, 1.0)
    t = tl.zeros_like(dx)
    t_end = tl.zeros_like(dx) + t_max
    t, t_end = _clip(ox, dx, nx, t, t_end)
    t, t_end = _clip(oy, dy, ny, t, t_end)
    t, t_end = _clip(oz, dz, nz, t, t_end)
    alive = alive & (t < t_end)
    x, tx = _axis(ox, dx, nx, t)
    y, ty = _axis(oy, dy, ny, t)
    z, tz = _axis(oz, dz, nz, t)
    sx, sy, sz = tl.where(dx == 0.0, 1.0, dx), tl.where(dy == 0.0, 1.0, dy), tl.where(dz == 0.0, 1.0, dz)
    hit_t = tl.zeros_like(dx) + t_max
    hit = tl.zeros_like(r) - 1
    while tl.sum(alive.to(tl.int32), axis=0) > 0:
        t_next = tl.minimum(tl.minimum(tx, ty), tz)
        flat = ((x * ny + y) * nz + z).to(tl.int32)
        stop = alive & (t < t_next)  # false where the ray only touches an edge or a corner
        stop = stop & (tl.load(occupied + flat, mask=stop, other=0) != 0)
        hit_t = tl.where(stop, t, hit_t)
        hit = tl.where(stop, flat, hit)
        go_x = tx == t_next
        go_y = ~go_x & (ty == t_next)
        go_z = ~go_x & ~go_y
        x = tl.where(go_x, tl.where(dx > 0.0, x + 1.0, x - 1.0), x)
        y = tl.where(go_y, tl.where(dy > 0.0, y + 1.0, y - 1.0), y)
        z = tl.where(go_z, tl.where(dz > 0.0, z + 1.0, z - 1.0), z)
        tx = tl.where(go_x, (tl.where(dx > 0.0, x + 1.0, x) - ox) / sx, tx)
        ty = tl.where(go_y, (tl.where(dy > 0.0, y + 1.0, y) - oy) / sy, ty)
        tz = tl.where(go_z, (tl.where(dz > 0.0, z + 1.0, z) - oz) / sz, tz)
        t = t_next
        inside = (x >= 0.0) & (x < nx) & (y >= 0.0) & (y < ny) & (z >= 0.0) & (z < nz)
        alive = alive & ~stop & inside & (t < t_end)
    tl.store(out_t + r, hit_t.to(tl.float32), mask=there)
    tl.store(out_voxel + r, hit, mask=there)


@no_type_check
def first_hits(
    origins: "torch.Tensor", directions: "torch.Tensor", occupied: "torch.Tensor", t_max: float
) -> tuple[Any, Any]:
    """Return t and voxel of rays in units of voxels: f64[n or 1, 3], f64[n, 3], u8[x, y, z], all on one device.

    NaN directions hit nothing.
    """
    count = len(directions)
    t = torch.empty(count, dtype=torch.float32, device=directions.device)
    voxel = torch.empty(count, dtype=torch.int32, device=directions.device)
    if count:
        end = torch.tensor([t_max], dtype=torch.float64, device=directions.device)
        _first_hits[(triton.cdiv(count, _RAYS),)](
            origins.contiguous(), directions.contiguous(), occupied.contiguous(), end, count, *occupied.shape, t, voxel,
            shared=len(origins) == 1, rays=_RAYS,
        )  # fmt: skip
    return t, voxel


@no_type_check
def pixel_rays(
    lens: list[float], R: list[list[float]], size: tuple[int, int], device: "torch.device"
) -> "torch.Tensor":
    """Return the rays of all pixels of a `PixelRays`, f64[pixels, 3], by its formula."""
    fx, skew, cx, fy, cy = lens
    v = torch.arange(size[0], dtype=torch.float64, device=device)[:, None]
    u = torch.arange(size[1], dtype=torch.float64, device=device)[None]
    y = (v - cy) / fy
    x = ((u - cx) - skew * y) / fx
    return torch.stack([(a * x + b * y) + c for a, b, c in R], dim=2).reshape(-1, 3)
