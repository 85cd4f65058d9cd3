"""Objects, keyframes and layers as rows of Parquet tables."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Int64

from openvocab_occ.errors import MapError
from openvocab_occ.mapping import DynamicLayer, VoxelMap
from openvocab_occ.objects.box import Box
from openvocab_occ.objects.scene_map import KeyFrame, NamedCamera
from openvocab_occ.objects.tree import SceneObject, Sighting, without

VECTOR = pa.list_(pa.float64())
_SIGHTING = pa.struct([
    ("frame", pa.int32()), ("view", pa.string()), ("box", pa.list_(pa.int32())), ("score", pa.float64()),
])  # fmt: skip
_OBJECTS = pa.schema([
    ("id", pa.int32()), ("level", pa.string()), ("parent", pa.int32()), ("children", pa.list_(pa.int32())),
    ("label", pa.string()), ("score", pa.float64()), ("state", pa.string()),
    ("center", VECTOR), ("size", VECTOR), ("yaw", pa.float64()),
    ("embedding", pa.list_(pa.float32())), ("voxels", pa.list_(pa.int64())),
    ("views", pa.list_(_SIGHTING)),
    ("evidence", pa.string()), ("confidence", pa.float64()), ("heading", pa.float64()), ("speed", pa.float64()),
    ("times_seen", pa.int64()), ("first_seen", pa.float64()), ("last_seen", pa.float64()), ("agreement", pa.float64()),
    ("names", pa.list_(pa.struct([("name", pa.string()), ("score", pa.float64())]))),
    ("best_embedding", pa.list_(pa.float32())), ("moved_points", pa.list_(pa.float32())),
    ("colors", pa.list_(pa.float32())),
])  # fmt: skip
_EVIDENCE = ("evidence", "confidence", "heading", "speed", "times_seen", "first_seen", "last_seen", "agreement")
_CAMERA = pa.struct([
    ("name", pa.string()), ("K", VECTOR), ("width", pa.int32()), ("height", pa.int32()), ("T_world_cam", VECTOR),
    ("lens", pa.string()), ("distortion", VECTOR),
])  # fmt: skip
_FRAMES = pa.schema([
    ("index", pa.int64()), ("timestamp", pa.float64()), ("T_world_ego", VECTOR), ("cameras", pa.list_(_CAMERA)),
])  # fmt: skip
_LAYERS = pa.schema([
    ("frame", pa.int64()), ("time", pa.float64()), ("keys", pa.list_(pa.int32())), ("thing", pa.list_(pa.int32())),
    ("features", pa.list_(pa.float32())),
])  # fmt: skip


def object_table(nodes: Sequence[SceneObject]) -> pa.Table:
    """Return a row for each node."""
    return pa.Table.from_pylist([_object_row(node) for node in nodes], _OBJECTS)


def objects_of(
    table: pa.Table, voxels: VoxelMap, rows: Int64[np.ndarray, " n"] | None, count: int
) -> list[SceneObject]:
    """Return the nodes of a table of a map of `count` voxels of which `voxels` are all, or the given, sorted, rows.

    Objects all of whose voxels are elsewhere are left out. Box and embedding remain those of the whole object.
    """
    members = table["voxels"].combine_chunks()
    positions = members.flatten().to_numpy(zero_copy_only=False)
    lengths = np.diff(members.offsets.to_numpy())
    owner = np.repeat(np.arange(len(table)), lengths)
    bad = np.flatnonzero((positions < 0) | (positions >= count))
    if len(bad):
        raise MapError(
            f"object {table['id'][int(owner[bad[0]])]} holds voxels that are not there", expected=f"0..{count - 1}"
        )
    if rows is not None:
        at = np.minimum(np.searchsorted(rows, positions), max(len(rows) - 1, 0))
        there = rows[at] == positions if len(rows) else np.zeros(len(at), dtype=bool)
        positions, owner = at[there], owner[there]
    ends = np.searchsorted(owner, np.arange(len(table) + 1))
    nodes = [
        _object(row, positions[ends[i] : ends[i + 1]], voxels)
        for i, row in enumerate(table.drop_columns(["voxels"]).to_pylist())
    ]
    gone = {node.id for i, node in enumerate(nodes) if lengths[i] and not len(node.voxels)}
    return without(nodes, gone)


def frame_table(frames: Sequence[KeyFrame]) -> pa.Table:
    """Return a row for each keyframe."""
    return pa.Table.from_pylist([_frame_row(frame) for frame in frames], _FRAMES)


def frames_of(table: pa.Table) -> tuple[KeyFrame, ...]:
    """Return the keyframes of a table."""
    return tuple(_frame(row) for row in table.to_pylist())


def layer_table(layers: Sequence[DynamicLayer]) -> pa.Table:
    """Return a row for each layer of what moved."""
    rows = [
        {"frame": layer.frame, "time": layer.time, "keys": layer.keys.ravel(), "thing": layer.thing,
         "features": layer.features.ravel()}
        for layer in layers
    ]  # fmt: skip
    return pa.Table.from_pylist(rows, _LAYERS)


def layers_of(table: pa.Table, dim: int) -> tuple[DynamicLayer, ...]:
    """Return the layers of a table."""
    return tuple(
        DynamicLayer(
            row["frame"],
            row["time"],
            np.array(row["keys"], dtype=np.int32).reshape(-1, 3),
            np.array(row["thing"], dtype=np.int32),
            np.array(row["features"], dtype=np.float32).reshape(-1, dim),
        )
        for row in table.to_pylist()
    )


def _object_row(node: SceneObject) -> dict[str, Any]:
    same = {name: getattr(node, name) for name in ("id", "level", "parent", "children", "label", "score", "state")}
    views = [{**view._asdict(), "box": list(view.box)} for view in node.views]
    box = {"center": node.box.center, "size": node.box.size, "yaw": node.box.yaw}
    more = {name: getattr(node, name) for name in _EVIDENCE}
    names = [{"name": name, "score": score} for name, score in node.names]
    best = None if node.best_embedding is None else node.best_embedding
    moved = node.points.ravel() if len(node.points) != len(node.voxels) else None  # not those of its voxels
    return same | box | more | {
        "embedding": node.embedding, "voxels": node.voxels, "views": views, "names": names, "best_embedding": best,
        "moved_points": moved, "colors": None if node.colors is None else node.colors.ravel(),
    }  # fmt: skip


def _object(row: Mapping[str, Any], positions: np.ndarray, voxels: VoxelMap) -> SceneObject:
    embedding = np.asarray(row["embedding"], dtype=np.float32)
    if embedding.shape != (voxels.dim,) or not np.isfinite(embedding).all():
        raise MapError(f"embedding of object {row['id']} is not usable", expected=f"{voxels.dim} finite numbers")
    same = {name: row[name] for name in ("id", "level", "parent", "label", "score", "state", *_EVIDENCE)}
    best, moved, colors = row["best_embedding"], row["moved_points"], row.get("colors")
    points = voxels.centers_at(positions) if moved is None else np.reshape(moved, (-1, 3))
    return SceneObject(
        **same,
        box=Box(np.asarray(row["center"]), np.asarray(row["size"]), row["yaw"]),
        voxels=positions.astype(np.int64),
        points=points.astype(np.float32),
        embedding=embedding,
        children=tuple(row["children"]),
        views=tuple(Sighting(**(view | {"box": tuple(view["box"])})) for view in row["views"]),
        names=tuple((name["name"], name["score"]) for name in row["names"]),
        best_embedding=None if best is None else np.asarray(best, dtype=np.float32),
        colors=None if colors is None else np.reshape(np.asarray(colors, dtype=np.float32), (-1, 4)),
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
