"""Fixtures of every test: seeds, the real data beside the project, small scenes."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from openvocab_occ.objects import SceneMap

# same examples every time, and no deadline: a busy machine is no failure
settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")

DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of real data; the test is skipped where it is absent."""
    if not DATA.is_dir():
        pytest.skip("the real data (../shared/data) is not on this machine")
    return DATA.resolve()


@pytest.fixture(scope="session")
def keyframe(data: Path) -> Path:
    return data / "nuscenes_keyframe"


STREET_LABELS = ("road", "sidewalk", "building", "tree", "car", "truck", "person")
STREET_BOXES = (  # label, centre, size: metres
    ("road", (0, 0, -0.2), (60, 12, 0.4)),
    ("sidewalk", (0, 8, 0.2), (60, 4, 0.4)),
    ("sidewalk", (0, -8, 0.2), (60, 4, 0.4)),
    ("building", (-12, 15, 4), (30, 8, 8)),
    ("building", (18, 16, 6), (20, 8, 12)),
    ("building", (4, -15, 5), (48, 8, 10)),
    ("tree", (6, 9, 3.2), (3.2, 3.2, 3.2)),
    ("tree", (-14, -9, 3.2), (3.2, 3.2, 3.2)),
    ("car", (-8, 4, 0.8), (4.4, 2.0, 1.6)),
    ("car", (10, -4, 0.8), (4.4, 2.0, 1.6)),
    ("truck", (2, 4, 1.6), (7.6, 2.4, 3.2)),
    ("truck", (20, 4, 1.6), (7.6, 2.4, 3.2)),
    ("person", (-2, -7.2, 1.2), (0.8, 0.8, 1.6)),
)


@pytest.fixture(scope="session")
def street() -> "SceneMap":
    """A made-up street of boxes, in the classes of a `logits` encoder, driven through along x in three frames."""
    from openvocab_occ.geometry import Camera, pose
    from openvocab_occ.mapping import Lifted, VoxelMap
    from openvocab_occ.objects import EncoderInfo, KeyFrame, NamedCamera, Provenance, SceneMap, group_objects

    size, dim = 0.4, len(STREET_LABELS)
    label_of: dict[tuple[int, int, int], int] = {}
    for name, center, extent in STREET_BOXES:
        low = np.round((np.array(center) - np.array(extent) / 2) / size).astype(int)
        count = np.maximum(np.round(np.array(extent) / size).astype(int), 1)
        cells = np.array(list(np.ndindex(*count)))
        for cell in cells[((cells == 0) | (cells == count - 1)).any(axis=1)]:  # cameras see surfaces
            label_of[tuple((low + cell).tolist())] = STREET_LABELS.index(name)
    keys = np.array(list(label_of), np.int32)
    labels = np.array(list(label_of.values()))
    random = np.random.default_rng(7)
    ones = np.ones(len(keys), np.float32)
    sums = np.full((len(keys), dim), 0.1 / (dim - 1), np.float32)
    sums[np.arange(len(keys)), labels] = 0.9 - 0.02 * labels
    sums /= sums.sum(axis=1, keepdims=True)
    base = np.array([(70, 72, 78), (150, 146, 140), (165, 120, 95), (60, 110, 55), (40, 60, 120), (200, 190, 180),
                     (160, 60, 60)])  # fmt: skip
    colors = (base[labels] + random.integers(-12, 13, (len(keys), 1))).astype(np.float32)
    voxels = VoxelMap(size, dim, contract="logits")
    voxels.integrate(keys, Lifted(sums, ones, ones.astype(np.int32), colors), time=1.0)
    mount = np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]])  # T_ego_cam, looking forward
    K = np.array([[1266.0, 0, 799.5], [0, 1266.0, 449.5], [0, 0, 1]])
    egos = [pose((x, -2, 0)) for x in (-28.0, -20.0, -12.0)]
    cameras = [NamedCamera.of(Camera(K, 1600, 900, ego @ mount), "CAM_FRONT") for ego in egos]
    frames = tuple(KeyFrame(i, float(i), egos[i], (cameras[i],)) for i in range(len(egos)))
    info = EncoderInfo(name="boxes", contract="logits", dim=dim, labels=STREET_LABELS, fingerprint="0" * 64)
    made = Provenance(source="boxes", name="street", synthetic=True)
    return SceneMap(voxels, group_objects(voxels, labels=STREET_LABELS), info, frames, made)
