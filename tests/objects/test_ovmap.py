import json
import shutil
from dataclasses import asdict, replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from openvocab_occ.errors import AlreadyExistsError, MapError, NotFoundError
from openvocab_occ.io.files import sha256
from openvocab_occ.mapping import VoxelMap
from openvocab_occ.objects import ObjectTree, SceneMap, group_objects
from openvocab_occ.objects.map_files import FILES


def edit_manifest(path, **changes):
    manifest = json.loads((path / "manifest.json").read_text())
    manifest.update(changes)
    (path / "manifest.json").write_text(json.dumps(manifest))


def rewrite(path, name, table):
    """Replace a file and vouch for it, as a faulty writer would."""
    pq.write_table(table, path / name)
    manifest = json.loads((path / "manifest.json").read_text())
    manifest["files"][name]["sha256"] = sha256(path / name)
    manifest["counts"][name.removesuffix(".parquet")] = table.num_rows
    (path / "manifest.json").write_text(json.dumps(manifest))


@pytest.fixture
def saved(scene, tmp_path):
    return scene.save(tmp_path / "street.ovmap", max_cosine_error=0.0)


def test_a_map_comes_back_as_it_was(scene, saved):
    back = SceneMap.open(saved)
    np.testing.assert_array_equal(back.voxels.keys, scene.voxels.keys)
    assert (back.voxels.voxel_size, back.voxels.contract) == (scene.voxels.voxel_size, scene.voxels.contract)
    for name in ("labels", "count", "first_seen", "last_seen", "weight", "colors", "centers"):
        np.testing.assert_array_equal(getattr(back.voxels, name), getattr(scene.voxels, name))
    np.testing.assert_allclose(back.voxels.features, scene.voxels.features, atol=5e-4)
    np.testing.assert_allclose(back.voxels.agreement, scene.voxels.agreement, rtol=1e-3)
    for a, b in zip(back.objects.nodes, scene.objects.nodes, strict=True):
        assert (a.id, a.label, a.score, a.state, a.level, a.parent, a.children) == (
            b.id, b.label, b.score, b.state, b.level, b.parent, b.children,
        )  # fmt: skip
        assert a.box.yaw == b.box.yaw
        assert a.views == b.views
        for name in ("voxels", "points", "embedding", "center"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    for a, b in zip(back.frames, scene.frames, strict=True):
        np.testing.assert_array_equal(a.T_world_ego, b.T_world_ego)
        assert (a.index, a.timestamp) == (b.index, b.timestamp)
        for c, d in zip(a.cameras, b.cameras, strict=True):
            assert (c.name, c.lens, c.distortion, c.width, c.height) == (
                d.name,
                d.lens,
                d.distortion,
                d.width,
                d.height,
            )
            np.testing.assert_array_equal(c.K, d.K)
            np.testing.assert_array_equal(c.T_world_cam, d.T_world_cam)
    assert asdict(back.encoder) == asdict(scene.encoder)
    assert asdict(back.provenance) == asdict(scene.provenance)
    assert back.class_names == scene.class_names


def test_colours_of_things_come_back(scene, tmp_path):
    first, *others = scene.objects.nodes[1:]
    shown = np.array([[0.75, 200, 20, 20], [0.25, 16, 18, 22]], np.float32)
    nodes = [scene.objects.root, replace(first, colors=shown), *others]
    back = SceneMap.open(replace(scene, objects=ObjectTree(nodes)).save(tmp_path / "painted.ovmap"))
    np.testing.assert_array_equal(back.objects[first.id].colors, shown)
    assert all(back.objects[node.id].colors is None for node in others if node.colors is None)


def test_saving_again_adds_no_drift(scene, saved, tmp_path):
    path = saved
    for i in range(5):
        path = SceneMap.open(path).save(tmp_path / f"copy{i}.ovmap", max_cosine_error=0.0)
    for name in ("objects.parquet", "frames.parquet"):
        assert sha256(path / name) == sha256(saved / name)
    np.testing.assert_allclose(SceneMap.open(path).voxels.features, scene.voxels.features, atol=1e-3)
    scene.save(path, max_cosine_error=0.0)  # over another map
    assert sha256(path / "voxels.parquet") == sha256(saved / "voxels.parquet")


def test_the_manifest_states_what_rounding_cost(scene, saved):
    said = json.loads((saved / "manifest.json").read_text())
    stored = scene.voxels.features.astype(np.float16).astype(np.float64)
    exact = scene.voxels.features.astype(np.float64)
    cosine = (stored * exact).sum(1) / np.linalg.norm(stored, axis=1) / np.linalg.norm(exact, axis=1)
    assert said["features"]["worst_cosine_error"] == pytest.approx(1 - cosine.min())
    assert said["counts"] == {
        "voxels": 48, "features": 48, "space": 0, "objects": 4, "dynamic": 0, "frames": 2,
    }  # fmt: skip
    assert said["provenance"]["synthetic"] is True


def test_an_empty_map_can_be_saved(scene, tmp_path):
    empty = VoxelMap(0.4, 3, contract=scene.encoder.contract)
    path = SceneMap(empty, group_objects(empty), scene.encoder).save(tmp_path / "empty.ovmap")
    back = SceneMap.open(path)
    assert len(back.voxels) == len(back.objects) == 0


def test_no_folder_and_no_map_are_told(tmp_path):
    with pytest.raises(NotFoundError, match="map not found"):
        SceneMap.open(tmp_path / "nowhere.ovmap")
    with pytest.raises(MapError, match=r"is not a map: expected a folder with manifest\.json"):
        SceneMap.open(tmp_path)
    (tmp_path / "manifest.json").write_text('{"format": "webapp"}')
    with pytest.raises(MapError, match=r"is not a map: expected format 'openvocab_occ\.map'.*got webapp"):
        SceneMap.open(tmp_path)
    (tmp_path / "manifest.json").write_text('{"format": ')
    with pytest.raises(MapError, match=r"manifest\.json cannot be read: expected JSON"):
        SceneMap.open(tmp_path)


def test_a_map_from_the_future_is_told(saved):
    edit_manifest(saved, format_version=2)
    with pytest.raises(MapError, match="expected format_version 1, got 2; update openvocab_occ"):
        SceneMap.open(saved)


@pytest.mark.parametrize("name", FILES)
def test_a_missing_cut_or_edited_file_is_told(saved, name):
    content = (saved / name).read_bytes()
    (saved / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(MapError, match=f"{name} is damaged or was edited"):
        SceneMap.open(saved)
    (saved / name).write_bytes(content[:-9] + bytes([content[-9] ^ 1]) + content[-8:])
    with pytest.raises(MapError, match=f"{name} is damaged or was edited"):
        SceneMap.open(saved)
    (saved / name).unlink()
    with pytest.raises(MapError, match=f"is incomplete: expected {name}"):
        SceneMap.open(saved)


def test_features_that_are_no_numbers_are_told(saved):
    table = pq.read_table(saved / "features.parquet")
    flat = np.array(table["feature"].combine_chunks().flatten())
    flat[5] = np.nan
    vectors = pa.FixedSizeListArray.from_arrays(pa.array(flat), 3)
    rewrite(saved, "features.parquet", pa.table({"feature": vectors}))
    with pytest.raises(MapError, match=r"features of the map are not usable.*1 of 48 with NaN"):
        _ = SceneMap.open(saved).voxels.features


def test_files_that_contradict_each_other_are_told(saved):
    features = pq.read_table(saved / "features.parquet")
    rewrite(saved, "features.parquet", features.slice(0, 10))
    with pytest.raises(MapError, match=r"point to features that are not there: expected 0\.\.9, got 47"):
        _ = SceneMap.open(saved).voxels.features
    rewrite(saved, "features.parquet", features)
    voxels = pq.read_table(saved / "voxels.parquet")
    rewrite(saved, "voxels.parquet", voxels.slice(0, 40))
    with pytest.raises(MapError, match="holds voxels that are not there"):
        _ = SceneMap.open(saved).objects.nodes
    rewrite(saved, "voxels.parquet", voxels.drop_columns(["weight"]))
    with pytest.raises(MapError, match="contradicts itself: expected a column weight, got none"):
        _ = SceneMap.open(saved).voxels.weight
    rewrite(saved, "voxels.parquet", pa.concat_tables([voxels.slice(0, 47), voxels.slice(0, 1)]))
    with pytest.raises(MapError, match="voxel keys repeat"):
        _ = SceneMap.open(saved).voxels.keys


def test_a_save_that_fails_leaves_what_was_there(scene, saved, monkeypatch):
    before = {p.name: p.read_bytes() for p in saved.iterdir()}

    def full(*args, **kwargs):
        raise OSError("no space left")

    monkeypatch.setattr(pq, "write_table", full)
    with pytest.raises(OSError, match="no space left"):
        scene.save(saved)
    with pytest.raises(OSError, match="no space left"):
        scene.save(saved.with_name("new.ovmap"))
    assert {p.name: p.read_bytes() for p in saved.iterdir()} == before
    assert [p.name for p in saved.parent.iterdir()] == [saved.name]


def test_other_folders_are_never_replaced(scene, tmp_path):
    (tmp_path / "photos").mkdir()
    with pytest.raises(AlreadyExistsError, match="is not ours to replace"):
        scene.save(tmp_path / "photos")
    (tmp_path / "photos" / "manifest.json").write_text('{"name": "web app"}')
    with pytest.raises(AlreadyExistsError, match=r"manifest\.json that is not a map's"):
        scene.save(tmp_path / "photos")
    shutil.rmtree(tmp_path / "photos")


def test_a_map_that_is_replaced_or_removed_stays_whole_for_its_readers(scene, saved):
    opened, truth = SceneMap.open(saved), SceneMap.open(saved)
    expected = truth.voxels.features, truth.voxels.columns(), truth.objects.nodes
    empty = VoxelMap(0.4, scene.encoder.dim, contract=scene.encoder.contract)
    SceneMap(empty, group_objects(empty), scene.encoder).save(saved)
    assert len(SceneMap.open(saved).voxels) < len(opened.voxels)
    shutil.rmtree(saved)
    np.testing.assert_array_equal(opened.voxels.features, expected[0])
    for name, column in expected[1].items():
        np.testing.assert_array_equal(opened.voxels.columns()[name], column)
    assert [node.id for node in opened.objects.nodes] == [node.id for node in expected[2]]
