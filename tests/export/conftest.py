"""Views of the street, and cameras to look at it."""

import json

import numpy as np
import pytest

from openvocab_occ.export import export_views
from openvocab_occ.export.render import pinhole
from openvocab_occ.geometry import Camera, look_at

CAMERAS = {
    "along the street": pinhole(97, 61, 1.0, look_at((-25, 1, 1.7), (10, 0, 1))),
    "straight down": pinhole(60, 60, 1.2, look_at((0, 0, 40), (0, 0, 0))),
    "inside a building": pinhole(40, 40, 1.5, look_at((4, -15, 5), (4, 0, 5))),
    "rolled and outside": pinhole(80, 50, 0.6, look_at((60, 40, 30), (0, 0, 0), up=(0.3, 0.4, 1))),
    "fisheye": Camera(np.array([[30.0, 0, 49.5], [0, 30, 49.5], [0, 0, 1]]), 100, 100, look_at((-5, 0, 2), (9, 3, 1)),
                      (0.02, -0.01, 0.002, 0.0), "fisheye"),
}  # fmt: skip


@pytest.fixture(scope="module")
def bundle(street, tmp_path_factory):
    return export_views(street, tmp_path_factory.mktemp("views") / "out", width=512, height=288)


@pytest.fixture(scope="module")
def view(bundle):
    return json.loads((bundle.folder / "view.json").read_text())
