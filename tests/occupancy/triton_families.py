"""Run the Triton kernel and the walk on the families of rays of test_rays; print how many hits and differences."""

import json
import warnings

import numpy as np
import torch
from test_rays import FAMILIES

from openvocab_occ.occupancy import _rays_kernels, _rays_triton


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
    print(json.dumps({"hits": hits, "different": different}))


if __name__ == "__main__":
    main()
