import json
import sys

import numpy as np
import pytest

from openvocab_occ.cli import main
from openvocab_occ.errors import ConfigError, DataError, MissingExtraError
from openvocab_occ.export.formats import convert, read_bt, read_cloud
from openvocab_occ.export.formats.octomap import write_bt
from openvocab_occ.export.formats.openlex3d import read_openlex3d
from openvocab_occ.mapping import FreeSpace, VoxelMap


@pytest.fixture(scope="module")
def saved(street, tmp_path_factory):
    return street.save(tmp_path_factory.mktemp("maps") / "street.ovmap")


@pytest.mark.parametrize("end", [".ply", ".pcd", ".las", ".laz"])
def test_points_come_back(saved, tmp_path, end):
    if end in (".las", ".laz"):
        pytest.importorskip("laspy")
        pytest.importorskip("lazrs")
    cloud, back = read_cloud(saved), read_cloud(convert(saved, tmp_path / f"street{end}"))
    np.testing.assert_allclose(back.points, cloud.points, atol={".ply": 0, ".pcd": 1e-5}.get(end, 6e-4))
    np.testing.assert_array_equal(back.colors, cloud.colors)
    for name in ("label", "object"):
        np.testing.assert_array_equal(back.columns[name], cloud.columns[name])
    again = read_cloud(convert(tmp_path / f"street{end}", tmp_path / "again.ply"))
    np.testing.assert_array_equal(again.points, back.points)


@pytest.mark.parametrize("end", [".ply", ".pcd"])
def test_open3d_reads_what_we_write_and_we_what_it_writes(saved, tmp_path, end):
    import open3d as o3d

    cloud, path = read_cloud(saved), convert(saved, tmp_path / f"street{end}")
    theirs = o3d.io.read_point_cloud(str(path))
    np.testing.assert_allclose(np.asarray(theirs.points), cloud.points, atol=1e-5)
    np.testing.assert_allclose(np.asarray(theirs.colors) * 255, cloud.colors, atol=0.51)
    for number, ascii in enumerate((False, True)):
        other = tmp_path / f"theirs{number}{end}"
        o3d.io.write_point_cloud(str(other), theirs, write_ascii=ascii)
        back = read_cloud(other)
        np.testing.assert_allclose(back.points, cloud.points, atol=1e-4)
        assert np.abs(back.colors.astype(int) - cloud.colors).max() <= 1


@pytest.mark.data
def test_a_real_octomap_has_the_leaves_its_readme_gives(data):
    tree = read_bt(data / "octomap" / "geb079.bt")
    assert (tree.num_nodes, tree.occupied.sum(), (~tree.occupied).sum()) == (532_566, 143_729, 284_415)
    assert tree.resolution == 0.08
    cells = np.concatenate([tree.corner, tree.size[:, None]], axis=1)
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_a_map_comes_back_from_octomap_with_its_free_space(tmp_path, rng):
    keys = np.unique(rng.integers(-40, 40, (500, 3)), axis=0).astype(np.int32)
    ones = np.ones(len(keys), np.float32)
    columns = {
        "weight": ones, "agreement": ones, "colors": np.zeros((len(keys), 3), np.uint8), "color_weight": ones,
        "count": ones.astype(np.int32), "first_seen": ones, "last_seen": ones, "label_time": ones,
        "labels": np.full(len(keys), 255, np.uint8), "label_pixels": ones.astype(np.int32),
    }  # fmt: skip
    voxels = VoxelMap.from_columns(0.4, keys, np.ones((len(keys), 1), np.float32), columns, contract="dense")
    counts = (rng.random((3, 512)) < 0.3).astype(np.uint8)
    blocks = np.array([[0, 0, 0], [-2, 1, 3], [4, -4, 0]], np.int32)
    voxels.free = FreeSpace.from_blocks(0.4, blocks, counts)
    tree = read_bt(write_bt(voxels, tmp_path / "map.bt"))
    assert (tree.size == 1).all()
    np.testing.assert_array_equal(np.unique(tree.corner[tree.occupied], axis=0), keys)
    free = tree.corner[~tree.occupied]
    assert len(free) == counts.sum() - (voxels.free_count > 0).sum()
    assert (voxels.free.count(free) > 0).all()
    assert (voxels.index(free) < 0).all()
    empty = read_bt(write_bt(VoxelMap(0.4, 1), tmp_path / "empty.bt"))
    assert len(empty.corner) == 0


def test_openlex3d_and_rerun(saved, street, tmp_path):
    cloud, features = read_openlex3d(convert(saved, tmp_path / "street.openlex3d"))
    assert len(cloud.points) == len(street.voxels)
    assert len(features) == len(street.objects)
    for row, node in enumerate(street.objects):
        np.testing.assert_allclose(features[row], node.embedding, atol=1e-6)
        assert (cloud.columns["object"][node.voxels] == row).all()
    pytest.importorskip("rerun")
    assert convert(saved, tmp_path / "street.rrd").read_bytes()[:4] == b"RRF2"
    pytest.importorskip("rerun.chunk")
    back = read_cloud(tmp_path / "street.rrd")
    np.testing.assert_allclose(back.points, street.voxels.centers, atol=1e-4)
    np.testing.assert_array_equal(back.colors, street.voxels.colors)
    (tmp_path / "bad.rrd").write_bytes(b"no recording")
    with pytest.raises(DataError, match=r"bad\.rrd cannot be read: expected a Rerun recording"):
        read_cloud(tmp_path / "bad.rrd")


def test_files_that_are_not_what_they_say_are_told(tmp_path, saved, monkeypatch):
    for end, content, message in (
        (".ply", b"solid", "is not a PLY file"),
        (".ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
                 b"property float z\nend_header\nshort", "is cut short: expected 108 bytes, got 5"),
        (".pcd", b"VERSION 0.7\n", "is not a PCD file"),
        (".pcd", b"FIELDS x\nDATA binary_compressed\n", "stored in a way that is not read"),
        (".bt", b"# nothing", "is not an OctoMap binary tree"),
        (".bt", b"# Octomap OcTree binary file\nid OcTree\nsize 9\nres 0.1\ndata\n\x00", "cut short or damaged"),
    ):  # fmt: skip
        (tmp_path / f"bad{end}").write_bytes(content)
        with pytest.raises(DataError, match=message):
            read_cloud(tmp_path / f"bad{end}")
    with pytest.raises(ConfigError, match=r"format is not written: expected \.ply"):
        convert(saved, tmp_path / "street.dwg")
    (tmp_path / "points.ply").write_bytes(convert(saved, tmp_path / "a.ply").read_bytes())
    with pytest.raises(ConfigError, match=r"\.bt needs a map to start from"):
        convert(tmp_path / "points.ply", tmp_path / "points.bt")
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'openvocab_occ\[las\]'"):
        convert(saved, tmp_path / "street.las")
    assert not (tmp_path / "street.las").exists()


def test_the_file_commands(saved, tmp_path, capsys):
    def run(*words):
        assert main(["file", *map(str, words), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    assert run("info", saved)["voxels"] == run("verify", saved)["voxels"]
    left = tmp_path / "left.ovmap"
    cut = run("crop", saved, "--lower", -99, -99, -99, "--upper", 0, 99, 99, "--out", left)
    right = tmp_path / "right.ovmap"
    rest = run("crop", saved, "--lower", 0, -99, -99, "--upper", 99, 99, 99, "--out", right)
    both = run("concat", left, right, "--out", tmp_path / "both.ovmap")
    assert both["voxels"] == cut["voxels"] + rest["voxels"] == run("info", saved)["voxels"]
    assert run("diff", saved, tmp_path / "both.ovmap")["changed"] == 0
    assert run("merge", left, right, "--out", tmp_path / "merged.ovmap")["voxels"] == both["voxels"]
    assert run("convert", saved, tmp_path / "street.ply")["bytes"] > 0
    assert main(["file", "info", str(tmp_path / "none.ovmap")]) == 2
    assert "map not found" in capsys.readouterr().err
