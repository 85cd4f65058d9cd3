import numpy as np
import pytest

from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.depth.render import render_depth
from openvocab_occ.errors import ConfigError, DataError, ModelError, ShapeError
from openvocab_occ.geometry import Camera, GridSpec, look_at, pose, transform
from openvocab_occ.mapping import PixelWeights
from openvocab_occ.objects import SceneMap
from openvocab_occ.objects.sightings import best_sightings
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.pipeline import MapBuilder, build_map
from openvocab_occ.query.find import find
from openvocab_occ.segmentation.encoder import FeatureMap, PixelEncoder

RED, GREEN = np.array([200, 30, 30], np.uint8), np.array([30, 200, 30], np.uint8)
LEFT, RIGHT = 4, 10  # occupancy classes of the two halves of the wall
T_WORLD_GRID = pose(np.array([20.0, 8.0, 2.0]))


class ByColor:
    """A user's own encoder: red is `truck`, green is `tree`, at a quarter of the resolution."""

    name, contract, dim, labels, fingerprint, text = "by-color", "logits", 2, ("truck", "tree"), "c" * 64, None

    def encode(self, images):
        maps = []
        for image in images:
            h, w = image.shape[0] // 4, image.shape[1] // 4
            mean = image.reshape(h, 4, w, 4, 3).mean(axis=(1, 3))
            red = mean[..., 0] > mean[..., 1]
            cells = np.stack([red, ~red], axis=-1).astype(np.float32)
            maps.append(FeatureMap(cells, (0.25, 0.25), (-0.375, -0.375)))
        return maps


def wall_grid():
    """A wall of 0.5 m voxels, 6 m ahead along x of the grid: its left half one class, its right half another."""
    labels = np.full((16, 16, 16), 17, np.uint8)
    labels[12, 8:] = LEFT  # y to the left
    labels[12, :8] = RIGHT
    return OccupancyGrid(labels, GridSpec((0.0, -4.0, -4.0), 0.5, labels.shape), T_WORLD_GRID)


def wall_camera():
    T = T_WORLD_GRID @ look_at(np.array([0.2, 0.0, 0.0]), np.array([6.0, 0.0, 0.0]))
    return Camera(np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]), 64, 48, T)


def wall_frame(index=0, *, occupancy=True, depth=None, points=None, poses=None):
    image = np.empty((48, 64, 3), np.uint8)
    image[:, :32], image[:, 32:] = RED, GREEN
    views = (View(image, wall_camera(), depth=depth, name="FRONT"),)
    return Frame(index, 0.5 * index, T_WORLD_GRID, views, wall_grid() if occupancy else None, points, poses=poses or {})


def sequence(*frames):
    return FrameSequence("wall", range(len(frames)), lambda i: frames[i])


def wall_x(scene):
    """Distance of the voxels from the grid's origin along the drive."""
    return scene.voxels.centers[:, 0] - T_WORLD_GRID[0, 3]


def test_the_double_is_an_encoder():
    assert isinstance(ByColor(), PixelEncoder)


def test_voxels_get_the_words_and_classes_of_their_side_of_the_wall():
    scene = build_map(sequence(wall_frame(0), wall_frame(1)), ByColor(), weights=PixelWeights.none())
    np.testing.assert_allclose(wall_x(scene), 6.25)
    left = scene.voxels.centers[:, 1] > T_WORLD_GRID[1, 3]
    assert left.any()
    assert (~left).any()
    np.testing.assert_array_equal(scene.voxels.labels, np.where(left, LEFT, RIGHT))
    np.testing.assert_array_equal(scene.voxels.features.argmax(1), np.where(left, 0, 1))
    np.testing.assert_allclose(scene.voxels.features.sum(1), 1, rtol=1e-5)
    inner = np.abs(scene.voxels.centers[:, 1] - T_WORLD_GRID[1, 3]) > 0.5
    np.testing.assert_array_equal(scene.voxels.colors[left & inner], np.tile(RED, ((left & inner).sum(), 1)))
    assert (scene.voxels.count == 2).all()
    assert scene.voxels.weight.sum() == pytest.approx(2 * (render_depth(wall_grid(), wall_camera()).voxel >= 0).sum())
    assert (scene.voxels.voxel_size, scene.voxels.first_seen.max(), scene.voxels.last_seen.min()) == (0.5, 0.0, 0.5)


def test_the_map_answers_and_remembers_its_frames(tmp_path):
    scene = build_map(sequence(wall_frame()), ByColor())
    answer = find(scene, "trucks")
    assert answer.verdict == "found"
    assert answer.hits[0].object.center[1] > T_WORLD_GRID[1, 3]
    opened = SceneMap.open(scene.save(tmp_path / "wall.ovmap"))
    again = find(opened, "trucks")
    assert [(h.object.id, h.score) for h in again.hits] == [(h.object.id, h.score) for h in answer.hits]
    assert [camera.name for camera in opened.frames[0].cameras] == ["FRONT"]
    assert (opened.provenance.name, opened.provenance.synthetic) == ("wall", False)
    assert opened.provenance.options["voxel_size"] == 0.5


def test_everything_knows_its_best_views(tmp_path):
    scene = build_map(sequence(wall_frame(0), wall_frame(1)), ByColor())
    opened = SceneMap.open(scene.save(tmp_path / "wall.ovmap"))
    held = [node for node in scene.objects.nodes if len(node.voxels)]
    assert held
    for node in held:
        assert {view.view for view in node.views} == {"FRONT"}
        assert [view.score for view in node.views] == sorted((view.score for view in node.views), reverse=True)
        assert opened.objects[node.id].views == node.views
        pixels, _ = wall_camera().project(scene.voxels.centers[node.voxels])
        for view in node.views:
            low, high = np.array(view.box[:2]), np.array(view.box[2:])
            assert ((pixels > low - 6) & (pixels < high + 6)).all()  # a voxel of 0.5 m is 5 pixels wide there


def test_views_of_voxels_are_those_that_weigh_most():
    scene = build_map(sequence(wall_frame(0), wall_frame(1)), ByColor())
    members = np.arange(len(scene.voxels))
    frames = {frame.index: frame for frame in scene.frames}
    (best,) = best_sightings(scene.voxels, members, frames)  # of two equal views the first counts
    assert (best.frame, best.view) == (0, "FRONT")
    assert best.score == pytest.approx(scene.voxels.best_views(members)[3].sum(), rel=1e-5)
    boxes = scene.voxels.best_views(members)[2]
    assert best.box == (*boxes[:, :2].min(axis=0), *boxes[:, 2:].max(axis=0))
    assert best_sightings(scene.voxels, members, {}) == ()


def test_measured_depth_puts_the_wall_where_the_grid_has_it():
    by_grid = build_map(sequence(wall_frame()), ByColor())
    depth = render_depth(wall_grid(), wall_camera(), max_depth=30.0).depth
    depth = np.where(depth < 30, depth + np.float32(0.01), 0).astype(np.float32)  # 0: nothing measured
    by_depth = build_map(sequence(wall_frame(occupancy=False, depth=depth)), ByColor(), voxel_size=0.5)
    np.testing.assert_array_equal(by_depth.voxels.keys, by_grid.voxels.keys)
    np.testing.assert_allclose(by_depth.voxels.features, by_grid.voxels.features, atol=1e-5)
    assert (by_depth.voxels.labels == 255).all()
    fine = build_map(sequence(wall_frame(occupancy=False, depth=depth)), ByColor())
    assert fine.voxels.voxel_size == 0.1
    np.testing.assert_allclose(wall_x(fine), 6.05, atol=1e-6)


def test_lidar_points_stand_in_for_a_grid():
    y, z = np.meshgrid(np.arange(-3.9, 4, 0.1), np.arange(-0.9, 3.0, 0.1))
    points = np.stack([np.full(y.size, 6.1), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    lidar = T_WORLD_GRID @ pose(np.array([0.0, 0.0, 1.8]))
    scene = build_map(sequence(wall_frame(occupancy=False, points=points, poses={"lidar": lidar})), ByColor())
    assert scene.voxels.voxel_size == 0.4
    assert scene.class_names == ("occupied", "free")
    assert np.abs(wall_x(scene) - 6.1).max() <= 0.4
    left = transform(np.linalg.inv(T_WORLD_GRID), scene.voxels.centers)[:, 1]
    far = np.abs(left) > 0.6
    np.testing.assert_array_equal(scene.voxels.features.argmax(1)[far], np.where(left > 0, 0, 1)[far])


def test_a_snapshot_does_not_grow_and_progress_is_told():
    builder = MapBuilder(ByColor())
    with pytest.raises(DataError, match="there is no map yet"):
        builder.snapshot()
    builder.integrate(wall_frame(0))
    first = builder.snapshot()
    builder.integrate(wall_frame(1))
    assert (len(first.frames), len(builder.snapshot().frames)) == (1, 2)
    assert first.voxels.count.max() == 1
    told = []
    build_map(sequence(wall_frame(0), wall_frame(1)), ByColor(), progress=lambda *done: told.append(done))
    assert told == [(1, 2), (2, 2)]


class Failing(ByColor):
    """Gives NaN, another length or too few maps when told."""

    how = ""

    def encode(self, images):
        maps = super().encode(images)
        if self.how == "lost":
            return maps[1:]
        cells = maps[0].cells
        cells = {"nan": cells * np.float32(np.nan), "long": np.repeat(cells, 2, axis=2)}.get(self.how, cells)
        return [FeatureMap(cells, maps[0].scale, maps[0].offset)]


@pytest.mark.parametrize(
    ("how", "error", "message"),
    [
        ("nan", DataError, "not finite"),
        ("long", ShapeError, "output of encoder by-color"),
        ("lost", ModelError, "lost images"),
    ],
)
def test_a_frame_that_fails_leaves_the_builder_as_it_was(how, error, message):
    encoder = Failing()
    builder = MapBuilder(encoder)
    for seen in (0, 1):
        encoder.how = how
        with pytest.raises(error, match=message):
            builder.integrate(wall_frame(7))
        encoder.how = ""
        builder.integrate(wall_frame(seen))
        assert [frame.index for frame in builder.snapshot().frames] == list(range(seen + 1))
        assert builder.snapshot().voxels.count.max() == seen + 1


def test_input_without_geometry_is_told():
    with pytest.raises(DataError, match="sequence has no frames"):
        build_map(sequence(), ByColor())
    with pytest.raises(
        DataError, match=r"does not say where things are: expected occupancy, LiDAR points or measured.*PATTERN"
    ):
        build_map(sequence(wall_frame(occupancy=False)), ByColor())
    with pytest.raises(DataError, match="expected LiDAR points or measured depth in every view, got occupancy"):
        MapBuilder(ByColor(), grid_from="lidar").integrate(wall_frame())
    points = np.ones((1, 3), np.float32)
    with pytest.raises(DataError, match=r"expected the LiDAR's pose in poses\['lidar'\], got poses of nothing"):
        build_map(sequence(wall_frame(occupancy=False, points=points)), ByColor())
    with pytest.raises(DataError, match="frame 3 has no views"):
        MapBuilder(ByColor()).integrate(Frame(3, 0.0, np.eye(4), occupancy=wall_grid()))


def test_options_that_make_no_sense_are_told():
    with pytest.raises(ConfigError, match="max_depth is not usable"):
        MapBuilder(ByColor(), max_depth=0.0)
    with pytest.raises(ConfigError, match="voxel size is not usable"):
        MapBuilder(ByColor(), voxel_size=-1.0)
    flat = OccupancyGrid(np.zeros((2, 2, 2), np.uint8), GridSpec((0.0, 0.0, 0.0), (0.4, 0.4, 0.8), (2, 2, 2)))
    with pytest.raises(ConfigError, match=r"voxels are not cubes.*pass voxel_size"):
        MapBuilder(ByColor()).integrate(Frame(0, 0.0, np.eye(4), wall_frame().views, flat))


def test_grids_of_other_classes_are_told():
    builder = MapBuilder(ByColor())
    builder.integrate(wall_frame())
    grid = wall_grid()
    other = OccupancyGrid(
        (grid.labels == 17).astype(np.uint8), grid.spec, T_WORLD_GRID, 1, class_names=("occupied", "free")
    )
    with pytest.raises(DataError, match="has other classes than those before"):
        builder.integrate(Frame(1, 0.0, np.eye(4), wall_frame().views, other))
