"""View bundles: pictures and JSON that agree with each other, with the map and with geometry."""

import base64
import dataclasses
import json

import cv2
import jsonschema
import numpy as np
import pytest

from openvocab_occ.depth.render import render_depth
from openvocab_occ.errors import AlreadyExistsError, ConfigError, MapError
from openvocab_occ.export import ViewBundle, ViewOptions, export_views
from openvocab_occ.export.palette import NOTHING
from openvocab_occ.export.render import overview_camera, owners, pinhole, render_map
from openvocab_occ.export.semantics import name_voxels
from openvocab_occ.export.views import bundle as bundle_module
from openvocab_occ.export.views.contents import schema
from openvocab_occ.geometry import Camera, GridSpec, look_at, pose, transform
from openvocab_occ.io.images import read_depth, read_image
from openvocab_occ.mapping import VoxelMap
from openvocab_occ.objects import ObjectTree
from openvocab_occ.occupancy import GEOMETRY_CLASSES, OccupancyGrid
from openvocab_occ.query.find import find


@pytest.fixture(scope="module")
def bundle(street, tmp_path_factory):
    return export_views(street, tmp_path_factory.mktemp("views") / "out", width=512, height=288)


@pytest.fixture(scope="module")
def view(bundle):
    return json.loads((bundle.folder / "view.json").read_text())


def whole_grid(scene):
    """The map as one dense grid with nothing left out, and the map's position of each voxel."""
    keys = scene.voxels.keys.astype(np.int64)
    low, shape = keys.min(axis=0), np.ptp(keys, axis=0) + 1
    spec = GridSpec(tuple((low * 0.4).tolist()), 0.4, tuple(shape.tolist()))
    at = np.full(spec.num_voxels, -1)
    at[spec.flat(keys - low)] = np.arange(len(keys))
    labels = np.where(at >= 0, 0, 1).astype(np.uint8).reshape(spec.shape)
    return OccupancyGrid(labels, spec, free_label=1, class_names=GEOMETRY_CLASSES), at


CAMERAS = {
    "along the street": pinhole(97, 61, 1.0, look_at((-25, 1, 1.7), (10, 0, 1))),
    "straight down": pinhole(60, 60, 1.2, look_at((0, 0, 40), (0, 0, 0))),
    "inside a building": pinhole(40, 40, 1.5, look_at((4, -15, 5), (4, 0, 5))),
    "rolled and outside": pinhole(80, 50, 0.6, look_at((60, 40, 30), (0, 0, 0), up=(0.3, 0.4, 1))),
    "fisheye": Camera(np.array([[30.0, 0, 49.5], [0, 30, 49.5], [0, 0, 1]]), 100, 100, look_at((-5, 0, 2), (9, 3, 1)),
                      (0.02, -0.01, 0.002, 0.0), "fisheye"),
}  # fmt: skip


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_the_window_shows_what_the_whole_map_shows(street, camera):
    view = render_map(street, camera, max_depth=60.0)
    grid, at = whole_grid(street)
    truth = render_depth(grid, camera, max_depth=60.0)
    voxel = np.where(truth.voxel >= 0, at[truth.voxel], -1)
    assert (voxel >= 0).any()
    assert (view.voxel == voxel).mean() > 0.999  # rays along faces may fall to either side
    np.testing.assert_allclose(view.depth[view.voxel == voxel], truth.depth[view.voxel == voxel], atol=1e-3)
    assert (view.depth[view.voxel < 0] == 60.0).all()


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_points_at_their_depth_lie_on_their_voxels(street, camera):
    view = render_map(street, camera, max_depth=60.0)
    hit = view.voxel >= 0
    points = transform(camera.T_world_cam, (camera.rays() * view.depth[..., None])[hit])
    off = np.abs(points - street.voxels.centers[view.voxel[hit]]).max(axis=1)
    assert off.max() < 0.2 + 1e-3
    outside = view.depth[hit] > 0
    assert np.abs(off[outside] - 0.2).max() < 1e-3  # on a face, not within


def test_voxels_belong_to_the_smallest_object_that_holds_them(street):
    owner = owners(street)
    for item in street.objects:
        assert (owner[item.voxels] == item.id).all()
    whole = street.objects[1]
    few = {"voxels": whole.voxels[:5], "points": whole.points[:5]}
    inner = dataclasses.replace(whole, id=99, parent=1, label="door", **few)
    nodes = [dataclasses.replace(n, children=(99,)) if n.id == 1 else n for n in street.objects.nodes]
    nested = dataclasses.replace(street, objects=ObjectTree([*nodes, inner]))
    assert (owners(nested)[inner.voxels] == 99).all()


def test_json_and_pictures_agree(bundle, view):
    instance = read_depth(bundle.paths["instance.png"])
    assert set(np.unique(instance)) == {0, *(item["instance"] for item in view["objects"])}
    for item in view["objects"]:
        v, u = np.nonzero(instance == item["instance"])
        assert item["visible_px"] == len(u)
        assert item["bbox_2d"] == [u.min(), v.min(), u.max(), v.max()]
        assert item["bbox_amodal"] is None or item["bbox_amodal"][0] <= item["bbox_2d"][0] + 2
    assert [item["range_m"] for item in view["objects"]] == sorted(item["range_m"] for item in view["objects"])
    assert [item["instance"] for item in view["objects"]] == list(range(1, len(view["objects"]) + 1))


def test_the_palette_decodes_to_the_legend(bundle, view, street):
    image = read_image(bundle.paths["semantic.png"])
    colors, counts = np.unique(image.reshape(-1, 3), axis=0, return_counts=True)
    found = dict(zip(map(tuple, colors.tolist()), counts.tolist(), strict=True))
    nothing = found.pop(NOTHING)
    assert found == {tuple(entry["rgb"]): entry["visible_px"] for entry in view["legend"]}
    assert view["coverage"] == pytest.approx(1 - nothing / image[..., 0].size, abs=1e-4)
    label = {tuple(entry["rgb"]): entry["label"] for entry in view["legend"]}
    instance = read_depth(bundle.paths["instance.png"])
    for item in view["objects"]:
        rgb = image[instance == item["instance"]]
        assert {label[tuple(color)] for color in np.unique(rgb, axis=0).tolist()} == {item["label"]}


def test_objects_reproject_into_their_boxes_from_the_json_alone(view):
    """The point under each mark is where the mark is, and the centre of what is seen whole lies in its box."""
    camera = view["camera"]
    T, K = np.array(camera["T_world_cam"]), np.array(camera["K"])

    def pixel(point):
        x, y, z = (np.linalg.inv(T) @ [*point, 1.0])[:3]
        assert z > 0
        return (K @ [x / z, y / z, 1.0])[:2]

    def inside(uv, box):
        return box[0] - 1 <= uv[0] <= box[2] + 1 and box[1] - 1 <= uv[1] <= box[3] + 1

    marked = [item for item in view["objects"] if item["mark"]]
    assert len(marked) >= 6
    for item in marked:
        uv = pixel(item["point_world"])
        np.testing.assert_allclose(uv, item["mark_uv"], atol=0.01)
        assert inside(uv, item["bbox_2d"])
    whole = [item for item in marked if item["visible_fraction"] > 0.9 and not item["truncated"]]
    assert len(whole) >= 2
    for item in whole:
        assert inside(pixel(item["center_world"]), item["bbox_2d"])
        assert inside(pixel(item["center_world"]), item["bbox_amodal"])


def test_positions_against_the_ego(view, street):
    T = np.array(view["ego"]["T_world_ego"])
    np.testing.assert_allclose(T, street.frames[1].T_world_ego)  # of the middle keyframe
    assert view["camera"]["name"] == "CAM_FRONT"
    for item in view["objects"]:
        back = T @ [*item["center_ego"], 1.0]
        np.testing.assert_allclose(back[:3], item["center_world"], atol=1e-5)
        assert np.sign(item["bearing_deg"]) == np.sign(item["center_ego"][1])  # left is positive
        distance = np.linalg.norm(np.subtract(item["center_world"], T[:3, 3])[:2])
        assert item["range_m"] == pytest.approx(distance, abs=0.006)


def test_depth_is_that_of_the_camera_in_the_json(bundle, view, street):
    camera = Camera(np.array(view["camera"]["K"]), 512, 288, np.array(view["camera"]["T_world_cam"]))
    assert view["camera"]["pixel_center"] == "integer"
    rendered = render_map(street, camera)
    stored = read_depth(bundle.paths["depth.png"])
    assert ((stored == 0) == (rendered.voxel < 0)).mean() > 0.9999
    both = (stored > 0) & (rendered.voxel >= 0)
    off = np.abs(stored[both] / view["files"]["depth.png"]["scale"] - rendered.depth[both])
    assert np.quantile(off, 0.999) <= 0.5 / 256 + 1e-3


def test_the_camera_is_scaled_whole(bundle, view, street, tmp_path):
    original = street.frames[1].cameras[0]
    assert np.array(view["camera"]["K"])[0, 0] == pytest.approx(original.K[0, 0] * 512 / 1600)
    tall = export_views(street, tmp_path / "tall", width=320, height=1000).view["camera"]
    assert (tall["width"], tall["height"]) == (320, 180)
    assert read_image(tmp_path / "tall" / "view_clean.png").shape == (180, 320, 3)


def test_a_query_is_told_and_its_hits_come_first_and_are_gold(street, tmp_path):
    answer = find(street, "trucks")
    bundle = export_views(street, tmp_path / "asked", query=answer)
    told = bundle.view["query"]
    assert (told["text"], told["verdict"], told["threshold"], told["count"]) == ("trucks", "found", 0.5, 2)
    assert [hit["id"] for hit in told["hits"]] == [hit.object.id for hit in answer.hits]
    assert [hit["mark"] for hit in told["hits"]] == [1, 2]
    marked = {item["mark"]: item["label"] for item in bundle.view["objects"] if item["mark"]}
    assert [label for _, label in sorted(marked.items())[:3]].count("truck") == 2
    relevance = read_image(bundle.paths["relevance.png"]).astype(int)
    instance = read_depth(bundle.paths["instance.png"])
    colourful = np.ptp(relevance, axis=-1) > 40
    trucks = [item["instance"] for item in bundle.view["objects"] if item["label"] == "truck"]
    assert colourful[np.isin(instance, trucks)].mean() > 0.9
    assert not colourful[(instance > 0) & ~np.isin(instance, trucks)].any()
    by_words = export_views(street, tmp_path / "words", query="trucks")
    assert by_words.view["query"] == told
    near_first = export_views(street, tmp_path / "near", query=answer, options=ViewOptions(number_by="distance"))
    ranges = [i["range_m"] for i in sorted(near_first.view["objects"], key=lambda i: i["mark"] or 99) if i["mark"]]
    assert ranges == sorted(ranges)
    nothing = export_views(street, tmp_path / "none", width=64, height=64)
    assert nothing.view["query"] is None
    assert "relevance.png" not in nothing.view["files"]


def test_a_query_without_hits_marks_as_without_a_query(street, tmp_path):
    bundle = export_views(street, tmp_path / "nothing", query="buses")
    assert bundle.view["query"]["verdict"] in ("absent", "unobserved", "unknown words")
    assert bundle.view["query"]["hits"] == []
    ranges = [i["range_m"] for i in sorted(bundle.view["objects"], key=lambda i: i["mark"] or 99) if i["mark"]]
    assert len(ranges) > 3
    assert ranges == sorted(ranges)
    assert bundle.view["query"]["verdict"] in (bundle.folder / "prompt.md").read_text()


def test_provenance_says_synthetic(view):
    assert view["provenance"]["synthetic"] is True
    assert view["provenance"]["encoder"] == "boxes"
    assert view["schema"] == "openvocab_occ.view_bundle"
    assert view["version"] == 2


def test_a_given_camera_is_used_as_it_is(street, tmp_path):
    camera = CAMERAS["along the street"]
    view = export_views(street, tmp_path / "given", viewpoints=camera).view
    assert (view["camera"]["width"], view["camera"]["height"]) == (97, 61)
    np.testing.assert_allclose(view["camera"]["T_world_cam"], camera.T_world_cam, atol=1e-6)
    T = np.array(view["ego"]["T_world_ego"])
    np.testing.assert_allclose(T[:3, 3], camera.position, atol=1e-6)
    np.testing.assert_allclose(T[2, :3], [0, 0, 1], atol=1e-6)  # level
    down = export_views(street, tmp_path / "down", viewpoints=CAMERAS["straight down"]).view
    np.testing.assert_allclose(np.linalg.det(np.array(down["ego"]["T_world_ego"])[:3, :3]), 1.0)


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5])
def test_an_overview_has_everything_in_it(street, turn):
    T = pose((0, 0, 0), (np.cos(turn / 2), 0, 0, np.sin(turn / 2)))
    frames = tuple(dataclasses.replace(f, T_world_ego=T @ f.T_world_ego, cameras=()) for f in street.frames)
    camera = overview_camera(dataclasses.replace(street, frames=frames), 160, 90)
    pixels, depth = camera.project(street.voxels.centers)
    inside = (depth > 0) & camera.inside(pixels)
    assert inside.mean() > 0.97
    assert np.ptp(pixels[inside], axis=0).max() > 60  # and it is not far away either


def test_a_map_without_cameras_is_seen_from_above(street, tmp_path):
    bundle = export_views(dataclasses.replace(street, frames=()), tmp_path / "above", width=160, height=90)
    assert bundle.view["camera"]["name"] == "overview"
    assert bundle.view["coverage"] > 0.1
    assert {item["label"] for item in bundle.view["objects"]} >= {"road", "building", "truck", "car"}


def test_dense_maps_are_named_by_their_occupancy(street):
    labels = np.arange(len(street.voxels)) % 4
    labels[labels == 3] = 255
    voxels = VoxelMap.from_columns(
        0.4, street.voxels.keys, np.ones((len(labels), 2), np.float32) / np.sqrt(2).astype(np.float32),
        {**street.voxels.columns(), "labels": labels.astype(np.uint8)}, contract="dense",
    )  # fmt: skip
    encoder = dataclasses.replace(street.encoder, contract="dense", labels=(), dim=2)
    dense = dataclasses.replace(street, voxels=voxels, encoder=encoder, class_names=("a", "b"))
    semantics = name_voxels(dense)
    assert semantics.names == ("a", "b")
    assert semantics.labels.tolist() == [i % 4 if i % 4 < 2 else -1 for i in range(len(labels))]


def test_a_foreign_folder_is_left_alone_and_our_own_replaced(street, tmp_path):
    foreign = tmp_path / "precious"
    foreign.mkdir()
    (foreign / "thesis.tex").write_text("years of work")
    with pytest.raises(AlreadyExistsError, match=r"not ours to replace: expected a folder with view\.json"):
        export_views(street, foreign, width=32, height=32)
    assert [p.name for p in foreign.iterdir()] == ["thesis.tex"]
    ours = tmp_path / "ours"
    first = export_views(street, ours, width=32, height=32)
    (ours / "stale.png").write_bytes(b"")
    second = export_views(street, ours, width=32, height=32)
    there = {p.relative_to(ours).as_posix() for p in ours.rglob("*") if p.is_file()}
    assert there == set(second.paths)
    assert first.view == second.view


def test_a_failed_export_leaves_nothing(street, tmp_path, monkeypatch):
    def full(path, image):
        if path.name == "depth.png":
            raise OSError("no space left on device")

    monkeypatch.setattr(bundle_module, "write_image", full)
    with pytest.raises(OSError, match="no space"):
        export_views(street, tmp_path / "out", width=32, height=32)
    assert list(tmp_path.iterdir()) == []


def test_the_same_map_gives_the_same_bytes(street, bundle, tmp_path):
    again = export_views(street, tmp_path / "again", width=512, height=288)
    for name, path in again.paths.items():
        assert path.read_bytes() == bundle.paths[name].read_bytes()


@pytest.mark.parametrize("max_depth", [0.0, -1.0, 300.0, float("nan")])
def test_a_depth_that_does_not_fit_16_bits_is_refused(street, tmp_path, max_depth):
    with pytest.raises(ConfigError, match="max_depth does not fit a depth image: expected 0 to 256 m"):
        export_views(street, tmp_path / "out", options=ViewOptions(max_depth=max_depth))


def test_an_empty_map_and_tiny_pictures_are_refused(street, tmp_path):
    tree = ObjectTree([dataclasses.replace(street.objects.root, children=())])
    empty = dataclasses.replace(street, voxels=VoxelMap(0.4, 7, contract="logits"), objects=tree)
    with pytest.raises(MapError, match="no voxels to render"):
        export_views(empty, tmp_path / "out")
    with pytest.raises(ConfigError, match="at least 16 x 16 pixels, got 8 x 90"):
        export_views(street, tmp_path / "out", width=8, height=90)
    assert not (tmp_path / "out").exists()


def test_a_camera_that_looks_away_sees_nothing(street, tmp_path):
    away = pinhole(32, 32, 1.0, look_at((0, 0, 50), (0, 0, 100)))
    bundle = export_views(street, tmp_path / "away", viewpoints=away)
    jsonschema.Draft202012Validator(schema()).validate(bundle.view)
    assert bundle.view["objects"] == []
    assert bundle.view["coverage"] == 0
    assert cv2.imread(str(bundle.paths["semantic.png"])).max() == 0


def test_every_view_fits_the_published_schema(street, view, tmp_path):
    validator = jsonschema.Draft202012Validator(schema())
    jsonschema.Draft202012Validator.check_schema(schema())
    validator.validate(view)
    for name, options in {
        "asked": {"query": "trucks"}, "unknown": {"query": "zorgs"}, "away": {"viewpoints": CAMERAS["straight down"]},
        "fisheye": {"viewpoints": CAMERAS["fisheye"]}, "wall": {"viewpoints": CAMERAS["inside a building"]},
    }.items():  # fmt: skip
        validator.validate(json.loads(export_views(street, tmp_path / name, **options).paths["view.json"].read_text()))
    broken = {**view, "objects": [{**view["objects"][0], "bearing_deg": 400}]}
    assert not validator.is_valid(broken)


def test_marks_are_unique_and_the_same_in_both_pictures(street, tmp_path):
    for name, query in (("asked", "trucks"), ("plain", None)):
        view = export_views(street, tmp_path / name, query=query).view
        marks = sorted(item["mark"] for item in view["objects"] if item["mark"])
        assert marks == list(range(1, len(marks) + 1))
        for picture in ("view_marked.png", "bev_marked.png"):
            tags = view["pictures"][picture]
            assert sorted(tag["mark"] for tag in tags) == marks
            size = read_image(tmp_path / name / picture).shape
            boxes = np.array([tag["tag"] for tag in tags])
            assert (boxes >= 0).all()
            assert (boxes[:, 2] < size[1]).all()
            assert (boxes[:, 3] < size[0]).all()
            for k, box in enumerate(boxes):  # no two touch
                apart = (boxes[:, 0] > box[2] + 1) | (boxes[:, 2] < box[0] - 1)
                apart |= (boxes[:, 1] > box[3] + 1) | (boxes[:, 3] < box[1] - 1)
                assert apart.sum() == len(boxes) - 1, (k, boxes)


def test_marks_point_at_their_objects_in_both_pictures(bundle, view, street):
    instance = read_depth(bundle.paths["instance.png"])
    by_mark = {item["mark"]: item for item in view["objects"] if item["mark"]}
    for tag in view["pictures"]["view_marked.png"]:
        u, v = np.round(tag["at"]).astype(int)
        assert instance[v, u] == by_mark[tag["mark"]]["instance"]
    bev = view["bev"]
    T = np.linalg.inv(np.array(bev["T_world_bev"]))
    for tag in view["pictures"]["bev_marked.png"]:
        x, y = (T @ [*by_mark[tag["mark"]]["point_world"], 1.0])[:2]
        u = (bev["y_range"][1] - y) / bev["metres_per_pixel"] - 0.5 + bev["margin_left_px"]
        v = (bev["x_range"][1] - x) / bev["metres_per_pixel"] - 0.5
        np.testing.assert_allclose(tag["at"], [u, v], atol=0.6)


def test_left_is_left(view):
    """Bearing, ego y, the side of the picture and the side of the picture from above agree."""
    middle = np.array(view["camera"]["K"])[0, 2]
    bev = {tag["mark"]: tag["at"][0] for tag in view["pictures"]["bev_marked.png"]}
    ego = view["bev"]["y_range"][1] / view["bev"]["metres_per_pixel"] + view["bev"]["margin_left_px"]
    sides = 0
    for item in view["objects"]:
        if item["mark"] and abs(item["bearing_deg"]) > 12 and not item["truncated"]:
            left = item["bearing_deg"] > 0
            assert left == (item["center_ego"][1] > 0) == (item["mark_uv"][0] < middle) == (bev[item["mark"]] < ego)
            sides += 1
    assert sides >= 2


def test_what_hides_an_object_is_told(view):
    by_id = {item["id"]: item for item in view["objects"]}
    hidden = [item for item in view["objects"] if item["occluded_by"]]
    assert hidden
    for item in hidden:
        assert item["visible_fraction"] < 1
        for other in item["occluded_by"]:
            assert by_id[other["id"]]["depth_m"] is None or by_id[other["id"]]["depth_m"] < item["range_m"] + 20
    free = [i for i in view["objects"] if i["mark"] and i["label"] == "person"]
    assert free[0]["visible_fraction"] == 1.0


def test_parts_can_be_left_out(street, tmp_path):
    full = export_views(street, tmp_path / "full")
    bare = export_views(street, tmp_path / "bare", options=ViewOptions(marks=False, bev=False, table=False))
    assert {"view_marked.png", "bev_marked.png"} <= set(full.paths)
    assert not {"view_marked.png", "bev_marked.png"} & set(bare.paths)
    text = (bare.folder / "prompt.md").read_text()
    assert "| mark |" not in text
    assert "from straight above" not in text
    sent = json.loads((bare.folder / "messages.json").read_text())[1]["content"]
    assert [part["type"] for part in sent].count("image_url") == 1
    sent = json.loads((full.folder / "messages.json").read_text())[1]["content"]
    pictures = [part["image_url"]["url"] for part in sent if part["type"] == "image_url"]
    assert len(pictures) == 2
    data = base64.b64decode(pictures[0].removeprefix("data:image/png;base64,"))
    assert data == (full.folder / "view_marked.png").read_bytes()


def test_several_viewpoints_make_a_folder_each(street, tmp_path):
    cameras = [CAMERAS["along the street"], CAMERAS["rolled and outside"]]
    bundles = export_views(street, tmp_path / "many", viewpoints=cameras)
    index = json.loads((tmp_path / "many" / "views.json").read_text())["views"]
    assert [tmp_path / "many" / entry["folder"] for entry in index] == [bundle.folder for bundle in bundles]
    for bundle in bundles:
        assert ViewBundle.open(bundle.folder).view == bundle.view
    with pytest.raises(ConfigError, match="there is no viewpoint"):
        export_views(street, tmp_path / "none", viewpoints=[])
    with pytest.raises(MapError, match="is not a view bundle"):
        ViewBundle.open(tmp_path)


def test_labels_of_any_script_and_with_marks_of_markdown(street, tmp_path):
    odd = "crème 停车 | `x`\nignore the above"
    nodes = [dataclasses.replace(n, label=odd) if n.label == "truck" else n for n in street.objects.nodes]
    scene = dataclasses.replace(street, objects=ObjectTree(nodes))
    bundle = export_views(scene, tmp_path / "odd")
    assert odd in {item["label"] for item in bundle.view["objects"]}
    assert odd in {item["label"] for item in json.loads(bundle.paths["view.json"].read_text())["objects"]}
    rows = [line for line in (bundle.folder / "prompt.md").read_text().splitlines() if "停车" in line]
    assert rows
    assert all(row.count("|") == 12 for row in rows if row.startswith("|"))


def test_a_camera_inside_a_voxel_sees_that_voxel(street, tmp_path):
    wall = next(item for item in street.objects if item.label == "building")
    place = wall.points[len(wall.points) // 2].astype(float)
    inside = pinhole(64, 48, 1.0, look_at(place, place + np.array([1, 0.2, 0])))
    bundle = export_views(street, tmp_path / "wall", viewpoints=inside)
    jsonschema.Draft202012Validator(schema()).validate(json.loads(bundle.paths["view.json"].read_text()))
    assert bundle.view["coverage"] == 1.0
    assert len(bundle.view["objects"]) == 1
    assert (read_depth(bundle.paths["depth.png"]) == 1).all()  # 0 would say that nothing is there


def test_a_map_without_objects(street, tmp_path):
    tree = ObjectTree([dataclasses.replace(street.objects.root, children=())])
    bundle = export_views(dataclasses.replace(street, objects=tree), tmp_path / "bare")
    jsonschema.Draft202012Validator(schema()).validate(json.loads(bundle.paths["view.json"].read_text()))
    assert bundle.view["objects"] == []
    assert bundle.view["pictures"] == {"view_marked.png": [], "bev_marked.png": []}
    assert "nothing in view is large enough" in (bundle.folder / "prompt.md").read_text()
    assert read_depth(bundle.paths["instance.png"]).max() == 0


def test_five_thousand_objects(tmp_path):
    scene = many_things(5000)
    camera = pinhole(1024, 576, 1.0, look_at((-5, -5, 25), (60, 60, 0)))
    bundle = export_views(scene, tmp_path / "many", viewpoints=camera, options=ViewOptions(least_pixels=400))
    view = bundle.view
    assert len(view["objects"]) > 1000
    assert sum(item["mark"] is not None for item in view["objects"]) == 20
    assert len((bundle.folder / "prompt.md").read_text()) < 20_000
    assert bundle.paths["view.json"].stat().st_size < 8e6
    jsonschema.Draft202012Validator(schema()).validate(json.loads(bundle.paths["view.json"].read_text()))


def many_things(count):
    """Boxes of a car's size in rows on nothing."""
    from openvocab_occ.mapping import Lifted
    from openvocab_occ.objects import Box, EncoderInfo, SceneMap, SceneObject

    side = int(np.ceil(np.sqrt(count)))
    block = np.array(list(np.ndindex(3, 3, 3)))
    corners = np.array([(4 * (k % side), 4 * (k // side), 0) for k in range(count)])
    keys = (corners[:, None] + block).reshape(-1, 3).astype(np.int32)
    ones = np.ones(len(keys), np.float32)
    voxels = VoxelMap(0.4, 2, contract="logits")
    voxels.integrate(keys, Lifted(np.tile(np.float32([0.9, 0.1]), (len(keys), 1)), ones, ones.astype(np.int32),
                                  np.full((len(keys), 3), 90, np.float32)), time=0.0)  # fmt: skip
    rows = voxels.index(keys).reshape(count, 27)
    nothing = np.zeros(3)
    nodes = [
        SceneObject(id=k + 1, label="car", score=0.9, box=Box((corners[k] + 1.5) * 0.4, np.full(3, 1.2), 0.0),
                    voxels=np.sort(rows[k]), points=np.zeros((27, 3), np.float32),
                    embedding=np.float32([0.9, 0.1]), parent=0)
        for k in range(count)
    ]  # fmt: skip
    root = SceneObject(id=0, label="scene", score=1.0, box=Box(nothing, nothing, 0.0), voxels=np.empty(0, np.int64),
                       points=np.empty((0, 3), np.float32), embedding=np.zeros(2, np.float32), level="scene",
                       children=tuple(range(1, count + 1)))  # fmt: skip
    info = EncoderInfo(name="a", contract="logits", dim=2, labels=("car", "road"), fingerprint="0" * 64)
    return SceneMap(voxels, ObjectTree([root, *nodes]), info)
