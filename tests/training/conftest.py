"""A street of boxes driven along, small enough to learn from in a test."""

import numpy as np
import pytest
import torch

from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.geometry import Camera, look_at, pose
from openvocab_occ.occupancy import OCC3D_FREE, OCC3D_SPEC, OccupancyGrid
from openvocab_occ.training.drives import CityPlan, by_place, write_drive

K = np.array([[101.0, 0, 63.5], [0, 101.0, 23.5], [0, 0, 1]])
PLAN = CityPlan(cities=(100, 101), visits=2, frames=2, every=4)


def labels_at(x: float, seed: int) -> np.ndarray:
    """Road, walls at the sides, and boxes that stay where they are while the ego moves along x."""
    labels = np.full(OCC3D_SPEC.shape, OCC3D_FREE, np.uint8)
    labels[:, :, 2] = 11
    labels[:, 85:88, 3:10] = 15
    labels[:, 112:115, 3:8] = 16
    for box in np.random.default_rng(seed).uniform(-15, 15, (6, 1)):
        i = round((box[0] - x + 40) / 0.4)
        labels[i : i + 8, 96:100, 3:6] = 4
    return labels


def drive_frames(seed: int, frames: int = 2, cameras: int = 2, start: float = 0.0, day: int = 0) -> FrameSequence:
    def read(index: int) -> Frame:
        T = pose((start + 2.0 * index, 0.5 * day, 0))
        eye = np.array([0.31, 0.17, 1.53])
        looks = [look_at(eye, eye + d) for d in ([1.0, 0.13, 0.011], [-1.0, 0.07, 0.013])][:cameras]
        rng = np.random.default_rng([seed, index])
        views = tuple(
            View(rng.integers(0, 255, (48, 128, 3), dtype=np.uint8), Camera(K, 128, 48, T @ look), name=f"cam{n}")
            for n, look in enumerate(looks)
        )
        grid = OccupancyGrid(labels_at(T[0, 3], seed), OCC3D_SPEC, T)
        return Frame(index, 1000.0 + 1e5 * day + index, T, views, grid, token=f"t{seed}-{day}-{index}")

    return FrameSequence(f"drive-{seed}-{day}", range(frames), read, source="made up", synthetic=True)


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def drives(tmp_path_factory):
    """The files of PLAN, with this street in place of the city."""
    from openvocab_occ.networks.flashocc import MICRO

    folder = tmp_path_factory.mktemp("drives")
    return [
        write_drive(folder / f"{info.name}.npz", drive_frames(options["seed"], day=info.visit), info, MICRO)
        for info, options in PLAN.drives()
    ]


@pytest.fixture(scope="session")
def places(drives):
    return by_place(drives)


@pytest.fixture(scope="session")
def baseline(drives, tmp_path_factory):
    """Weights of a baseline that has learned a little: what it predicts is not all of one class."""
    from openvocab_occ.networks.predictor import load_network
    from openvocab_occ.training.loop import TrainConfig, train_baseline

    torch.manual_seed(0)
    network = load_network("flashocc-micro")
    return train_baseline(network, drives, tmp_path_factory.mktemp("base"), TrainConfig(steps=12, batch=2, warm_up=2))
