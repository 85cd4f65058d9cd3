"""What can go wrong with a saved map: kills, full disks, and files by other hands."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from openvocab_occ.errors import MapError, StorageError
from openvocab_occ.io.files import sha256
from openvocab_occ.objects import ObjectTree, SceneMap
from openvocab_occ.objects.feature_table import cosines, feature_table
from openvocab_occ.objects.ovmap import verify_map

GOLDEN = Path(__file__).parent / "golden.ovmap"
_SAVE_FOREVER = """
import sys
from openvocab_occ.objects import SceneMap
one, two = SceneMap.open(sys.argv[1]), SceneMap.open(sys.argv[2])
for scene in (one, two):
    scene.voxels.columns(), scene.voxels.features
print("ready", flush=True)
while True:
    one.save(sys.argv[3])
    two.save(sys.argv[3])
"""


def test_killed_at_any_point_while_saving_the_map_is_whole(scene, tmp_path):
    one = scene.save(tmp_path / "one.ovmap")
    half = scene.voxels.subset(scene.voxels.keys[:, 0] < 0)
    alone = ObjectTree([replace(scene.objects.root, children=())])
    two = replace(scene, voxels=half, objects=alone).save(tmp_path / "two.ovmap")
    target = scene.save(tmp_path / "target.ovmap")
    sizes = {len(SceneMap.open(path).voxels) for path in (one, two)}
    rng = np.random.default_rng(0)
    worker = [sys.executable, "-c", _SAVE_FOREVER, str(one), str(two), str(target)]
    for _ in range(3):
        with subprocess.Popen(worker, stdout=subprocess.PIPE, cwd=Path(__file__).parents[2]) as process:
            assert process.stdout.readline() == b"ready\n"
            time.sleep(float(rng.uniform(0.02, 0.3)))
            process.send_signal(signal.SIGKILL)
        assert verify_map(target)["voxels"] in sizes
    assert len(SceneMap.open(scene.save(target)).voxels) == len(scene.voxels)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="limits of a process are POSIX's")
def test_a_disk_that_is_full_is_told_and_leaves_the_old_map(scene, tmp_path):
    import resource

    saved = scene.save(tmp_path / "street.ovmap")
    before = {path.name: path.read_bytes() for path in saved.iterdir()}
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, old[1]))
        with pytest.raises(StorageError, match=r"could not be written.*what was there before is unchanged"):
            scene.save(saved)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
        signal.signal(signal.SIGXFSZ, ignored)
    assert {path.name: path.read_bytes() for path in saved.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["street.ovmap"]


def test_verify_finds_what_lazy_opening_does_not_read(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("openvocab_occ.objects.map_files.HASHED_AT_ONCE", 0)  # as if every file were large
    saved = scene.save(tmp_path / "street.ovmap")
    verify_map(saved)
    file = saved / "features.parquet"
    content = bytearray(file.read_bytes())
    content[60] ^= 1  # in the first page
    file.write_bytes(bytes(content))
    opened = SceneMap.open(saved)
    with pytest.raises(MapError, match=r"features\.parquet cannot be read"):
        _ = opened.voxels.features
    with pytest.raises(MapError, match=r"features\.parquet is damaged or was edited"):
        verify_map(saved)


def test_columns_that_are_no_numbers_are_found_by_verify(scene, tmp_path):
    saved = scene.save(tmp_path / "street.ovmap")
    table = pq.read_table(saved / "voxels.parquet")
    weight = table["weight"].to_numpy().copy()
    weight[3] = np.nan
    at = table.column_names.index("weight")
    pq.write_table(table.set_column(at, "weight", pa.array(weight)), saved / "voxels.parquet")
    said = json.loads((saved / "manifest.json").read_text())
    said["files"]["voxels.parquet"]["sha256"] = sha256(saved / "voxels.parquet")  # by a faulty writer
    (saved / "manifest.json").write_text(json.dumps(said))
    with pytest.raises(MapError, match=r"columns of map .* are not finite: got weight"):
        verify_map(saved)


def test_a_region_is_the_map_within_it(scene, tmp_path):
    saved = scene.save(tmp_path / "street.ovmap", max_cosine_error=0.0)
    box = np.array([[0.0, -1.0, -1.0], [99.0, 99.0, 99.0]])
    part, whole = SceneMap.open(saved, region=box), SceneMap.open(saved)
    inside = ((whole.voxels.centers >= box[0]) & (whole.voxels.centers < box[1])).all(axis=1)
    np.testing.assert_array_equal(part.voxels.keys, whole.voxels.keys[inside])
    np.testing.assert_array_equal(part.voxels.features, whole.voxels.features[inside])
    for name, column in whole.voxels.columns().items():
        np.testing.assert_array_equal(part.voxels.columns()[name], column[inside])
    for node in part.objects:
        np.testing.assert_allclose(part.voxels.centers[node.voxels], node.points, atol=1e-5)
    away = SceneMap.open(saved, region=box + 500)
    assert len(away.voxels) == len(away.objects) == 0


def test_a_map_read_from_a_file_grows_on_as_before(scene, tmp_path):
    opened = SceneMap.open(scene.save(tmp_path / "street.ovmap", max_cosine_error=0.0)).voxels
    fresh = scene.voxels.copy()
    for voxels in (opened, fresh):
        voxels.merge(scene.voxels)
    np.testing.assert_array_equal(opened.count, fresh.count)
    np.testing.assert_allclose(opened.features, fresh.features, atol=2e-3)


@pytest.mark.parametrize("bound", [0.001, 0.02, 0.3])
def test_shared_vectors_are_within_the_bound_that_is_stated(bound, rng):
    centres = rng.normal(size=(20, 16))
    features = (centres[rng.integers(0, 20, 3000)] + 0.2 * rng.normal(size=(3000, 16))).astype(np.float32)
    features[7] = 0
    table = feature_table(features, bound)
    error = 1 - cosines(features, table.vectors[table.row])
    assert error.max() == pytest.approx(table.worst_cosine_error, abs=1e-9)
    assert table.worst_cosine_error <= bound
    if bound > 0.1:
        assert len(table.vectors) < 300


def test_a_map_of_format_1_can_still_be_read():
    scene = SceneMap.open(GOLDEN)
    verify_map(GOLDEN)
    assert repr(scene) == "SceneMap(synthetic 48 voxels, 3 objects, encoder toy)"
    assert scene.voxels.keys[[0, 20, 47]].tolist() == [[-3, 0, 0], [0, 20, 0], [9, 9, 3]]
    assert scene.voxels.features.argmax(axis=1).tolist()[:3] == [0, 0, 0]
    assert scene.voxels.count.tolist() == [2] * 48
    assert [node.label for node in scene.objects] == ["road", "truck", "traffic cone"]
    assert [camera.lens for camera in scene.frames[0].cameras] == ["pinhole", "fisheye"]
