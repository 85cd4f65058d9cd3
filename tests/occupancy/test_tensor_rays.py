"""Rays that are tensors hit what arrays hit; the Triton kernel is tried by its interpreter where there is no GPU."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

import openvocab_occ
from openvocab_occ.depth import render_depth
from openvocab_occ.errors import ConfigError, DataError, ShapeError
from openvocab_occ.geometry import Camera, GridSpec, pose
from openvocab_occ.occupancy import GEOMETRY_CLASSES, OccupancyGrid, cast_rays

HERE = Path(__file__).parent
PACKAGE = Path(openvocab_occ.__file__).parents[1]
needs_triton = pytest.mark.skipif(find_spec("triton") is None, reason="Triton is not installed")


def grid_of(occupied, **lattice) -> OccupancyGrid:
    spec = GridSpec((-2.0, 1.0, 0.5), (0.5, 0.3, 0.2), occupied.shape)
    labels = np.where(occupied, 0, 1).astype(np.uint8)
    return OccupancyGrid(labels, spec, free_label=1, class_names=GEOMETRY_CLASSES, **lattice)


@pytest.fixture
def scene(rng):
    grid = grid_of(rng.random((9, 7, 5)) < 0.1, T_world_grid=pose([3.0, -2.0, 1.0], [0.9, 0.1, -0.3, 0.2]))
    low, high = grid.spec.bounds
    origins = rng.uniform(low - 1, high + 1, (2000, 3)) + np.array([3.0, -2.0, 1.0])
    directions = rng.normal(size=(2000, 3))
    directions[5] = np.nan
    return grid, origins, directions


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, needs_triton])])
def test_tensors_hit_what_arrays_hit(scene, device):
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("there is no GPU")
    grid, origins, directions = scene
    for one in (origins, origins[0]):
        wanted = cast_rays(grid, one, directions, 5.0)
        hits = cast_rays(grid, torch.from_numpy(one).to(device), torch.from_numpy(directions).to(device), 5.0)
        assert hits.voxel.device.type == hits.distance.device.type == device
        assert (hits.voxel.dtype, hits.distance.dtype) == (torch.int32, torch.float32)
        assert (hits.voxel.cpu().numpy() == wanted.voxel).mean() > 0.999
        np.testing.assert_allclose(hits.distance.cpu().numpy(), wanted.distance, atol=1e-5)


@needs_triton
def test_the_triton_kernel_agrees_with_the_walk_on_all_families():
    """By its interpreter, in a process of its own, because it has to be chosen before Triton is loaded."""
    run = subprocess.run(
        [sys.executable, str(HERE / "triton_families.py")],
        env={**os.environ, "TRITON_INTERPRET": "1", "PYTHONPATH": str(PACKAGE)},
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    found = json.loads(run.stdout)
    assert sum(found["hits"].values()) > 100
    assert found["different"] == dict.fromkeys(found["hits"], 0)


@pytest.mark.usefixtures("unchecked")
def test_what_is_no_ray_is_refused(scene):
    from openvocab_occ.occupancy.tensor_rays import lattice_tensors

    grid, origins, directions = scene
    o, d = torch.from_numpy(origins), torch.from_numpy(directions)
    with pytest.raises(ShapeError, match=r"ray directions has the wrong shape: expected \(any, 3\), got \(2000, 2\)"):
        lattice_tensors(grid, o, d[:, :2])
    with pytest.raises(ShapeError, match="ray origins has the wrong shape"):
        lattice_tensors(grid, o[:7], d)
    with pytest.raises(DataError, match="rays are not rays"):
        lattice_tensors(grid, o, torch.zeros(2000, 3))
    with pytest.raises(DataError, match="rays are half tensors"):
        cast_rays(grid, origins, d)


def test_tensors_and_arrays_meet_in_the_same_lattice(scene):
    from openvocab_occ.occupancy.rays import lattice_rays
    from openvocab_occ.occupancy.tensor_rays import lattice_tensors

    grid, origins, directions = scene
    units = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    starts, steps = lattice_tensors(grid, torch.from_numpy(origins), torch.from_numpy(directions))
    wanted = lattice_rays(grid, origins, units)
    np.testing.assert_allclose(starts.numpy(), wanted[0], atol=1e-12)
    np.testing.assert_allclose(steps.numpy(), wanted[1], atol=1e-12)


@pytest.mark.gpu
@needs_triton
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_depth_is_walked_on_a_gpu(scene):
    grid = scene[0]
    camera = Camera(np.array([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]]), 64, 48, grid.T_world_grid)
    wanted, found = render_depth(grid, camera), render_depth(grid, camera, device="cuda")
    assert (found.voxel == wanted.voxel).mean() > 0.999
    np.testing.assert_allclose(np.median(np.abs(found.depth - wanted.depth)), 0, atol=1e-5)


def test_what_a_gpu_cannot_render_is_said(scene):
    grid = scene[0]
    camera = Camera(np.eye(3), 4, 4)
    with pytest.raises(ConfigError, match=r"a GPU renders exact depth of voxels only: .*got cuda"):
        render_depth(grid, camera, step=0.1, device="cuda")
    if not torch.cuda.is_available():
        with pytest.raises(ConfigError, match="torch cannot use this device: .*got cuda"):
            render_depth(grid, camera, device="cuda")
