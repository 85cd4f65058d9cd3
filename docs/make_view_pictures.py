"""Make the pictures of docs/views.md from two maps of the synthetic city.

Usage: python docs/make_view_pictures.py STREET.ovmap LOT.ovmap [OUT]

    openvocab-occ map city any --encoder models/demo/segmenter.onnx --frames 30 --out STREET.ovmap
    openvocab-occ map city any --encoder models/demo/segmenter.onnx --frames 22 --option route=1 --out LOT.ovmap
"""

import sys
import tempfile
from pathlib import Path

from openvocab_occ.export.brief import brief_route
from openvocab_occ.export.views import Lookout, choose, export_views
from openvocab_occ.io.images import read_image, write_image
from openvocab_occ.objects.scene_map import SceneMap


def main() -> None:
    street, lot = SceneMap.open(sys.argv[1]), SceneMap.open(sys.argv[2])
    out = Path(sys.argv[3]) if len(sys.argv) > 3 else Path(__file__).parent / "views"
    out.mkdir(exist_ok=True)
    brief = brief_route(street, length=100.0)
    junction = max(brief.junctions[0].station - 25.0, 0.0)
    show(street, choose.ahead(street, junction, route=brief.route), out / "junction")
    truck = next(one for one in brief.narrow if one.label == "truck" and one.until < brief.route.driven)
    show(street, choose.looking_at(street, truck.id), out / "narrow")
    rows = [node for node in lot.objects.nodes if node.label == "row of parked cars"]
    parked = max(rows, key=lambda node: len(node.children)).children
    show(lot, choose.covering(lot, parked).lookouts[0], out / "parking", above=False)


def show(scene: SceneMap, stand: Lookout, path: Path, *, above: bool = True) -> None:
    with tempfile.TemporaryDirectory() as folder:
        bundle = export_views(scene, Path(folder) / "bundle", viewpoints=stand)
        for name, ending in (("view_marked.png", "marked"), ("bev_marked.png", "bev"))[: 1 + above]:
            write_image(path.with_name(f"{path.name}_{ending}.png"), read_image(bundle.paths[name]))


if __name__ == "__main__":
    main()
