"""`openvocab-occ demo`."""

import time
from pathlib import Path

from openvocab_occ.cli.map import summary
from openvocab_occ.cli.output import console, print_json, progress

QUESTION = "parked trucks"
_SEED, _FRAMES = 7, 12


def demo(*, out: Path = Path("out/demo"), no_view: bool = False, port: int = 8080, json: bool = False) -> None:
    """Map a drive through the synthetic city with the shipped model, ask for "parked trucks", export a view, show it.

    Args:
        out: Folder for the map (city.ovmap) and the view bundle (view).
        no_view: Do not start the web viewer.
        port: Port of the web viewer.
        json: Print one JSON object.
    """
    from openvocab_occ.datasets.registry import load_sequence
    from openvocab_occ.export.views import export_views
    from openvocab_occ.pipeline.build import build_map
    from openvocab_occ.query.find import find
    from openvocab_occ.segmentation.demo_models import demo_model
    from openvocab_occ.segmentation.onnx import load_encoder

    started = time.perf_counter()
    encoder = load_encoder(demo_model())
    with progress("driving through a synthetic city") as advance:
        sequence = load_sequence("city", seed=_SEED, frames=_FRAMES)
        scene = build_map(sequence, encoder, progress=advance)
    path = out / "city.ovmap"
    scene.save(path)
    answer = find(scene, QUESTION, encoder)
    bundle = out / "view"
    export_views(scene, bundle, query=answer)
    report = {
        "map": str(path),
        "bundle": str(bundle),
        "seconds": round(time.perf_counter() - started, 2),
        **summary(scene, path),
        "answer": answer.to_dict(),
    }
    if json:
        print_json(report)
    else:
        say = console().print
        say(f"[bold]{path}[/bold]  {report['voxels']:,} voxels, {report['objects']} objects of a synthetic city, "
            f"{report['seconds']:.1f} s")  # fmt: skip
        say(answer.explain(), markup=False)
        say(f"[bold]{bundle}[/bold]  a rendered view for a person or a vision-language model")
    if not no_view:
        from openvocab_occ.viewer import server

        running = server.view(scene, encoder, sequence=sequence, port=port, block=False)
        if not json:
            console().print(f"the map at [bold]{running.url}[/bold]  (Ctrl-C ends)")
        running.wait()
