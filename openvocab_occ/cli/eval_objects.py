"""`openvocab-occ eval objects`."""

from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.table import Table

from openvocab_occ.cli.output import console, print_json, progress


def objects(
    *,
    seeds: tuple[int, ...] = (201, 202),
    encoder: Path | None = None,
    features: Literal["encoder", "truth"] = "encoder",
    world: Literal["city", "street"] = "city",
    condition: str = "clear",
    route: int = 0,
    frames: int = 20,
    json: bool = False,
) -> None:
    """Build maps of made-up drives with true occupancy and judge their objects. All of it is synthetic.

    Args:
        seeds: Of the worlds; 1 to 199 were looked at while thresholds were chosen.
        encoder: The 2D model, an ONNX file; the shipped one by default.
        features: `truth` gives each pixel the vector of its true thing in place of a model's: the self-test.
        world: `city`, or `street` for the small one.
        condition: Of the city: clear, rain, night, fog or heavy traffic.
        route: Of the city.
        frames: Keyframes of each drive, two a second.
        json: Print one JSON object.
    """
    from openvocab_occ.datasets import load_sequence
    from openvocab_occ.datasets.city import City
    from openvocab_occ.datasets.street import street
    from openvocab_occ.evaluation.object_truth import CityTruth, StreetTruth
    from openvocab_occ.evaluation.objects import TruthEncoder, judge_objects
    from openvocab_occ.evaluation.region_truth import score_regions
    from openvocab_occ.segmentation.demo_models import demo_model, street_model
    from openvocab_occ.segmentation.onnx import load_encoder

    shipped = demo_model if world == "city" else street_model
    model = TruthEncoder() if features == "truth" else load_encoder(encoder or shipped())
    rows: list[dict[str, Any]] = []
    for seed in seeds:
        if world == "city":
            sequence = load_sequence("city", seed=seed, route=route, condition=condition, frames=frames)
            drive = City(seed).traversal(route, 0, condition)
            truth = CityTruth(drive)
        else:
            sequence, truth, drive = load_sequence("street", seed=seed, frames=frames), StreetTruth(street(seed)), None
        with progress(f"seed {seed}") as advance:
            report, scene = judge_objects(sequence, truth, model, progress=advance)
        row = {"seed": seed, **report.to_dict()}
        if drive is not None:
            row["regions"] = asdict(score_regions(scene, drive.town.plan))
        rows.append(row)
    if json:
        print_json({"synthetic": True, "world": world, "encoder": model.name, "condition": condition, "route": route,
                    "frames": frames, "drives": rows})  # fmt: skip
        return
    out = console()
    out.print(f"synthetic {world}, {condition}, {frames} frames each, features of {model.name}\n", markup=False)
    out.print(_table(rows))


def _table(rows: list[dict[str, Any]]) -> Table:
    columns = {
        "things": lambda r: f"{r['instances']['true_objects']}",
        "AP25": lambda r: f"{r['instances']['ap25']:.2f}",
        "AP50": lambda r: f"{r['instances']['ap50']:.2f}",
        "precision": lambda r: f"{r['instances']['precision50']:.2f}",
        "recall": lambda r: f"{r['instances']['recall50']:.2f}",
        "ODR": lambda r: f"{r['instances']['odr']:.2f}",
        "IDF1": lambda r: f"{r['identity']['idf1']:.2f}",
        "HOTA": lambda r: f"{r['identity']['hota']:.2f}",
        "state": lambda r: f"{r['state_accuracy']:.2f}",
        "center m": lambda r: f"{r['boxes']['center_m']:.2f}",
        "yaw deg": lambda r: f"{r['boxes']['yaw_deg']:.0f}",
        "s/frame": lambda r: f"{r['seconds_per_frame']:.2f}",
        "CPU s/frame": lambda r: f"{r['cpu_seconds_per_frame']:.2f}",
        "purity": lambda r: f"{r['regions']['purity']:.2f}" if "regions" in r else "",
        "junctions": lambda r: f"{r['regions']['right']} of {r['regions']['junctions']}" if "regions" in r else "",
    }
    table = Table("seed", *columns, box=None, pad_edge=False)
    for row in rows:
        table.add_row(str(row["seed"]), *(cell(row) for cell in columns.values()))
    if len(rows) > 1:
        means = []
        for cell in columns.values():
            try:
                means.append(f"{np.mean([float(cell(row)) for row in rows]):.2f}")
            except ValueError:
                means.append("")
        table.add_row("mean", *means)
    return table
