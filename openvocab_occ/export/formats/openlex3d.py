"""The three files that OpenLex3D evaluates: points, an object of each point, a feature of each object."""

import json
from pathlib import Path

import numpy as np

from openvocab_occ.errors import DataError
from openvocab_occ.export.formats.cloud import Cloud
from openvocab_occ.export.formats.pcd import read_pcd, write_pcd
from openvocab_occ.io.files import PathLike, existing, written_folder
from openvocab_occ.objects import SceneMap

_MARKER = "index.npy"


def write_openlex3d(scene: SceneMap, path: PathLike) -> Path:
    """Write a folder of `point_cloud.pcd`, `index.npy` (row of each point's object, -1 for none), `embeddings.npy`.

    `labels.json` names the rows. Voxels of no object stay in the cloud; an object inside another takes its voxels.
    """
    cloud = Cloud.of(scene)
    objects = [node for node in scene.objects if len(node.voxels)]
    index = np.full(len(scene.voxels), -1, dtype=np.int64)
    for row in sorted(range(len(objects)), key=lambda row: -len(objects[row].voxels)):
        index[objects[row].voxels] = row
    embeddings = np.stack([node.embedding for node in objects]) if objects else np.zeros((0, scene.voxels.dim))
    with written_folder(path, marker=_MARKER) as folder:
        write_pcd(Cloud(cloud.points, cloud.colors), folder / "point_cloud.pcd")
        np.save(folder / _MARKER, index)
        np.save(folder / "embeddings.npy", embeddings.astype(np.float32))
        (folder / "labels.json").write_text(json.dumps([node.label for node in objects]) + "\n")
    return Path(path)


def read_openlex3d(path: PathLike) -> tuple[Cloud, np.ndarray]:
    """Return the points, with their object as column `object`, and the features, float32[objects, dim]."""
    folder = existing(path, "OpenLex3D folder")
    for name in ("point_cloud.pcd", _MARKER, "embeddings.npy"):
        existing(folder / name, name)
    cloud = read_pcd(folder / "point_cloud.pcd")
    try:
        index = np.load(folder / _MARKER, allow_pickle=False).astype(np.int64)
        features = np.load(folder / "embeddings.npy", allow_pickle=False).astype(np.float32)
    except ValueError as error:
        raise DataError(f"arrays of {folder} cannot be read", expected="plain .npy files", got=error) from error
    if index.shape != (len(cloud.points),) or features.ndim != 2 or index.max(initial=-1) >= len(features):
        raise DataError(
            f"files of {folder} do not fit each other",
            expected=f"{len(cloud.points)} indices below the number of features",
            got=f"{index.shape} indices up to {index.max(initial=-1)}, {features.shape} features",
        )
    return Cloud(cloud.points, cloud.colors, {**cloud.columns, "object": index}), features
