"""Run the Triton kernel and the walk on the families of rays of test_rays, and render depth of a pinhole and a fisheye
camera both ways; print how many hits and differences.
"""

import json
import warnings

import numpy as np
import torch
from test_rays import FAMILIES

from openvocab_occ.depth import render_depth
from openvocab_occ.geometry import Camera, GridSpec, pose
from openvocab_occ.occupancy import GEOMETRY_CLASSES, OccupancyGrid, _rays_kernels, _rays_triton


def main() -> None:
    warnings.simplefilter("ignore")  # the interpreter divides where a mask says not to look
    random = np.random.default_rng(0)
    hits: dict[str, int] = {}
    different: dict[str, int] = {}
    for family in FAMILIES:
        name = family.__name__
        hits[name] = different[name] = 0
        for shape, density in (((9, 7, 5), 0.1), ((1, 12, 3), 0.3), ((1, 1, 1), 1.0), ((6, 6, 6), 0.0)):
            occupied = random.random(shape) < density
            origins, directions = family(random, 100, shape)
            directions[3] = np.nan
            for t_max in (3.3, np.inf):
                t, voxel = np.empty(100, np.float32), np.empty(100, np.int32)
                _rays_kernels.first_hits(origins, directions, occupied, t_max, 0, 100, t, voxel)
                found = _rays_triton.first_hits(
                    torch.from_numpy(origins),
                    torch.from_numpy(directions),
                    torch.from_numpy(occupied.view(np.uint8)),
                    t_max,
                )
                hits[name] += int((voxel >= 0).sum())
                different[name] += int(((found[0].numpy() != t) | (found[1].numpy() != voxel)).sum())
    grid = OccupancyGrid(
        (random.random((12, 10, 6)) < 0.9).astype(np.uint8), GridSpec((-2.4, -2.0, -1.0), (0.4, 0.4, 0.3), (12, 10, 6)),
        pose([5.0, 1.0, 0.5], [0.9, 0.1, -0.3, 0.2]), 1, class_names=GEOMETRY_CLASSES,
    )  # fmt: skip
    for lens in ("pinhole", "fisheye"):
        K = np.array([[9.0, 0.4 * (lens == "pinhole"), 7.3], [0.0, 8.0, 5.1], [0.0, 0.0, 1.0]])
        bend = () if lens == "pinhole" else (0.1, -0.02, 0.0, 0.0)
        camera = Camera(K, 16, 11, pose([5.1, 0.9, 0.4], [0.5, -0.5, 0.5, -0.5]), bend, lens)
        wanted = render_depth(grid, camera, max_depth=4.0)
        found = render_depth(grid, camera, max_depth=4.0, device="cpu")
        hits[lens] = int((wanted.voxel >= 0).sum())
        different[lens] = int(((found.depth != wanted.depth) | (found.voxel != wanted.voxel)).sum())
    print(json.dumps({"hits": hits, "different": different}))


if __name__ == "__main__":
    main()
