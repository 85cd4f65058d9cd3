"""`openvocab-occ file`: what is in a map, and maps out of maps."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from openvocab_occ.cli.output import console, print_json
from openvocab_occ.objects.scene_map import SceneMap

_Map = Annotated[Path, tyro.conf.Positional]


def info(map: _Map, *, json: bool = False) -> None:
    """Say what a map holds, without reading its voxels' features.

    Args:
        map: A saved map, NAME.ovmap.
        json: Print one JSON object.
    """
    from openvocab_occ.objects.ovmap import read_manifest

    scene, manifest = SceneMap.open(map), read_manifest(map)
    voxels = scene.voxels
    ends = [voxels.keys.min(axis=0), voxels.keys.max(axis=0) + 1] if len(voxels) else [np.zeros(3)] * 2
    size = sum(entry["bytes"] for entry in manifest["files"].values())
    report = {
        "map": str(map), "voxels": len(voxels), "voxel_size_m": voxels.voxel_size,
        "bounds_m": [(end * voxels.voxel_size).round(3).tolist() for end in ends],
        "objects": len(scene.objects), "frames": len(scene.frames), "dynamic_layers": len(scene.dynamic),
        "encoder": manifest["encoder"], "features": {"vectors": manifest["counts"]["features"], **manifest["features"]},
        "bytes": size, "bytes_per_voxel": round(size / max(len(voxels), 1), 1), "provenance": manifest["provenance"],
        "format_version": manifest["format_version"],
    }  # fmt: skip
    _print(report, json=json)


def verify(map: _Map, *, json: bool = False) -> None:
    """Hash every file of a map and read every page; fails if anything is damaged.

    Args:
        map: A saved map.
        json: Print one JSON object.
    """
    from openvocab_occ.objects.ovmap import verify_map

    report = verify_map(map)
    _print({"map": str(map), "whole": True, "voxels": report["voxels"], "bytes": report["bytes"],
            "files": len(report["files"])}, json=json)  # fmt: skip


def merge(a: _Map, b: _Map, *, out: Path, align: bool = False, json: bool = False) -> None:
    """Merge two drives of one place.

    Args:
        a: A saved map; its frame is that of the result.
        b: Another, of the same encoder and voxel size.
        out: The map to write.
        align: Bring b to a by ICP first; refused when it fits poorly.
        json: Print one JSON object.
    """
    from openvocab_occ.pipeline.combine import merge as merge_maps

    merged = merge_maps(SceneMap.open(a), SceneMap.open(b), align=align)
    merged.scene.save(out)
    report: dict[str, Any] = {"map": str(out), "voxels": len(merged.scene.voxels), "gone": merged.gone}
    if merged.alignment is not None:
        fit = merged.alignment
        report |= {"overlap": fit.overlap, "rmse_m": fit.rmse_m, "T_a_b": fit.T_a_b.tolist()}
    _print(report, json=json)


def diff(a: _Map, b: _Map, *, json: bool = False) -> None:
    """Say what appeared, vanished or changed from one map to another, where both looked.

    Args:
        a: The earlier map.
        b: The later one, of the same frame, encoder and voxel size.
        json: Print one JSON object.
    """
    from openvocab_occ.pipeline.compare import diff as compare

    one, other = SceneMap.open(a), SceneMap.open(b)
    found = compare(one, other)
    report = found.to_dict()
    for name, scene in (("objects_appeared", other), ("objects_vanished", one)):
        report[name] = [
            {"id": id, "label": scene.objects[id].label, "center": scene.objects[id].center.round(2).tolist()}
            for id in getattr(found, name)
        ]
    _print(report, json=json)


def crop(
    map: _Map,
    *,
    lower: tuple[float, float, float],
    upper: tuple[float, float, float],
    out: Path,
    json: bool = False,
) -> None:
    """Cut a box out of a map.

    Args:
        map: A saved map.
        lower: Lower corner, metres in the world.
        upper: Upper corner.
        out: The map to write.
        json: Print one JSON object.
    """
    scene = SceneMap.open(map, region=np.array([lower, upper], dtype=np.float64))
    scene.save(out)
    _print({"map": str(out), "voxels": len(scene.voxels), "objects": len(scene.objects)}, json=json)


def concat(maps: Annotated[tuple[Path, ...], tyro.conf.Positional], *, out: Path, json: bool = False) -> None:
    """Put maps that share no voxel together, such as crops of one.

    Args:
        maps: Saved maps of one frame.
        out: The map to write.
        json: Print one JSON object.
    """
    from openvocab_occ.pipeline.combine import concat as put_together

    scene = put_together([SceneMap.open(map) for map in maps])
    scene.save(out)
    _print({"map": str(out), "voxels": len(scene.voxels), "objects": len(scene.objects)}, json=json)


def convert(source: _Map, target: _Map, *, json: bool = False) -> None:
    """Write a map or points in another format: .ply .pcd .las .laz .bt .rrd .openlex3d.

    Args:
        source: A saved map, or points: .ply .pcd .las .laz .bt .openlex3d.
        target: The file to write; its ending says the format.
        json: Print one JSON object.
    """
    from openvocab_occ.export.formats import convert as convert_file

    written = convert_file(source, target)
    files = [written] if written.is_file() else [file for file in written.rglob("*") if file.is_file()]
    _print({"file": str(written), "bytes": sum(file.stat().st_size for file in files)}, json=json)


def _print(report: dict[str, Any], *, json: bool) -> None:
    if json:
        print_json(report)
        return
    width = max(map(len, report))
    for name, value in report.items():
        shown = f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
        console().print(f"{name:<{width}}  {shown}", markup=False)
