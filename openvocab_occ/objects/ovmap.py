"""`.ovmap`: a scene map as a folder of Parquet files and a manifest that vouches for them.

Voxels are sorted by x, then y, then z, in row groups that know their range of x, so that a region is read without the
rest. Columns and features are read when they are first asked for; their pages carry checksums.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float, Float32, Int64

from openvocab_occ.errors import AlreadyExistsError, ConfigError, MapError, OpenVocabOccError, StorageError
from openvocab_occ.io.files import PathLike, existing, sha256, written_folder
from openvocab_occ.mapping import FreeSpace, VoxelMap
from openvocab_occ.mapping.keys import pack_axes, packable
from openvocab_occ.objects.feature_table import feature_table
from openvocab_occ.objects.map_files import FILES, MapFiles
from openvocab_occ.objects.map_rows import frame_table, frames_of, layer_table, layers_of, object_table, objects_of
from openvocab_occ.objects.scene_map import EncoderInfo, Provenance, SceneMap
from openvocab_occ.objects.tree import ObjectTree, SceneObject

FORMAT = "openvocab_occ.map"
VERSION = 1
MANIFEST = "manifest.json"
MAX_COSINE_ERROR = 0.01
"""How far a stored feature may be from the voxel's own, by default: a match of cosine 0.3 moves by at most 0.14, one of
neighbours that share a vector by what they differ anyway."""
_ROW_GROUP = 1 << 16
_TRIES = 5
_AXES = ("x", "y", "z")
_PARTS = {
    "keys": _AXES, "colors": ("red", "green", "blue"), "normals": ("normal_x", "normal_y", "normal_z"),
    "view_box": ("left", "top", "right", "bottom"),
}  # fmt: skip
_PLAIN = ("weight", "agreement", "color_weight", "count", "first_seen", "last_seen", "labels", "label_time",
          "label_pixels", "view_frame", "view", "view_score")  # fmt: skip
_TYPES = {
    "x": np.int32, "y": np.int32, "z": np.int32, "red": np.uint8, "green": np.uint8, "blue": np.uint8,
    "normal_x": np.int8, "normal_y": np.int8, "normal_z": np.int8, "labels": np.uint8, "agreement": np.float16,
    "left": np.int16, "top": np.int16, "right": np.int16, "bottom": np.int16, "view": np.int16,
    "view_score": np.float16,
}  # fmt: skip
_NORMAL_STEP = np.float32(1 / 127)


def write_map(scene: SceneMap, path: PathLike, *, max_cosine_error: float = MAX_COSINE_ERROR) -> Path:
    """Write the folder; see `SceneMap.save`."""
    target = Path(path).expanduser()
    if (target / MANIFEST).is_file() and _manifest_format(target) != FORMAT:
        raise AlreadyExistsError(
            f"{target} holds a {MANIFEST} that is not a map's", expected="a map to replace, or no folder",
            fix="choose another output path",
        )  # fmt: skip
    features = feature_table(scene.voxels.features, max_cosine_error)
    tables = {
        "voxels.parquet": _voxel_table(scene.voxels, features.row),
        "features.parquet": pa.table({"feature": _vectors(features.vectors)}),
        "space.parquet": _space_table(scene.voxels.free),
        "objects.parquet": object_table(scene.objects.nodes),
        "dynamic.parquet": layer_table(scene.dynamic),
        "frames.parquet": frame_table(scene.frames),
    }
    try:
        with written_folder(target, marker=MANIFEST) as folder:
            for name in FILES:
                _write(tables[name], folder / name)
            manifest = {
                "format": FORMAT,
                "format_version": VERSION,
                "frame": "world, z up",
                "units": "metres, seconds, radians",
                "voxel_size": scene.voxels.voxel_size,
                "encoder": asdict(scene.encoder),
                "class_names": list(scene.class_names),
                "num_classes": scene.voxels.num_classes,
                "features": {
                    "dtype": "float16",
                    "max_cosine_error": max_cosine_error,
                    "worst_cosine_error": features.worst_cosine_error,
                    "mean_cosine_error": features.mean_cosine_error,
                },
                "provenance": asdict(scene.provenance),
                "counts": {name.removesuffix(".parquet"): tables[name].num_rows for name in FILES},
                "files": {
                    name: {"sha256": sha256(folder / name), "bytes": (folder / name).stat().st_size} for name in FILES
                },
            }
            (folder / MANIFEST).write_text(json.dumps(manifest, indent=2, allow_nan=False) + "\n")
    except OpenVocabOccError:
        raise
    except OSError as error:
        raise StorageError(
            f"map {target} could not be written", got=error.strerror or error, fix="what was there before is unchanged"
        ) from error
    return target


def read_map(path: PathLike, *, region: Float[np.ndarray, "2 3"] | None = None) -> SceneMap:
    """Read the folder; see `SceneMap.open`. Its files stay open, so that replacing the map does no harm to readers."""
    folder = existing(path, "map")
    manifest, files = _opened(folder)
    with _consistent(folder):
        info = manifest["encoder"]
        encoder = EncoderInfo(**(info | {"labels": tuple(info["labels"])}))
        voxels, rows = _voxels(files, manifest, encoder, region)
        count = int(manifest["counts"]["voxels"])

        def nodes() -> list[SceneObject]:
            with _consistent(folder):
                found = objects_of(files.table("objects.parquet"), voxels, rows, count)
                return list(ObjectTree(found).nodes)

        frames = frames_of(files.table("frames.parquet"))
        layers = layers_of(files.table("dynamic.parquet"), encoder.dim)
        names, provenance = tuple(manifest["class_names"]), Provenance(**manifest["provenance"])
        return SceneMap(voxels, ObjectTree.stored(nodes), encoder, frames, provenance, names, layers)


def _opened(folder: Path) -> tuple[dict[str, Any], MapFiles]:
    """Return the manifest and its files; again where the map was replaced between the two."""
    for _ in range(_TRIES):
        manifest, files = read_manifest(folder), MapFiles(folder)
        try:
            files.check(manifest)
        except MapError:
            if read_manifest(folder) == manifest:
                raise
        else:
            return manifest, files
    raise MapError(f"map {folder} is replaced faster than it can be opened", fix="try again")


@contextmanager
def _consistent(folder: Path) -> Iterator[None]:
    """Turn whatever goes wrong with the content of a map into MapError."""
    try:
        yield
    except (MapError, ConfigError):
        raise
    except (KeyError, TypeError, ValueError, IndexError, OSError, pa.ArrowException, OpenVocabOccError) as error:
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


def _manifest_format(folder: Path) -> object:
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
    except ValueError:
        return FORMAT if all((folder / name).is_file() for name in FILES) else None  # a damaged map may be replaced
    return manifest.get("format") if isinstance(manifest, dict) else None


def verify_map(path: PathLike) -> dict[str, Any]:
    """Hash every file and read every page of a map; return what its manifest says, or raise MapError."""
    folder = existing(path, "map")
    manifest = read_manifest(folder)
    MapFiles(folder).check(manifest, hash_all=True)
    scene = read_map(folder)
    _, _, _ = scene.voxels.keys, scene.voxels.free, scene.objects.nodes
    columns = scene.voxels.columns()
    features = scene.voxels.features
    bad = [name for name in ("weight", "agreement", "first_seen", "last_seen") if not np.isfinite(columns[name]).all()]
    if bad:
        raise MapError(f"columns of map {folder} are not finite", got=", ".join(bad), fix="rebuild the map")
    return {**manifest, "voxels": len(features), "bytes": sum(entry["bytes"] for entry in manifest["files"].values())}


def _write(table: pa.Table, path: Path) -> None:
    """Write a table; weights differ in every bit and are split by byte, what repeats is put in a dictionary."""
    split = [name for name in table.column_names if name in ("weight", "color_weight", "view_score", "agreement")]
    others: Any = [name for name in table.column_names if name not in split]
    pq.write_table(
        table, path, compression="zstd", compression_level=6, row_group_size=_ROW_GROUP, write_page_checksum=True,
        use_dictionary=others, column_encoding=dict.fromkeys(split, "BYTE_STREAM_SPLIT"),
    )  # fmt: skip


def _vectors(array: np.ndarray) -> pa.FixedSizeListArray:
    return pa.FixedSizeListArray.from_arrays(pa.array(array.reshape(-1)), array.shape[1])


def _voxel_table(voxels: VoxelMap, feature: np.ndarray) -> pa.Table:
    columns = {"keys": voxels.keys, **voxels.columns()}
    columns["normals"] = np.rint(columns["normals"] / _NORMAL_STEP)
    if (columns["color_weight"] == columns["weight"]).all():
        del columns["color_weight"]  # images came with every view
    data: dict[str, Any] = {}
    for name, parts in _PARTS.items():
        data |= {part: columns[name][:, i] for i, part in enumerate(parts)}
    data |= {name: columns[name] for name in _PLAIN if name in columns}
    data = {name: np.ascontiguousarray(column, dtype=_TYPES.get(name)) for name, column in data.items()}
    if voxels.num_classes:
        data["label_counts"] = _vectors(voxels.label_counts)
    return pa.table(data | {"feature": feature})


def _space_table(space: FreeSpace) -> pa.Table:
    keys, counts = space.blocks
    return pa.table({axis: keys[:, i] for i, axis in enumerate(_AXES)} | {"counts": _vectors(counts)})


def _voxels(
    files: MapFiles, manifest: Mapping[str, Any], encoder: EncoderInfo, region: Float[np.ndarray, "2 3"] | None
) -> tuple[VoxelMap, Int64[np.ndarray, " n"] | None]:
    """Return the voxels, which are read when asked for, and which rows of the file they are; None for all."""
    size = float(manifest["voxel_size"])
    count, groups, inside, rows = int(manifest["counts"]["voxels"]), None, None, None
    if region is not None:
        groups, rows, inside = _inside(files, region, size)
        count = len(rows)
    read = _reader(files, encoder.dim, groups, inside)

    def space() -> FreeSpace:
        with _consistent(files.folder):
            table = files.table("space.parquet")
            blocks = np.stack([table[axis].to_numpy() for axis in _AXES], axis=1).astype(np.int32)
            return FreeSpace.from_blocks(size, blocks, _rows_of(table["counts"], 512))

    voxels = VoxelMap.stored(
        size, encoder.dim, count, read, free=space, contract=encoder.contract, num_classes=int(manifest["num_classes"])
    )
    return voxels, rows


def _keys(files: MapFiles, groups: list[int] | None) -> tuple[np.ndarray, ...]:
    """Return x, y, z of the voxels of all row groups, or some, once they are known to be in order."""
    table = files.table("voxels.parquet", list(_AXES), groups)
    axes = tuple(table[axis].to_numpy().astype(np.int32, copy=False) for axis in _AXES)
    ends = np.array([[a.min(initial=0), a.max(initial=0)] for a in axes], dtype=np.int32).T
    packed = pack_axes(*axes)
    if not packable(ends).all() or (packed[1:] <= packed[:-1]).any():
        raise MapError("voxel keys repeat, are too large or out of order", got=files, fix="rebuild the map")
    return (*axes, packed)


def _inside(
    files: MapFiles, region: Float[np.ndarray, "2 3"], size: float
) -> tuple[list[int], Int64[np.ndarray, " n"], Bool[np.ndarray, " m"]]:
    """Return the row groups that meet a region, the rows of the file in it, and which of the groups' rows they are."""
    groups = _groups(files, region, size)
    axes = _keys(files, groups)[:3]
    inside = (
        (low <= (a + 0.5) * size) & ((a + 0.5) * size < high) for a, (low, high) in zip(axes, region.T, strict=True)
    )
    chosen = np.logical_and.reduce(list(inside))
    with files.parquet("voxels.parquet") as file:
        lengths = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
    first = np.cumsum([0, *lengths])
    rows = np.concatenate([np.arange(first[g], first[g + 1]) for g in groups] or [first[:0]])
    return groups, rows[chosen], chosen


def _groups(files: MapFiles, region: Float[np.ndarray, "2 3"], size: float) -> list[int]:
    """Return the row groups whose range of x meets the region."""
    if region.shape != (2, 3) or not np.isfinite(region).all() or (region[0] >= region[1]).any():
        raise ConfigError("region is not a box", expected="lower and upper corner, metres", got=region.tolist())
    low, high = np.floor(region[:, 0] / size)
    with files.parquet("voxels.parquet") as file:
        at = [file.metadata.row_group(i).column(0).statistics for i in range(file.num_row_groups)]
    return [i for i, x in enumerate(at) if x is None or (x.max >= low and x.min <= high)]


def _rows_of(column: pa.ChunkedArray, width: int) -> np.ndarray:
    """Return a column of vectors as an array."""
    return column.combine_chunks().flatten().to_numpy(zero_copy_only=False).reshape(-1, width)


def _reader(
    files: MapFiles, dim: int, groups: list[int] | None, inside: np.ndarray | None
) -> Callable[[str], np.ndarray]:
    """Return what reads a column of the voxels by the name it has in `VoxelMap`."""

    def column(name: str) -> pa.ChunkedArray:
        table = files.table("voxels.parquet", [name], groups)
        if name not in table.column_names:
            raise MapError(f"map {files} contradicts itself", expected=f"a column {name}", got="none")
        return table[name]

    def plain(name: str) -> np.ndarray:
        values = column(name).to_numpy()
        return values if inside is None else values[inside]

    def read(name: str) -> np.ndarray:
        if name == "packed":
            packed = _keys(files, groups)[3]
            return packed if inside is None else packed[inside]
        if name == "features":
            row = plain("feature")
            vectors = _features(files, dim)
            if len(row) and not 0 <= int(row.min()) <= int(row.max()) < len(vectors):
                raise MapError(
                    "voxels point to features that are not there", expected=f"0..{len(vectors) - 1}", got=row.max()
                )
            return vectors[row].astype(np.float32)
        if name == "label_counts":
            chunk = column(name)
            values = _rows_of(chunk, chunk.type.list_size)
            return values if inside is None else values[inside]
        if name in _PARTS:
            values = np.stack([plain(part) for part in _PARTS[name]], axis=1)
            return values * _NORMAL_STEP if name == "normals" else values
        if name == "color_weight" and "color_weight" not in files.names("voxels.parquet"):
            return plain("weight")
        values = plain(name)
        return values.astype(np.float32) if name in ("agreement", "view_score") else values.copy()

    return read


def _features(files: MapFiles, dim: int) -> Float32[np.ndarray, "t c"]:
    """Return the feature table."""
    vectors = files.table("features.parquet")["feature"]
    width = vectors.type.list_size
    features = _rows_of(vectors, width).astype(np.float32)
    bad = int((~np.isfinite(features)).any(axis=1).sum())
    if bad or width != dim:
        raise MapError(
            "features of the map are not usable",
            expected=f"finite vectors of length {dim}",
            got=f"length {width}, {bad} of {len(features)} with NaN or infinity",
            fix="rebuild the map",
        )
    return features
