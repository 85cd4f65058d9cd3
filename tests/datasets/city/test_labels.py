"""Occupancy is where surfaces are, masks are what was seen, the oracle errs as it says."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openvocab_occ.datasets.city import LABELS
from openvocab_occ.datasets.city import keyframes as k
from openvocab_occ.datasets.city._voxels_reference import areas_reference
from openvocab_occ.datasets.city.mesh import Builder
from openvocab_occ.datasets.city.oracle import NOISE, perceive
from openvocab_occ.datasets.city.scene import Triangles, gather
from openvocab_occ.datasets.city.surfaces import DARK, Part
from openvocab_occ.datasets.city.things import Thing
from openvocab_occ.datasets.city.voxels import WEIGHT, voxelise
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import GridSpec, pose, transform
from openvocab_occ.occupancy import OCC3D_FREE

GRID = GridSpec((0.0, 0.0, 0.0), 1.0, (8, 8, 8))


@pytest.fixture(scope="module")
def truth(drive, instant):
    return k.labels(drive, 8, instant)


def soup(corners: np.ndarray, labels: np.ndarray) -> Triangles:
    n = len(corners)
    zeros = np.zeros(n, np.uint8)
    return Triangles(corners.reshape(-1, 3).astype(np.float32), np.arange(3 * n, dtype=np.uint32).reshape(-1, 3),
                     np.zeros((n, 3, 2), np.float32), np.zeros((n, 3), np.float32), zeros, zeros,
                     labels.astype(np.uint8), np.arange(1, n + 1, dtype=np.int32), np.zeros(n, np.bool_))  # fmt: skip


@given(st.integers(0, 2**31), st.sampled_from([0.3, 2.0, 9.0, 25.0]))
def test_labels_follow_areas(seed, scale):
    """Where the reference finds a clear winner the voxel has its class; where it finds nothing, it is free."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(0, 8, (6, 1, 3)) + rng.normal(0, scale, (6, 3, 3))
    if seed % 3 == 0:
        corners[..., 2] = np.round(corners[..., 2])  # on faces of voxels
    corners = corners.astype(np.float32).astype(float)
    labels = rng.integers(0, 17, 6)
    found = voxelise(soup(corners, labels), np.eye(4), GRID).semantics
    area = areas_reference(corners, labels, (8, 8, 8, 17), 60_000 if scale > 5 else 6_000)
    assert (area.sum(-1) > 0)[found != OCC3D_FREE].mean() > 0.97 if (found != OCC3D_FREE).any() else True
    order = np.sort(area * WEIGHT, axis=-1)
    clear = (order[..., -1] > 1.5 * order[..., -2]) & (area.sum(-1) > 0.35)
    if clear.any():
        assert (found == (area * WEIGHT).argmax(-1))[clear].mean() > 0.97


def test_inside_of_closed_things_matches_open3d():
    """Cars are filled: voxel centres inside the meshes by Open3D's parity count, and no others."""
    import open3d as o3d

    b = Builder()
    b.box((1.2, 6.9), (1.1, 6.3), (0.7, 5.2), DARK, Part.BODY)
    b.ball((4, 4, 5), (2.2, 2.4, 2.1), DARK, Part.BODY, level=3)
    b.tube((1, 1, 1), (7, 6, 6.5), 0.8, DARK, Part.BODY)
    mesh = b.mesh()
    car = Thing(id=5, kind="car", label=LABELS["car"], mesh=mesh, position=(0.0, 0.0, 0.0))
    table = gather([car], [np.eye(4)], np.zeros(3), cull=False)
    spec = GridSpec((0.0, 0.0, 0.0), 0.25, (32, 32, 32))
    found = voxelise(table, np.eye(4), spec)
    inside = np.zeros(spec.shape, np.bool_)
    centers = spec.centers(spec.unflat(np.arange(spec.num_voxels))).astype(np.float32)
    for name in range(3):  # one closed surface at a time, as parity asks
        part = Builder()
        (lambda p: (p.box((1.2, 6.9), (1.1, 6.3), (0.7, 5.2), DARK, Part.BODY) if name == 0 else
                    p.ball((4, 4, 5), (2.2, 2.4, 2.1), DARK, Part.BODY, level=3) if name == 1 else
                    p.tube((1, 1, 1), (7, 6, 6.5), 0.8, DARK, Part.BODY)))(part)  # fmt: skip
        m = part.mesh()
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(o3d.core.Tensor(m.vertices.astype(np.float32)), o3d.core.Tensor(m.faces.astype(np.uint32)))
        inside |= scene.compute_occupancy(o3d.core.Tensor(centers)).numpy().reshape(spec.shape) > 0.5
    assert (found.semantics == LABELS["car"])[inside].mean() > 0.999
    assert (found.instances == 5)[found.semantics == LABELS["car"]].all()
    surface = areas_reference(mesh.vertices[mesh.faces] / 0.25, np.zeros(len(mesh.faces), int), (32, 32, 32, 1), 3_000)
    assert (inside | (surface[..., 0] > 0))[found.semantics == LABELS["car"]].mean() > 0.99


def test_surfaces_are_occupied(drive, instant, truth):
    """The voxel that holds the surface point behind a pixel is occupied, and nearly always with the pixel's class."""
    spec, labels = truth.grid.spec, truth.grid.labels
    occupied, same, vehicle = [], [], []
    for name, camera, time in drive.cameras(8, (352, 128)):
        if name == "CAM_BACK_LEFT":  # fires with the LiDAR, but for a millisecond
            picture = drive.render(camera, time, instant=instant, smooth=False)
            rays = camera.rays() * (picture.depth + 0.01)[..., None]
            local = transform(
                np.linalg.inv(truth.grid.T_world_grid), transform(camera.T_world_cam, rays.reshape(-1, 3))
            )
            flat = spec.flat(spec.index(local))
            seen = (flat >= 0) & (picture.semantic.reshape(-1) != 255)
            at = labels.reshape(-1)[flat[seen]]
            occupied.append(at != OCC3D_FREE)
            same.append(at == picture.semantic.reshape(-1)[seen])
            vehicle.append(picture.semantic.reshape(-1)[seen])
    assert np.concatenate(occupied).mean() > 0.995
    assert np.concatenate(same).mean() > 0.95


def test_lidar_hits_are_known_and_occupied(drive, instant, truth):
    scan = k.sweep(drive, 8, instant)
    local = transform(k.T_EGO_LIDAR, scan.points)
    flat = truth.grid.spec.flat(truth.grid.spec.index(local))
    inside = flat >= 0
    assert (truth.grid.labels.reshape(-1)[flat[inside]] != OCC3D_FREE).mean() > 0.93
    assert truth.mask_lidar.reshape(-1)[flat[inside]].mean() > 0.8
    assert (truth.mask_camera <= truth.mask_lidar).all()
    assert truth.mask_camera.mean() < truth.mask_lidar.mean() < 0.9


def test_instances_have_the_class_of_their_voxel(drive, truth):
    attributes = drive.attributes()
    assert ((truth.instances > 0) == (truth.grid.labels != OCC3D_FREE)).all()
    right = total = 0
    for number in np.unique(truth.instances[truth.instances > 0]):
        own = truth.grid.labels[truth.instances == number]
        right, total = right + (own == attributes[number].label).sum(), total + len(own)
    assert right / total > 0.97


def test_boxes_hold_their_voxels(drive, truth):
    """Voxels of a parked vehicle lie in its box, but for the half voxel that a cell may stick out."""
    centers = truth.grid.spec.centers(np.argwhere(truth.instances >= 100_000))
    owners = truth.instances[truth.instances >= 100_000]
    world = transform(truth.grid.T_world_grid, centers)
    checked = 0
    for box in k.boxes(drive, 8):
        own = world[owners == box.id] - np.array(box.center)
        if len(own) > 20:
            c, s = np.cos(box.yaw), np.sin(box.yaw)
            local = np.abs(own @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]))
            assert (local <= np.array(box.size) / 2 + 0.3).all(axis=1).mean() > 0.98
            checked += 1
    assert checked > 5


def test_a_turned_grid_sees_the_same_world(drive, instant):
    """Labels at a turned pose agree with the untouched ones away from the edges of things."""
    straight = voxelise(instant.triangles, pose((0.0, 0.0, 0.0)))
    quarter = voxelise(instant.triangles, pose((0.0, 0.0, 0.0), (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))))
    turned = np.rot90(straight.semantics, 1, axes=(0, 1))
    assert (turned == quarter.semantics).mean() > 0.995


@pytest.mark.parametrize("condition", NOISE)
def test_oracle_is_right_near_and_wrong_far(truth, condition):
    seen = perceive(truth, condition, seed=3)
    x, y = np.meshgrid(*[np.arange(200) * 0.4 - 39.8] * 2, indexing="ij")
    distance = np.broadcast_to(np.hypot(x, y)[..., None], seen.labels.shape)
    occupied = truth.grid.labels != OCC3D_FREE
    right = seen.labels == truth.grid.labels
    near, far = (right[occupied & ring & truth.mask_camera].mean() for ring in (distance < 12, distance > 30))
    hidden = right[occupied & (distance < 12) & ~truth.mask_camera].mean()
    assert near > far + 0.1
    assert near > hidden + 0.2
    assert near == pytest.approx(0.97 * NOISE[condition].reach * np.exp(-((8 / NOISE[condition].far) ** 2)), abs=0.06)
    assert seen.logits is not None
    best = np.sort(seen.logits[::5, ::5], axis=-1)
    confident = best[..., -1] - best[..., -2]
    assert confident[right[::5, ::5]].mean() > confident[~right[::5, ::5]].mean()


def test_oracle_repeats_itself(truth):
    seen = perceive(truth, "clear", seed=3)
    np.testing.assert_array_equal(seen.logits, perceive(truth, "clear", seed=3).logits)
    assert not np.array_equal(seen.labels, perceive(truth, "clear", seed=4).labels)


def test_oracle_refuses_what_it_does_not_know(truth):
    with pytest.raises(ConfigError, match="condition is not known: expected clear"):
        perceive(truth, "hail")
