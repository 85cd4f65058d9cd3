"""Objects for other programs: a scene graph as JSON, boxes on the globe as GeoJSON, boxes in 3D as glTF."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from openvocab_occ.errors import ConfigError
from openvocab_occ.io.files import PathLike
from openvocab_occ.objects.ground import Junction
from openvocab_occ.objects.regions import LaneGraph, find_regions
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import OBJECT, SceneObject

FORMAT = "openvocab_occ.scene_graph"
VERSION = 1
_COLORS = {"moving": (230, 60, 50), "stopped": (240, 150, 40), "parked": (60, 110, 230), "fixed": (120, 130, 120),
           "unknown": (170, 170, 170)}  # fmt: skip
_A, _F = 6378137.0, 1 / 298.257223563  # WGS 84: half of the equator's diameter in metres, flattening


@dataclass(frozen=True, kw_only=True)
class GeoReference:
    """Where on the globe a map's origin lies, and how the map is turned."""

    lat: float
    """Degrees north (WGS 84)."""
    lon: float
    """Degrees east."""
    alt: float = 0.0
    """Metres above the ellipsoid."""
    heading: float = 0.0
    """Radians from east, counter-clockwise, to the map's x axis."""

    def __post_init__(self) -> None:
        good = -90 < self.lat < 90 and -180 <= self.lon <= 180 and np.isfinite(self.alt) and np.isfinite(self.heading)
        if not good:
            raise ConfigError(
                "reference is not on the globe", expected="latitude within 90 and longitude within 180 degrees",
                got=(self.lat, self.lon, self.alt, self.heading),
            )  # fmt: skip

    def to_globe(self, points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Return longitude, latitude (degrees) and altitude of points of the map.

        Exact on the ellipsoid's tangent plane: east and north go through the radii of curvature at the origin. Within
        5 km of it that errs by a few metres at most.
        """
        c, s = np.cos(self.heading), np.sin(self.heading)
        east, north = points[:, 0] * c - points[:, 1] * s, points[:, 0] * s + points[:, 1] * c
        e2, phi = _F * (2 - _F), np.deg2rad(self.lat)
        bend = 1 - e2 * np.sin(phi) ** 2
        meridian, normal = _A * (1 - e2) / bend**1.5, _A / bend**0.5
        lat = self.lat + np.rad2deg(north / (meridian + self.alt))
        lon = self.lon + np.rad2deg(east / ((normal + self.alt) * np.cos(phi)))
        return np.stack([lon, lat, self.alt + points[:, 2]], axis=1)


def georeference(lat: float, lon: float, alt: float = 0.0, heading: float = 0.0) -> GeoReference:
    """Say where a map's origin lies: degrees, metres, and radians from east to the map's x axis."""
    return GeoReference(lat=lat, lon=lon, alt=alt, heading=heading)


def node_dict(node: SceneObject) -> dict[str, Any]:
    """Return what JSON can hold of a node: all but voxels, points and embeddings."""
    views = [{"frame": v.frame, "view": v.view, "box": list(v.box)} for v in node.views]
    return {
        "id": node.id, "level": node.level, "label": node.label, "score": round(node.score, 4), "parent": node.parent,
        "children": list(node.children), "state": node.state, "evidence": node.evidence,
        "confidence": round(node.confidence, 4), "center": np.round(node.center, 3).tolist(),
        "size": np.round(node.box.size, 3).tolist(), "yaw": round(node.box.yaw, 4),
        "heading": None if node.heading is None else round(node.heading, 4), "speed": round(node.speed, 3),
        "times_seen": node.times_seen, "first_seen": node.first_seen, "last_seen": node.last_seen,
        "agreement": round(node.agreement, 4), "names": [list(name) for name in node.names],
        "voxels": len(node.voxels), "views": views,
    }  # fmt: skip


def lane_graph(scene: SceneMap) -> LaneGraph:
    """Return the junctions of a map's roads and the stretches between them, told from its ground and its drive."""
    path = np.array([frame.T_world_ego[:2, 3] for frame in scene.frames], dtype=np.float64).reshape(-1, 2)
    names = scene.class_names if len(scene.class_names) > 2 else scene.encoder.labels
    return find_regions(scene.voxels, names, path).lanes


def scene_graph(scene: SceneMap) -> dict[str, Any]:
    """Return the tree and the lane graph as plain data."""
    lanes = lane_graph(scene)
    return {
        "format": FORMAT, "format_version": VERSION, "frame": "world, z up", "units": "metres, seconds, radians",
        "synthetic": scene.provenance.synthetic,
        "nodes": [node_dict(node) for node in scene.objects.nodes],
        "lanes": {"junctions": [_junction(j) for j in lanes.junctions], "edges": [asdict(e) for e in lanes.edges]},
    }  # fmt: skip


def write_scene_graph(scene: SceneMap, path: PathLike) -> Path:
    """Write the scene graph as a JSON file."""
    target = Path(path)
    target.write_text(json.dumps(scene_graph(scene), ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
    return target


def geojson(scene: SceneMap, reference: GeoReference | None = None, *, level: str = OBJECT) -> dict[str, Any]:
    """Return the boxes of a level, seen from above, as a GeoJSON feature collection.

    With a reference, coordinates are longitude and latitude (RFC 7946). Without one they are metres of the map, and the
    collection says so under `crs`, which programs for globes do not read.
    """
    features = []
    for node in scene.objects.level(level):
        corners = node.box.corners[[0, 1, 2, 3, 0]]
        ring = corners[:, :2] if reference is None else reference.to_globe(corners)[:, :2]
        properties = {k: v for k, v in node_dict(node).items() if k not in ("views", "children")}
        ring = np.round(ring, 3 if reference is None else 8).tolist()
        features.append({"type": "Feature", "id": node.id, "properties": properties,
                         "geometry": {"type": "Polygon", "coordinates": [ring]}})  # fmt: skip
    collection: dict[str, Any] = {"type": "FeatureCollection", "features": features}
    if reference is None:
        collection["crs"] = {"type": "name", "properties": {"name": "local: metres, map frame, x and y, z up"}}
    return collection


def write_geojson(scene: SceneMap, path: PathLike, reference: GeoReference | None = None) -> Path:
    """Write the objects as a GeoJSON file."""
    target = Path(path)
    target.write_text(json.dumps(geojson(scene, reference), ensure_ascii=False, allow_nan=False) + "\n", "utf-8")
    return target


def write_gltf(objects: Iterable[SceneObject], path: PathLike) -> Path:
    """Write the boxes of objects, coloured by state, as a binary glTF file (`.glb`), y up as glTF wants it."""
    import trimesh
    from trimesh.visual import ColorVisuals

    target = Path(path)
    if target.suffix != ".glb":
        raise ConfigError("file name is not one of binary glTF", expected="NAME.glb", got=target.name)
    turn = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])  # z up to y up
    scene = trimesh.Scene()
    for node in objects:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = node.box.axes, node.center
        mesh = trimesh.creation.box(extents=np.maximum(node.box.size, 1e-3), transform=turn @ T)
        color = (*_COLORS.get(node.state, _COLORS["unknown"]), 255)
        mesh.visual = ColorVisuals(mesh, face_colors=color)
        name = f"{node.id} {node.label}"
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    if not scene.geometry:
        raise ConfigError("there is no object to write", expected="at least 1", got=0)
    target.write_bytes(scene.export(file_type="glb"))  # pyright: ignore[reportArgumentType]
    return target


def _junction(junction: Junction) -> dict[str, Any]:
    return {"center": list(junction.center), "kind": junction.kind, "arms": list(junction.arms)}
