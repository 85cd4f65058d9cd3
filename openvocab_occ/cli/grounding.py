"""`openvocab-occ eval grounding` and `openvocab-occ bench query`."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.table import Table

from openvocab_occ.cli.output import console, print_json, progress
from openvocab_occ.errors import ConfigError

if TYPE_CHECKING:
    from openvocab_occ.datasets.frame import Frame
    from openvocab_occ.evaluation.grounding import Outcome
    from openvocab_occ.occupancy import OccupancyGrid


def grounding(
    *,
    seeds: tuple[int, ...] = (2100, 2101, 2102, 2103),
    on: Literal["drive", "truth"] = "drive",
    encoder: Path | None = None,
    condition: str = "clear",
    occupancy: Literal["oracle", "perceived", "network"] = "oracle",
    weights: Path | None = None,
    network: str = "flashocc-tiny",
    visits: int = 0,
    frames: int = 20,
    misses: bool = False,
    json: bool = False,
) -> None:
    """Judge answers about the synthetic city against its truth, by category of question.

    Args:
        seeds: Of the towns, and of the questions about them. Thresholds were chosen on 3100 to 3199.
        on: `drive`: maps of drives by a model. `truth`: maps of the truth itself, so that what is below 100 % is the
            fault of the queries alone.
        encoder: The 2D model of a drive, an ONNX file; the shipped one by default.
        condition: Of a drive: clear, rain, night, fog or heavy traffic.
        occupancy: Of a drive: `oracle` is the true grid, `perceived` has errors like a network's, `network` is what the
            network of --weights predicts from the images.
        weights: Of `occ train`, for --occupancy network.
        network: As it was trained.
        visits: Where it has a memory: traversals by others, written to a map that the drive then reads.
        frames: Keyframes of a drive, two a second.
        misses: Print the questions that went wrong.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.grounding import calibration_of, judge_truth, summarize
    from openvocab_occ.evaluation.grounding_drive import drive_city, judge_drive
    from openvocab_occ.evaluation.segmenter import lexicon_of
    from openvocab_occ.segmentation.demo_models import demo_model
    from openvocab_occ.segmentation.onnx import load_encoder

    outcomes: "list[Outcome]" = []
    if on == "truth":
        with progress("asking", unit="towns") as advance:
            for done, seed in enumerate(seeds, start=1):
                outcomes += judge_truth([seed])
                advance(done, len(seeds))
    else:
        path = encoder or demo_model()
        model, words = load_encoder(path), lexicon_of(path)
        for seed in seeds:
            source = (
                occupancy if occupancy != "network" else _network(weights, network, seed, condition, frames, visits)
            )
            with progress(f"city {seed}") as advance:
                drive = drive_city(seed, model, condition=condition, occupancy=source, frames=frames, progress=advance)
            outcomes += judge_drive(drive, model, seed, synonyms=words)
    scores = summarize(outcomes)
    wrong = [o for o in outcomes if not o.right]
    facts = {"seeds": list(seeds), "synthetic": True, "map": on, "ece": calibration_of(outcomes)}
    if on == "drive":
        facts |= {"encoder": model.name, "condition": condition, "occupancy": occupancy, "frames": frames}
        facts |= {"network": network, "weights": str(weights), "visits": visits} if occupancy == "network" else {}
    if json:
        report = {name: asdict(score) for name, score in scores.items()}
        listed = [o.to_dict() for o in wrong] if misses else []
        print_json({**facts, "scores": report, **({"misses": listed} if misses else {})})
        return
    table = Table("category", "questions", "Acc@.25", "mAP", "verdict", "count", "within one", "false found", box=None)
    for name, score in scores.items():
        counts = (score.count_exact, score.count_within_one, score.false_found)
        shares = (score.accuracy["0.25"], score.mean_precision, score.verdicts, *counts)
        table.add_row(name, str(score.questions), *(f"{share:.1%}" for share in shares))
    what = f"drives, {condition}, {occupancy} occupancy, {frames} frames each," if on == "drive" else "the truth"
    console().print(f"maps of {what} of the synthetic city, seeds {', '.join(map(str, seeds))}")
    console().print(table)
    if facts["ece"] is not None:
        console().print(f"expected calibration error {facts['ece']:.3f}")
    for o in wrong if misses else []:
        console().print(f"{o.question.category}: {o.question.text!r}: {o.verdict}, {o.count} named, "
                        f"{len(o.question.wanted)} there, IoU {o.iou:.2f}", markup=False)  # fmt: skip


def _network(
    weights: Path | None, name: str, seed: int, condition: str, frames: int, visits: int
) -> "Callable[[Frame], OccupancyGrid]":
    from tempfile import TemporaryDirectory

    from openvocab_occ.datasets.registry import load_sequence
    from openvocab_occ.networks.predictor import has_memory, load_network
    from openvocab_occ.training.predict import MapUse, occupancy_of, open_map, predictions

    if weights is None:
        raise ConfigError("a network needs its weights", expected="--weights of occ train", fix="--occupancy oracle")
    net = load_network(name, weights, memory=has_memory(weights))
    if not visits:
        return occupancy_of(net)
    if not net.memory:
        raise ConfigError("these weights have no memory", got=f"--visits {visits}", fix="leave --visits out")
    folder = TemporaryDirectory(prefix="openvocab-occ-")
    city = open_map(Path(folder.name) / "city.tiles", net)
    for visit in range(1, visits + 1):
        drive = load_sequence("city", seed=seed, traversal=visit, condition=condition, frames=frames)
        with progress(f"city {seed}, visit {visit} by another") as advance:
            use = MapUse(log=f"visit-{visit}", agent=f"car-{visit}")
            for done, _ in enumerate(predictions(net, drive, city, use), start=1):
                advance(done, frames)
    read = occupancy_of(net, city)

    def predict(frame: "Frame", _kept: object = folder) -> "OccupancyGrid":  # the map lives as long as who reads it
        return read(frame)

    return predict


def bench_query(*, voxels: int = 1_000_000, dim: int = 512, objects: int = 100_000, json: bool = False) -> None:
    """Time queries against plain matrix products.

    Args:
        voxels: Rows of the feature table.
        dim: Its columns.
        objects: Of the made-up map that is asked.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.grounding_bench import time_queries

    times = time_queries(voxels=voxels, dim=dim, objects=objects)
    if json:
        print_json(asdict(times) | {"ratio": times.ratio})
        return
    out = console()
    took = f"{times.score * 1e3:.0f} ms, {times.ratio:.2f} x torch ({times.threads} threads)"
    out.print(f"scoring {voxels:,} voxels of {dim}: {took}")
    for name in ("find_noun", "find_parked", "find_relation"):
        out.print(f"{name.replace('_', ' ')} among {objects:,} objects: {getattr(times, name) * 1e3:.1f} ms")
