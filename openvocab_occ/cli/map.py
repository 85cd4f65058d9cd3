"""`openvocab-occ map`."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from openvocab_occ.cli.output import console, print_json, progress
from openvocab_occ.cli.source import Source
from openvocab_occ.io.files import output_folder
from openvocab_occ.objects.ovmap import MANIFEST
from openvocab_occ.objects.scene_map import SceneMap

if TYPE_CHECKING:
    from openvocab_occ.viewer import Viewer


def build(
    source: Annotated[Source, tyro.conf.OmitArgPrefixes],
    *,
    encoder: Path,
    out: Path,
    card: Path | None = None,
    voxel_size: float | None = None,
    max_depth: float = 60.0,
    sandbox: bool = False,
    watch: bool = False,
    port: int = 8080,
    json: bool = False,
) -> None:
    """Turn a drive and an ONNX model into a map.

    Args:
        source: The drive.
        encoder: Your 2D model, an ONNX file.
        out: The map to write, a folder called NAME.ovmap.
        card: The model's card, if it does not lie beside it as MODEL.card.yaml.
        voxel_size: Edge of a map voxel in metres; that of the occupancy grid by default.
        max_depth: Pixels beyond this z-depth are not lifted, metres.
        sandbox: Run the model in a child process with limited memory, which can write no file.
        watch: Show the map in the web browser while it grows, and serve it when it is done, until Ctrl-C.
        port: Port of that page.
        json: Print one JSON object.
    """
    from openvocab_occ.pipeline.build import MapBuilder, build_map
    from openvocab_occ.segmentation.onnx import load_encoder

    started = time.perf_counter()
    output_folder(out, marker=MANIFEST)
    model = load_encoder(encoder, card, sandbox=sandbox)
    viewer = None
    sequence = source.load()
    with progress("mapping") as advance:
        if watch:
            from openvocab_occ.objects import Provenance
            from openvocab_occ.viewer.live import view_build

            made = Provenance(source=sequence.source, name=sequence.name, synthetic=sequence.synthetic)
            builder = MapBuilder(model, voxel_size=voxel_size, max_depth=max_depth, provenance=made)
            viewer = view_build(sequence, model, builder, port=port, started=_announce, progress=advance)
            scene = viewer.scene
        else:
            scene = build_map(sequence, model, voxel_size=voxel_size, max_depth=max_depth, progress=advance)
    scene.save(out)
    report = {"map": str(out), "seconds": round(time.perf_counter() - started, 2), **summary(scene, out)}
    print_json(report) if json else _print(report)
    if viewer is not None:
        viewer.wait()


def _announce(viewer: "Viewer") -> None:
    Console(stderr=True).print(f"the map so far at [bold]{viewer.url}[/bold]")


def summary(scene: SceneMap, path: Path) -> dict[str, Any]:
    """Return the numbers that describe a map."""
    labels: dict[str, int] = {}
    for thing in scene.objects:
        labels[thing.label] = labels.get(thing.label, 0) + 1
    return {
        "frames": len(scene.frames),
        "voxels": len(scene.voxels),
        "voxel_size_m": scene.voxels.voxel_size,
        "objects": len(scene.objects),
        "objects_by_label": dict(sorted(labels.items(), key=lambda item: (-item[1], item[0]))),
        "bytes": sum(file.stat().st_size for file in path.rglob("*") if file.is_file()),
        "encoder": scene.encoder.name,
        "synthetic": scene.provenance.synthetic,
    }


def _print(report: dict[str, Any]) -> None:
    out = console()
    out.print(
        f"[bold]{report['map']}[/bold]  {report['frames']} frames, {report['voxels']:,} voxels of "
        f"{report['voxel_size_m']:g} m, {report['objects']} objects, {report['bytes'] / 1e6:.1f} MB, "
        f"{report['seconds']:.1f} s" + ("  (synthetic data)" if report["synthetic"] else "")
    )
    table = Table("label", "objects", box=None, pad_edge=False)
    table.columns[1].justify = "right"
    for label, count in report["objects_by_label"].items():
        table.add_row(label, str(count))
    out.print(table)
