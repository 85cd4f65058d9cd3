"""View bundles: pictures and JSON that agree with each other, with the map and with geometry."""

import base64
import dataclasses
import json

import jsonschema
import numpy as np
import pytest

from openvocab_occ.errors import ConfigError, MapError
from openvocab_occ.export import ViewBundle, ViewOptions, export_views
from openvocab_occ.export.palette import NOTHING
from openvocab_occ.export.render import overview_camera, render_map
from openvocab_occ.export.semantics import name_voxels
from openvocab_occ.export.views.contents import schema
from openvocab_occ.geometry import Camera, pose
from openvocab_occ.io.images import read_depth, read_image
from openvocab_occ.mapping import VoxelMap
from openvocab_occ.query.find import find
from tests.export.conftest import CAMERAS


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
