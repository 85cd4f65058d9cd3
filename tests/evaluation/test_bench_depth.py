"""The depth bench: a small run in which every way agrees with the walk."""

import numpy as np
import pytest

from openvocab_occ.depth import render_depth
from openvocab_occ.errors import ConfigError
from openvocab_occ.evaluation import bench_depth as bench
from openvocab_occ.evaluation import depth_peers
from openvocab_occ.geometry import Camera, GridSpec, look_at
from openvocab_occ.occupancy import GEOMETRY_CLASSES, OccupancyGrid


@pytest.fixture(scope="module")
def report():
    pytest.importorskip("open3d", exc_type=ImportError)
    pytest.importorskip("embreex")
    return bench.bench_depth(rounds=1, threads=(1, 2), peers=tuple(bench.PEERS), width=96, height=54)


def test_every_exact_way_sees_the_same(report):
    assert [(t.name, t.threads) for t in report.timings] == [
        ("ours", 1), ("open3d", 1), ("embreex", 1), ("walk", 1), ("sampling", 1),
        ("ours", 2), ("open3d", 2), ("embreex", 2), ("walk", 2),
    ]  # fmt: skip
    for timing in report.timings:
        assert (
            timing.differ == 0.0
            if timing.name in ("ours", "walk")
            else timing.differ < (1.0 if timing.name == "sampling" else 1e-3)
        )
        assert timing.rays_per_second == pytest.approx(6 * 96 * 54 / timing.seconds)
    assert 0.0 < report.samples_late < 0.1
    assert report.memory_over_output >= 1.0


def test_the_paper_in_torch_is_our_sampling(rng):
    labels = (rng.random((12, 10, 8)) > 0.06).astype(np.uint8)
    grid = OccupancyGrid(
        labels, GridSpec((-3.0, -2.0, 0.0), (0.5, 0.5, 0.4), labels.shape), free_label=1, class_names=GEOMETRY_CLASSES
    )
    K = np.array([[28.0, 0, 15.3], [0, 26.0, 10.2], [0, 0, 1]])
    for place in ([0.31, 0.22, 1.13], [-9.03, 4.07, 3.11]):
        camera = Camera(K, 32, 22, look_at(place, [5, 1, 0.5]))
        depth = depth_peers.torch_sampling(grid, [camera], 30.0, 1, 0.1)()[0]
        ours = render_depth(grid, camera, max_depth=30.0, step=0.1).depth.ravel()
        assert (np.abs(depth - ours) < 1e-4).mean() > 0.99  # theirs is float32


def test_halving_voxels_changes_no_depth(rng):
    labels = (rng.random((6, 5, 4)) > 0.2).astype(np.uint8)
    grid = OccupancyGrid(
        labels, GridSpec((0.0, 0.0, 0.0), 1.0, labels.shape), free_label=1, class_names=GEOMETRY_CLASSES
    )
    camera = Camera(
        np.array([[28.0, 0, 15.3], [0, 26.0, 10.2], [0, 0, 1]]), 32, 22, look_at([-4.1, 2.2, 5.3], [3, 3, 2])
    )
    np.testing.assert_allclose(
        render_depth(bench.halved(grid), camera).depth, render_depth(grid, camera).depth, rtol=1e-6
    )


@pytest.mark.parametrize("options", [{"peers": ("optix",)}, {"rounds": 0}, {"threads": ()}])
def test_what_cannot_be_run_is_refused(options):
    with pytest.raises(ConfigError, match="bench cannot run so"):
        bench.bench_depth(**options)
