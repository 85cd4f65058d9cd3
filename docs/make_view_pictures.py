"""Make the pictures of docs/views.md from maps of the synthetic city.

Usage: python docs/make_view_pictures.py CITY.ovmap [OUT]

    openvocab-occ map city any --encoder models/demo/segmenter.onnx --frames 30 --out CITY.ovmap
"""

import sys
import tempfile
from pathlib import Path

from openvocab_occ.export.brief import brief_route
from openvocab_occ.export.views import Lookout, choose, export_views
from openvocab_occ.io.images import read_image, write_image
from openvocab_occ.objects.scene_map import SceneMap


def main() -> None:
    scene = SceneMap.open(sys.argv[1])
    out = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).parent / "views"
    out.mkdir(exist_ok=True)
    brief = brief_route(scene, length=100.0)
    if brief.junctions:
        station = max(brief.junctions[0].station - 25.0, 0.0)
        show(scene, choose.ahead(scene, station, route=brief.route), out / "junction")
    trucks = [one for one in brief.narrow if one.label == "truck"]
    if trucks:
        show(scene, choose.ahead(scene, max(trucks[0].station - 14.0, 0.0), route=brief.route), out / "narrow")
    parked = [node for node in scene.objects.nodes if node.label in ("parking lot", "row of parked cars")]
    if parked:
        inside = [o.id for o in scene.objects if o.id in parked[0].children and o.label == "car"]
        largest = max(inside, key=lambda id: len(scene.objects[id].voxels))
        show(scene, choose.looking_at(scene, largest), out / "parking")


def show(scene: SceneMap, stand: Lookout, path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        bundle = export_views(scene, Path(folder) / "bundle", viewpoints=stand)
        for name, ending in (("view_marked.png", "marked"), ("bev_marked.png", "bev")):
            write_image(path.with_name(f"{path.name}_{ending}.png"), read_image(bundle.paths[name]))


if __name__ == "__main__":
    main()
