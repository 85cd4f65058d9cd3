"""What the page hands out as files: the map or a part of it in the formats of others, and view bundles."""

import io
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from openvocab_occ.errors import ConfigError
from openvocab_occ.export.formats.convert import convert
from openvocab_occ.export.scene_graph import write_geojson, write_gltf, write_scene_graph
from openvocab_occ.export.views import export_views
from openvocab_occ.geometry import Camera
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.pipeline.combine import only
from openvocab_occ.query.find import Answer

POINT_FORMATS = (".ply", ".pcd", ".las", ".laz", ".bt", ".rrd")
FOLDER_FORMATS = (".ovmap", ".openlex3d")
OBJECT_FORMATS = ("objects .json", "objects .geojson", "objects .glb")
FORMATS = (*POINT_FORMATS, *FOLDER_FORMATS, *OBJECT_FORMATS)


def converted(scene: SceneMap, chosen: Bool[np.ndarray, " n"] | None, format: str, stem: str) -> tuple[str, bytes]:
    """Return name and content of a file with a map, or with its chosen voxels and the objects they are of.

    Formats that are folders are zipped. Raises ConfigError where nothing is chosen, MissingExtraError for a format
    whose library is not installed.
    """
    if format not in FORMATS:
        raise ConfigError("format is not known", expected=", ".join(FORMATS), got=format)
    if chosen is not None and not chosen.any():
        raise ConfigError("nothing is selected", fix="click an object, ask a query or drag a region with Ctrl")
    part = scene if chosen is None else only(scene, chosen)
    with tempfile.TemporaryDirectory(prefix="openvocab_occ_") as scratch:
        folder = Path(scratch)
        if format in OBJECT_FORMATS:
            end = format.removeprefix("objects ")
            path = folder / f"{stem}{end}"
            if end == ".glb":
                write_gltf(part.objects, path)
            else:
                (write_geojson if end == ".geojson" else write_scene_graph)(part, path)
            return path.name, path.read_bytes()
        saved = part.save(folder / f"{stem}.ovmap")
        path = saved if format == ".ovmap" else convert(saved, folder / f"{stem}{format}")
        return (f"{path.name}.zip", zipped(path)) if path.is_dir() else (path.name, path.read_bytes())


def view_bundle(scene: SceneMap, answer: Answer | None, camera: Camera, stem: str) -> tuple[str, bytes]:
    """Return name and content of a zipped view bundle, as `export_views` writes it, from a camera."""
    with tempfile.TemporaryDirectory(prefix="openvocab_occ_") as scratch:
        folder = Path(scratch) / stem
        export_views(scene, folder, query=answer, viewpoints=camera)
        return f"{stem}.zip", zipped(folder)


def zipped(folder: Path) -> bytes:
    """Return a folder as a ZIP file; its own name is the top of every path in it."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, path.relative_to(folder.parent))
    return content.getvalue()
