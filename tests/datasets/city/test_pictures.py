"""Pictures, depth, instances, LiDAR and boxes tell of one and the same world."""

import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence
from openvocab_occ.datasets.city import CONDITIONS, LABELS, SKY, City
from openvocab_occ.datasets.city.keyframes import boxes, sweep
from openvocab_occ.datasets.city.sensors import RIG, T_EGO_LIDAR
from openvocab_occ.datasets.city.streets import draw_plan
from openvocab_occ.datasets.city.town import build_town
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import Camera, invert, transform

SIZE = (176, 64)


@pytest.fixture(scope="module")
def pictures(drive, instant):
    return [
        (name, camera, drive.render(camera, time, instant=instant)) for name, camera, time in drive.cameras(8, SIZE)
    ]


def test_a_camera_sees_the_same_twice(drive, instant, pictures):
    """Also from another city of the same seed, and whether or not cameras share their work."""
    again = City(7).traversal(0, 0)
    _, camera, time = again.cameras(8, SIZE)[1]
    found = again.render(camera, time, instant=again.instant(4.0, again.T_world_ego(4.0)[:3, 3]))
    for field in ("image", "depth", "semantic", "instance", "part"):
        np.testing.assert_array_equal(getattr(found, field), getattr(pictures[1][2], field), err_msg=field)
    alone = again.render(camera, time)
    assert (alone.instance == found.instance).mean() > 0.999
    rebuilt = build_town.__wrapped__(7)
    assert rebuilt is not again.town
    assert [(t.kind, t.position, t.yaw, t.exists) for t in rebuilt.things] == [
        (t.kind, t.position, t.yaw, t.exists) for t in again.town.things
    ]
    for a, b in zip(rebuilt.things[:4], again.town.things[:4], strict=True):
        np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)
    elsewhere = draw_plan(np.random.default_rng([8, 11]))
    assert elsewhere.bounds != again.town.plan.bounds


def test_pixels_agree_with_the_attributes(drive, pictures):
    attributes = drive.attributes()
    for _, _, picture in pictures:
        sky = picture.instance == 0
        assert ((picture.semantic == SKY) == sky).all()
        assert ((picture.depth == 0) == sky).all()
        for number in np.unique(picture.instance[~sky]):
            own = picture.instance == number
            assert set(np.unique(picture.semantic[own])) == {attributes[number].label}
            assert len(np.unique(picture.part[own])) <= len(attributes[number].parts)
    seen = {attributes[n].kind for _, _, p in pictures for n in np.unique(p.instance) if n}
    assert {"road", "sidewalk", "terrain", "tree"} <= seen


def test_depth_lands_on_things(drive, instant, pictures):
    """A pixel of a movable thing, taken back into the world by its depth, lies in the box of that thing."""
    by_id = {box.id: box for box in boxes(drive, 8)}
    checked = 0
    for name, camera, picture in pictures:
        delay = next(m.delay for m in RIG if m.name == name)
        for number, box in by_id.items():
            v, u = np.nonzero(picture.instance == number)
            if not len(u):
                continue
            rays = camera.unproject(np.stack([u, v], axis=1).astype(float)) * picture.depth[v, u, None]
            points = transform(camera.T_world_cam, rays) - box.center
            points[:, :2] -= np.array(box.velocity) * delay
            c, s = np.cos(box.yaw), np.sin(box.yaw)
            local = np.abs(points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]))
            assert (local < np.array(box.size) / 2 + 0.12).all(axis=1).mean() > 0.98, box
            checked += 1
    assert checked > 5


def test_ground_depth_is_exact(pictures):
    """Road pixels lie on the plane z = 0, by the geometry of the camera alone."""
    for _, camera, picture in pictures:
        v, u = np.nonzero(picture.semantic == LABELS["driveable surface"])
        rays = camera.unproject(np.stack([u, v], axis=1).astype(float))
        z = transform(camera.T_world_cam, rays * picture.depth[v, u, None])[:, 2]
        assert np.abs(z).max(initial=0.0) < 0.02
    assert sum((p.semantic == LABELS["driveable surface"]).sum() for _, _, p in pictures) > 5000


def test_cameras_fire_at_their_own_times(drive):
    times = [time for _, _, time in drive.cameras(3)]
    assert len(set(times)) == 6
    assert all(-0.05 < time - 1.5 <= 0 for time in times)
    for (_, camera, time), mount in zip(drive.cameras(3), RIG, strict=True):
        np.testing.assert_allclose(invert(drive.T_world_ego(time)) @ camera.T_world_cam, mount.T_ego_cam(), atol=1e-9)


def test_image_sizes_keep_the_view():
    """A smaller image is the full one scaled and cut: the same point is seen at the scaled pixel."""
    mount = RIG[1]
    full = mount.camera(1600, 900)
    small = mount.camera(704, 256)
    point = np.array([[0.3, 0.4, 5.0]])
    (u, v), (a, b) = full.project(point)[0][0], small.project(point)[0][0]
    assert a == pytest.approx((u + 0.5) * 0.44 - 0.5)
    assert b == pytest.approx((v + 0.5) * 0.44 - 0.5 - 140)


def test_lidar_lies_on_surfaces(drive, instant):
    """Each return, seen again from the LiDAR by rays of its own, is within the noise of a surface of its thing."""
    scan = sweep(drive, 8, instant)
    assert 25_000 < len(scan.points) < 34_753
    T = drive.T_world_ego(4.0) @ T_EGO_LIDAR
    range_ = np.linalg.norm(scan.points, axis=1)
    rays = np.empty((len(scan.points), 6), np.float32)
    rays[:, :3] = T[:3, 3] - instant.surroundings.origin
    rays[:, 3:] = (scan.points / range_[:, None]) @ T[:3, :3].T
    hits = instant.moment.cast(rays)
    error = hits.t - range_
    assert np.abs(error).max() < 0.12
    assert 0.015 < error.std() < 0.025
    assert (instant.triangles.instance[hits.face] == scan.instances).mean() > 0.999
    world = transform(T, scan.points)
    road = np.isin(instant.triangles.label[hits.face], [LABELS["driveable surface"]])
    assert np.abs(world[road, 2]).max() < 0.1


@pytest.mark.parametrize("condition", CONDITIONS)
def test_conditions_change_the_picture_not_the_truth(city, drive, condition):
    camera = Camera(
        np.array([[90.0, 0, 63.5], [0, 90.0, 23.5], [0, 0, 1]]), 128, 48, drive.cameras(0)[0][1].T_world_cam
    )
    clear = city.render(camera, 0.0)
    other = city.render(camera, 0.0, condition)
    still = (clear.instance < 1_000_000) & (other.instance < 1_000_000)
    np.testing.assert_array_equal(clear.depth[still], other.depth[still])
    if condition == "night":
        assert other.image.mean() < 0.5 * clear.image.mean()
    if condition == "fog":
        far = still & (clear.depth > 50)
        assert other.image[far].std() < 0.5 * clear.image[far].std()
    if condition == "heavy traffic":
        assert len(city.traversal(0, 0, condition).movers) > len(drive.movers) + 20


def test_sequence():
    sequence = load_sequence("city", seed=7, frames=3, size=SIZE, condition="rain", traversal=1)
    assert (len(sequence), sequence.name, sequence.source, sequence.synthetic) == (3, "city-7-r0-t1", "city", True)
    frame = sequence[1]
    assert [view.image.shape for view in frame.views] == [(64, 176, 3)] * 6
    assert frame.points is not None
    assert frame.occupancy is not None
    np.testing.assert_array_equal(frame.occupancy.T_world_grid, frame.T_world_ego)
    np.testing.assert_allclose(frame.poses["lidar"], frame.T_world_ego @ T_EGO_LIDAR)
    index = frame.occupancy.spec.index(frame.points.astype(float))
    inside = frame.occupancy.spec.contains(index)
    flat = frame.occupancy.spec.flat(index)[inside]
    assert frame.occupancy.occupied.reshape(-1)[flat].mean() > 0.75  # where LiDAR returns from, something is


def test_bad_options(tmp_path):
    with pytest.raises(ConfigError, match="too short: expected 1 to 40 frames, got 50"):
        load_sequence("city", frames=50)
    with pytest.raises(ConfigError, match="city is made up from a seed"):
        load_sequence("city", tmp_path)
    with pytest.raises(ConfigError, match="image size is not usable"):
        load_sequence("city", size=(4, 4))
