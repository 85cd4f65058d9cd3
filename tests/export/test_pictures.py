"""Pictures drawn from the map: exact ids, shading, holes, panoramas, and the map from above."""

import dataclasses

import numpy as np
import pytest

from openvocab_occ.depth.render import render_depth
from openvocab_occ.errors import ConfigError
from openvocab_occ.export import draw
from openvocab_occ.export._shade_reference import shade_reference
from openvocab_occ.export.overhead import CEILING, Extent, render_overhead
from openvocab_occ.export.render import Renderer, pinhole, render_map
from openvocab_occ.export.surface import surface_of
from openvocab_occ.export.views.marks import innermost, place_tags, tag_size
from openvocab_occ.geometry import Camera, look_at, pose, transform
from openvocab_occ.objects import ObjectTree

CAMERA = pinhole(160, 90, 0.9, look_at((-25, 1, 1.7), (10, 0, 1)))


@pytest.mark.parametrize("camera", [
    CAMERA, pinhole(60, 60, 1.2, look_at((0, 0, 40), (0, 0, 0))), pinhole(40, 40, 1.5, look_at((4, -15, 5), (4, 0, 5))),
    Camera(np.array([[30.0, 0, 49.5], [0, 30, 49.5], [0, 0, 1]]), 100, 100, look_at((-5, 0, 2), (9, 3, 1)),
           (0.02, -0.01, 0.002, 0.0), "fisheye"),
])  # fmt: skip
def test_the_kernel_shades_as_the_reference(street, camera):
    view = render_map(street, camera, 60.0)
    surface = view.surface
    rays = camera.rays() @ camera.T_world_cam[:3, :3].T
    expected = shade_reference(
        rays, camera.position, view.depth, view.voxel, surface.centers32, surface.palette, draw.SKY, draw._SHADES,
        draw._HAZE,
    )  # fmt: skip
    drawn = draw.shaded(view, surface.palette)
    differs = (drawn != expected).any(axis=-1)
    assert differs.mean() < 0.002  # on edges of voxels two faces are as near
    assert (drawn[view.voxel < 0] == draw.SKY).all()


def test_shading_tells_faces_apart_and_distance_pales(street):
    view = render_map(street, CAMERA)
    picture = draw.shaded(view, view.surface.palette).astype(int)
    road = street.voxels.features[np.maximum(view.voxel, 0)].argmax(-1) == 0
    road &= view.voxel >= 0
    near, far = road & (view.depth < 8), road & (view.depth > 30)
    sky = np.array(draw.SKY)
    assert np.abs(picture[far].mean(axis=0) - sky).sum() < np.abs(picture[near].mean(axis=0) - sky).sum()


def test_windows_of_a_large_map_show_what_the_whole_shows(street, monkeypatch):
    from openvocab_occ.export import render

    whole = Renderer(street).view(CAMERA, 50.0)
    monkeypatch.setattr(render, "_WHOLE", 1000)
    cut = Renderer(street)
    for _ in range(2):
        seen = cut.view(CAMERA, 50.0)
        assert (seen.voxel == whole.voxel).mean() > 0.9995
        assert np.abs(seen.depth - whole.depth)[seen.voxel == whole.voxel].max() < 1e-3
    away = cut.view(pinhole(32, 32, 1.0, look_at((0, 0, 500), (0, 0, 900))))
    assert (away.voxel == -1).all()


def test_holes_of_one_voxel_are_filled_for_display_only(street):
    keys = street.voxels.keys
    road = np.flatnonzero((np.abs(keys[:, :2] - [10, 0]) <= 3).all(axis=1) & (keys[:, 2] < 0))
    centre = road[(keys[road, :2] == [10, 0]).all(axis=1)]
    assert len(centre) == 1
    kept = np.ones(len(keys), bool)
    kept[centre] = False
    bare = ObjectTree([dataclasses.replace(street.objects.root, children=())])
    holed = dataclasses.replace(street, voxels=street.voxels.subset(kept), objects=bare)
    down = pinhole(31, 31, 0.1, look_at((4.2, 0.2, 20), (4.2, 0.2, 0)))
    exact, filled = Renderer(holed).view(down), Renderer(holed, filled=True).view(down)
    assert exact.voxel[15, 15] == -1
    assert filled.voxel[15, 15] >= 0
    assert (filled.voxel >= 0).all()
    beside = holed.voxels.keys[filled.voxel[15, 15]]
    assert np.abs(beside - [10, 0, beside[2]]).sum() == 1
    same = exact.voxel >= 0
    assert (filled.voxel[same] == exact.voxel[same]).all()


def test_a_panorama_agrees_with_cameras(street):
    renderer = Renderer(street)
    eye = np.array([-10.0, 0.0, 1.7])
    around = renderer.panorama(eye, 0.3, width=720, elevation=(-0.5, 0.5), max_range=80.0)
    height, width = around.voxel.shape
    assert width == 720
    for heading in (0.3, 0.3 + np.pi / 2, 0.3 - 2.0):
        camera = pinhole(41, 41, 0.3, look_at(eye, eye + np.array([np.cos(heading), np.sin(heading), 0])))
        view = renderer.view(camera, 80.0)
        rays = transform(camera.T_world_cam, camera.rays()) - eye
        azimuth, rise = np.arctan2(rays[..., 1], rays[..., 0]), np.arcsin(rays[..., 2] / np.linalg.norm(rays, axis=-1))
        u = ((np.pi - (azimuth - 0.3)) % (2 * np.pi) / (2 * np.pi) * width - 0.5).round().astype(int) % width
        v = ((0.5 - rise) / 1.0 * height - 0.5).round().astype(int)
        distance = view.depth * np.linalg.norm(camera.rays(), axis=-1)
        hit = (view.voxel >= 0) & (around.voxel[v, u] >= 0)
        assert (around.item[v, u] == view.item).mean() > 0.9
        assert np.median(np.abs(around.distance[v, u] - distance)[hit]) < 0.1


def test_from_above_ahead_is_up_and_left_is_left(street):
    surface = surface_of(street)
    T = pose((-10.0, -2.0, 0.0), (np.cos(0.2), 0, 0, np.sin(0.2)))
    extent = Extent(50.0, 10.0, 30.0, 0.1)
    seen = render_overhead(street, surface, T, extent, ground=0.0)
    assert seen.voxel.shape == extent.shape == (600, 600)
    low = surface.keys[:, 2] < round(CEILING / 0.4)
    for x, y in ((20.0, 0.0), (5.0, 6.0), (30.0, -8.0), (-4.0, 2.0)):
        u, v = np.round(seen.ego_pixels(np.array([[x, y]]))[0]).astype(int)
        assert (u < 300) == (y > 0) or y == 0
        assert (v < 500) == (x > 0)
        place = transform(T, np.array([[extent.ahead - (v + 0.5) * 0.1, extent.side - (u + 0.5) * 0.1, 0.0]]))[0]
        column = (np.floor(place[:2] / 0.4).astype(int) == surface.keys[:, :2]).all(axis=1) & low
        expected = np.flatnonzero(column)
        top = expected[surface.keys[expected, 2].argmax()] if len(expected) else -1
        assert seen.voxel[v, u] == top
    assert not seen.seen.all()
    assert seen.seen[seen.voxel >= 0].all()


def test_what_moves_is_drawn_where_it_was_last_seen(street):
    """An object that has points and no voxels stands in no picture of the map alone, but in ours."""
    truck = next(item for item in street.objects if item.label == "truck")
    points = np.array([[-15.0 + 0.4 * i + 0.2, -1.0 + 0.4 * j + 0.2, 0.2 + 0.4 * k]
                       for i, j, k in np.ndindex(5, 4, 4)], np.float32)  # fmt: skip
    mover = dataclasses.replace(truck, id=77, state="moving", voxels=np.empty(0, np.int64), points=points)
    root = street.objects.root
    nodes = [dataclasses.replace(root, children=(*root.children, 77)), *street.objects.nodes[1:], mover]
    scene = dataclasses.replace(street, objects=ObjectTree(nodes))
    view = render_map(scene, CAMERA)
    assert (view.item == 77).sum() > 50
    assert (view.voxel[view.item == 77] >= len(scene.voxels)).all()
    assert not (render_map(street, CAMERA).item == 77).any()
    surface = view.surface
    assert surface.names[surface.label[view.voxel[view.item == 77]][0]] == "truck"
    # and hides what is behind it
    behind = view.item == 77
    assert (view.depth[behind] <= render_map(street, CAMERA).depth[behind] + 1e-6).all()


def test_depth_is_render_depth_of_the_same_grid(street):
    renderer = Renderer(street)
    view = renderer.view(CAMERA, 60.0)
    window = renderer._window
    image = render_depth(window.grid, CAMERA, max_depth=60.0)
    np.testing.assert_array_equal(view.depth, image.depth)
    np.testing.assert_array_equal(view.voxel, np.where(image.voxel >= 0, window.row[image.voxel], -1))


def test_tags_find_room_in_a_crowd(rng):
    areas = np.zeros((300, 500), np.int32)
    anchors = {}
    for mark in range(1, 21):
        u, v = rng.integers(200, 300), rng.integers(120, 180)
        areas[v - 4 : v + 5, u - 6 : u + 7] = mark
        anchors[mark] = (float(u), float(v))
    tags = place_tags(areas.shape, anchors, areas)
    assert [tag.mark for tag in tags] == list(anchors)
    cover = np.zeros(areas.shape, int)
    for tag in tags:
        left, top, right, bottom = tag.box
        assert (right - left + 1, bottom - top + 1) == tag_size(tag.mark)
        cover[top : bottom + 1, left : right + 1] += 1
    assert cover.max() == 1
    assert all(tag.leader for tag in tags)


def test_a_tag_lies_on_an_object_that_has_room_for_it():
    areas = np.zeros((200, 300), np.int32)
    areas[20:180, 40:200] = 1
    u, v, inner = innermost(areas == 1)
    assert inner > 70
    (tag,) = place_tags(areas.shape, {1: (float(u), float(v))}, areas)
    assert not tag.leader
    assert (areas[tag.box[1] : tag.box[3], tag.box[0] : tag.box[2]] == 1).all()


def test_there_may_be_no_room_at_all():
    assert place_tags((12, 12), {1: (5.0, 5.0)}, np.ones((12, 12), np.int32)) == []


@pytest.mark.gpu
def test_a_gpu_draws_the_same(street):
    import torch

    if not torch.cuda.is_available():
        with pytest.raises(ConfigError, match="torch cannot use this device: .*got cuda"):
            Renderer(street, device="cuda").view(CAMERA, 50.0)
        return
    one, other = Renderer(street).view(CAMERA, 50.0), Renderer(street, device="cuda").view(CAMERA, 50.0)
    assert (one.voxel == other.voxel).mean() > 0.999
