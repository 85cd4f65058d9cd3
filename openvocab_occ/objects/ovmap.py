"""`.ovmap`: a scene map as a folder of Parquet files and a manifest that vouches for them."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float16, Float32

from openvocab_occ.errors import AlreadyExistsError, MapError, OpenVocabOccError
from openvocab_occ.io.files import PathLike, existing, sha256, written_folder
from openvocab_occ.mapping import VoxelMap
from openvocab_occ.objects.box import Box
from openvocab_occ.objects.scene_map import EncoderInfo, KeyFrame, NamedCamera, Provenance, SceneMap
from openvocab_occ.objects.tree import ObjectTree, SceneObject, Sighting
from openvocab_occ.segmentation.encoder import Contract

FORMAT = "openvocab_occ.map"
VERSION = 1
MANIFEST = "manifest.json"
FILES = ("voxels.parquet", "features.parquet", "objects.parquet", "frames.parquet")
_AXES = {"keys": ("x", "y", "z"), "colors": ("red", "green", "blue")}
_VOXEL_COLUMNS = ("weight", "agreement", "color_weight", "count", "first_seen", "last_seen", "labels", "label_time",
                  "label_pixels")  # fmt: skip
_VECTOR = pa.list_(pa.float64())
_OBJECTS = pa.schema([
    ("id", pa.int32()), ("level", pa.string()), ("parent", pa.int32()), ("children", pa.list_(pa.int32())),
    ("label", pa.string()), ("score", pa.float64()), ("state", pa.string()),
    ("center", _VECTOR), ("size", _VECTOR), ("yaw", pa.float64()),
    ("embedding", pa.list_(pa.float32())), ("voxels", pa.list_(pa.int64())),
    ("views", pa.list_(pa.struct([("frame", pa.int32()), ("view", pa.string()), ("box", pa.list_(pa.int32()))]))),
])  # fmt: skip
_CAMERA = pa.struct([
    ("name", pa.string()), ("K", _VECTOR), ("width", pa.int32()), ("height", pa.int32()), ("T_world_cam", _VECTOR),
    ("lens", pa.string()), ("distortion", _VECTOR),
])  # fmt: skip
_FRAMES = pa.schema([
    ("index", pa.int64()), ("timestamp", pa.float64()), ("T_world_ego", _VECTOR), ("cameras", pa.list_(_CAMERA)),
])  # fmt: skip


def write_map(scene: SceneMap, path: PathLike) -> Path:
    """Write the folder; see `SceneMap.save`."""
    target = Path(path).expanduser()
    if (target / MANIFEST).is_file() and _manifest_format(target) != FORMAT:
        raise AlreadyExistsError(
            f"{target} holds a {MANIFEST} that is not a map's", expected="a map to replace, or no folder",
            fix="choose another output path",
        )  # fmt: skip
    features = scene.voxels.features
    stored = features.astype(np.float16)
    tables = {
        "voxels.parquet": _voxel_table(scene.voxels),
        "features.parquet": pa.table({"feature": _vectors(stored)}),
        "objects.parquet": pa.Table.from_pylist([_object_row(node) for node in scene.objects.nodes], _OBJECTS),
        "frames.parquet": pa.Table.from_pylist([_frame_row(frame) for frame in scene.frames], _FRAMES),
    }
    with written_folder(target, marker=MANIFEST) as folder:
        for name in FILES:
            pq.write_table(tables[name], folder / name, compression="zstd")
        manifest = {
            "format": FORMAT,
            "format_version": VERSION,
            "frame": "world, z up",
            "units": "metres, seconds, radians",
            "voxel_size": scene.voxels.voxel_size,
            "encoder": asdict(scene.encoder),
            "class_names": list(scene.class_names),
            "features": {"dtype": "float16", **rounding_errors(features, stored)},
            "provenance": asdict(scene.provenance),
            "counts": {name.removesuffix(".parquet"): tables[name].num_rows for name in FILES},
            "files": {
                name: {"sha256": sha256(folder / name), "bytes": (folder / name).stat().st_size} for name in FILES
            },
        }
        (folder / MANIFEST).write_text(json.dumps(manifest, indent=2, allow_nan=False) + "\n")
    return target


def read_map(path: PathLike) -> SceneMap:
    """Read the folder; see `SceneMap.open`."""
    folder = existing(path, "map")
    manifest = read_manifest(folder)
    tables = {name: _table(folder, name, manifest) for name in FILES}
    try:
        info = manifest["encoder"]
        encoder = EncoderInfo(**(info | {"labels": tuple(info["labels"])}))
        voxels = _voxels(tables, float(manifest["voxel_size"]), encoder)
        nodes = [_object(row, voxels) for row in tables["objects.parquet"].to_pylist()]
        frames = tuple(_frame(row) for row in tables["frames.parquet"].to_pylist())
        names, provenance = tuple(manifest["class_names"]), Provenance(**manifest["provenance"])
        return SceneMap(voxels, ObjectTree(nodes), encoder, frames, provenance, names)
    except MapError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, OpenVocabOccError) as error:
        raise MapError(f"map {folder} contradicts itself", got=f"{type(error).__name__}: {error}") from error


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a map this version can read."""
    if not (folder / MANIFEST).is_file():
        raise MapError(f"{folder} is not a map", expected=f"a folder with {MANIFEST}", fix="pass a .ovmap folder")
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
    except ValueError as error:
        raise MapError(f"{folder / MANIFEST} cannot be read", expected="JSON", got=error) from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        got = manifest.get("format") if isinstance(manifest, dict) else type(manifest).__name__
        raise MapError(f"{folder} is not a map", expected=f"format {FORMAT!r} in {MANIFEST}", got=got)
    if manifest.get("format_version") != VERSION:
        raise MapError(
            f"map {folder} is of a version this package does not read",
            expected=f"format_version {VERSION}",
            got=manifest.get("format_version"),
            fix="update openvocab_occ",
        )
    return manifest


def rounding_errors(exact: Float32[np.ndarray, "n c"], stored: Float16[np.ndarray, "n c"]) -> dict[str, float]:
    """Return the worst absolute error and the worst cosine that storing features made; 0 and 1 for none."""
    if not len(exact):
        return {"worst_absolute_error": 0.0, "worst_cosine": 1.0}
    back = stored.astype(np.float32)
    norms = np.linalg.norm(exact, axis=1) * np.linalg.norm(back, axis=1)
    cosine = np.divide(np.einsum("nc,nc->n", exact, back), norms, out=np.ones(len(exact), np.float32), where=norms > 0)
    return {
        "worst_absolute_error": float(np.abs(exact - back).max()),
        "worst_cosine": float(min(cosine.min(), 1.0)),
    }


def _manifest_format(folder: Path) -> object:
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
    except ValueError:
        return FORMAT if all((folder / name).is_file() for name in FILES) else None  # a damaged map may be replaced
    return manifest.get("format") if isinstance(manifest, dict) else None


def _table(folder: Path, name: str, manifest: Mapping[str, Any]) -> pa.Table:
    """Read one file after checking that it is the one the manifest speaks of."""
    path = folder / name
    if not path.is_file():
        raise MapError(f"map {folder} is incomplete", expected=name, got="no such file", fix="copy the whole folder")
    try:
        said, rows = manifest["files"][name]["sha256"], manifest["counts"][name.removesuffix(".parquet")]
    except (KeyError, TypeError) as error:
        raise MapError(f"the manifest of map {folder} says nothing of {name}", got=f"missing {error}") from error
    if sha256(path) != said:
        raise MapError(
            f"{path} is damaged or was edited",
            expected=f"sha256 {str(said)[:12]}...",
            got=f"{sha256(path)[:12]}..., {path.stat().st_size} bytes",
            fix="copy it again, or rebuild the map",
        )
    try:
        table = pq.read_table(path)
    except (pa.ArrowInvalid, OSError) as error:
        raise MapError(f"{path} cannot be read", expected="Parquet", got=error) from error
    if table.num_rows != rows:
        raise MapError(f"{path} has another number of rows than its manifest says", expected=rows, got=table.num_rows)
    return table


def _vectors(array: np.ndarray) -> pa.FixedSizeListArray:
    return pa.FixedSizeListArray.from_arrays(pa.array(array.reshape(-1)), array.shape[1])


def _voxel_table(voxels: VoxelMap) -> pa.Table:
    columns = voxels.columns()
    data = {axis: voxels.keys[:, i] for i, axis in enumerate(_AXES["keys"])}
    data |= {axis: columns["colors"][:, i] for i, axis in enumerate(_AXES["colors"])}
    data |= {name: columns[name] for name in _VOXEL_COLUMNS}
    return pa.table(data | {"feature": np.arange(len(voxels), dtype=np.int32)})


def _voxels(tables: Mapping[str, pa.Table], voxel_size: float, encoder: EncoderInfo) -> VoxelMap:
    table = tables["voxels.parquet"]
    column = {name: table[name].to_numpy() for name in table.column_names}
    vectors = tables["features.parquet"]["feature"].combine_chunks()
    features = vectors.flatten().to_numpy().reshape(len(vectors), -1 if len(vectors) else encoder.dim)
    row = column["feature"]
    if len(row) and not 0 <= int(row.min()) <= int(row.max()) < len(features):
        raise MapError("voxels point to features that are not there", expected=f"0..{len(features) - 1}", got=row.max())
    bad = int((~np.isfinite(features)).any(axis=1).sum())
    if bad or features.shape[1] != encoder.dim:
        raise MapError(
            "features of the map are not usable",
            expected=f"finite vectors of length {encoder.dim}",
            got=f"length {features.shape[1]}, {bad} of {len(features)} with NaN or infinity",
            fix="rebuild the map",
        )
    keys = np.stack([column[axis] for axis in _AXES["keys"]], axis=1)
    columns = {name: column[name] for name in _VOXEL_COLUMNS}
    columns["colors"] = np.stack([column[axis] for axis in _AXES["colors"]], axis=1)
    contract: Contract = encoder.contract
    return VoxelMap.from_columns(voxel_size, keys, features[row].astype(np.float32), columns, contract=contract)


def _object_row(node: SceneObject) -> dict[str, Any]:
    same = {name: getattr(node, name) for name in ("id", "level", "parent", "children", "label", "score", "state")}
    views = [{"frame": view.frame, "view": view.view, "box": list(view.box)} for view in node.views]
    box = {"center": node.box.center, "size": node.box.size, "yaw": node.box.yaw}
    return same | box | {"embedding": node.embedding, "voxels": node.voxels, "views": views}


def _object(row: Mapping[str, Any], voxels: VoxelMap) -> SceneObject:
    positions = np.asarray(row["voxels"], dtype=np.int64)
    if len(positions) and not 0 <= int(positions.min()) <= int(positions.max()) < len(voxels):
        raise MapError(f"object {row['id']} holds voxels that are not there", expected=f"0..{len(voxels) - 1}")
    embedding = np.asarray(row["embedding"], dtype=np.float32)
    if embedding.shape != (voxels.dim,) or not np.isfinite(embedding).all():
        raise MapError(f"embedding of object {row['id']} is not usable", expected=f"{voxels.dim} finite numbers")
    same = {name: row[name] for name in ("id", "level", "parent", "label", "score", "state")}
    return SceneObject(
        **same,
        box=Box(np.asarray(row["center"]), np.asarray(row["size"]), row["yaw"]),
        voxels=positions,
        points=voxels.centers[positions].astype(np.float32),
        embedding=embedding,
        children=tuple(row["children"]),
        views=tuple(Sighting(view["frame"], view["view"], tuple(view["box"])) for view in row["views"]),
    )


def _frame_row(frame: KeyFrame) -> dict[str, Any]:
    cameras = [
        {
            "name": camera.name, "K": camera.K.ravel(), "width": camera.width, "height": camera.height,
            "T_world_cam": camera.T_world_cam.ravel(), "lens": camera.lens, "distortion": camera.distortion,
        }
        for camera in frame.cameras
    ]  # fmt: skip
    ego = frame.T_world_ego.ravel()
    return {"index": frame.index, "timestamp": frame.timestamp, "T_world_ego": ego, "cameras": cameras}


def _frame(row: Mapping[str, Any]) -> KeyFrame:
    cameras = tuple(
        NamedCamera(
            np.reshape(camera["K"], (3, 3)),
            camera["width"],
            camera["height"],
            np.reshape(camera["T_world_cam"], (4, 4)),
            tuple(camera["distortion"]),
            camera["lens"],
            camera["name"],
        )
        for camera in row["cameras"]
    )
    return KeyFrame(row["index"], row["timestamp"], np.reshape(row["T_world_ego"], (4, 4)), cameras)
