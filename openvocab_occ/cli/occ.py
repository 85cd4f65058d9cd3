"""`openvocab-occ occ train|eval|predict`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.table import Table

from openvocab_occ.cli.output import console, print_json, progress
from openvocab_occ.cli.source import Source
from openvocab_occ.errors import ConfigError


@dataclass(frozen=True)
class Drives:
    """Drives with occupancy labels."""

    kind: Annotated[str, tyro.conf.Positional]
    """The source: city, nuscenes, or another kind whose frames have occupancy."""
    path: Annotated[str, tyro.conf.Positional]
    """Its folder; for the city, any name."""
    drives: Path
    """Folder in which their samples are kept, made where they are not there; one for each size of voxels."""
    scene: Annotated[list[str], tyro.conf.UseAppendAction] = field(default_factory=list[str])
    """A scene of the source; may be given several times."""
    split: str | None = None
    """Of nuScenes: train or val, by Occ3D's annotations.json where it is; in place of --scene."""
    masks: str | None = None
    """Published camera masks, such as ROOT/gts/{scene}/{token}/labels.npz; computed by default."""
    cities: tuple[int, ...] = (100, 101, 102, 103)
    """Of the city: seeds."""
    visits: int = 3
    """Of the city: traversals of each."""
    frames: int = 12
    """Of the city: frames of each, 1.5 s apart."""

    def open(self, network: Any) -> dict[str, Any]:
        """Return the drives by place."""
        from openvocab_occ.datasets.registry import load_sequence
        from openvocab_occ.training.drives import CityPlan, by_place, city_drives
        from openvocab_occ.training.sources import drives_of

        with progress("samples", unit="drives") as advance:
            if self.kind == "city":
                plan = CityPlan(cities=self.cities, visits=self.visits, frames=self.frames)
                return by_place(city_drives(plan, network.config, self.drives, progress=advance))
            names = self.scene or (self._split() if self.split else [None])
            sequences = [lambda name=name: load_sequence(self.kind, self.path, scene=name) for name in names]
            found = drives_of(sequences, network.config, self.drives, masks=self.masks, progress=advance)
        return by_place(found)

    def _split(self) -> list[str]:
        from openvocab_occ.datasets.nuscenes_tables import find_tables, scene_names_of

        if self.kind != "nuscenes":
            raise ConfigError(f"{self.kind} has no splits", fix="name scenes by --scene")
        tables = find_tables(Path(self.path), None)
        return sorted(scene_names_of(tables.parent, tables, str(self.split)))


def train(
    drives: Annotated[Drives, tyro.conf.OmitArgPrefixes],
    *,
    out: Path,
    network: str = "flashocc-tiny",
    base: Path | None = None,
    steps: int = 1500,
    batch: int = 4,
    rate: float = 2e-3,
    schedule: Literal["cosine", "constant"] = "cosine",
    prior_from: Literal["mixed", "all", "other_scenes", "other_logs"] = "mixed",
    mask_from: Literal["prediction", "truth", "none"] = "prediction",
    dynamic: Literal["retained", "v1", "v2"] = "retained",
    fusion: Literal["cp", "concat_branch", "add_branch", "concat", "add", "nmp"] = "cp",
    head_only: bool = False,
    seed: int = 0,
    device: str = "cpu",
    json: bool = False,
) -> None:
    """Train a baseline, or with --base the memory around it; stopped, the same command goes on.

    Args:
        drives: What to learn from.
        out: Folder of `weights.pt`, `last.pt`, `log.jsonl` and, where it is installed, TensorBoard's files.
        network: flashocc-tiny, dhd-tiny, flashocc-micro, flashocc-m0, flashocc-m1 or dhd-s.
        base: Weights of the baseline: it is frozen, and alignment, fusion and head are trained.
        steps: Of the optimiser.
        batch: Frames a step; with memory, of different places.
        rate: Learning rate; published networks use 1e-4 (FlashOcc) and 2e-4 (DHD) with --schedule constant.
        schedule: After a linear warm-up.
        prior_from: With memory: whose writes a frame reads; mixed draws all or other_logs for each drive.
        mask_from: With memory: what counts as seen when a prediction is written.
        dynamic: With memory: what becomes of moving things in what is written.
        fusion: With memory.
        head_only: Train only the head, with an empty prior: the control.
        seed: Of weights and samples.
        device: cpu or cuda.
        json: Print one JSON object.
    """
    import torch

    from openvocab_occ.networks.lmop import Lmop
    from openvocab_occ.networks.predictor import load_network
    from openvocab_occ.training.latents import cache_latents
    from openvocab_occ.training.loop import TrainConfig, train_baseline
    from openvocab_occ.training.memory import train_memory
    from openvocab_occ.training.streams import MemoryConfig

    torch.manual_seed(seed)
    net = load_network(network, base, memory=base is not None, fusion=fusion, device=device)
    places = drives.open(net)
    flat = [drive for found in places.values() for drive in found]
    loss = "dhd" if network.startswith("dhd") else "flashocc"
    config = TrainConfig(
        steps=steps, batch=batch, rate=rate, schedule=schedule, loss=loss, seed=seed, flip=base is None,
    )  # fmt: skip
    with progress("training", unit="steps") as advance:
        if base is None:
            weights = train_baseline(net, flat, out, config, progress=advance)
        else:
            baseline = net.module.baseline if isinstance(net.module, Lmop) else net.module
            latents = cache_latents(baseline, flat, out / "latents")
            memory = MemoryConfig(prior_from=prior_from, mask_from=mask_from, dynamic=dynamic)
            weights = train_memory(
                net, places, latents, out, config, memory=memory, head_only=head_only, progress=advance
            )
    report = {"weights": str(weights), "network": network, "memory": base is not None, "steps": steps, "seed": seed,
              "drives": len(flat), "places": len(places), "synthetic": all(d.info.synthetic for d in flat)}  # fmt: skip
    if json:
        print_json(report)
    else:
        console().print(
            f"{weights}  {network}, {steps} steps on {len(flat)} drives of {len(places)} places", markup=False
        )


def evaluate(
    drives: Annotated[Drives, tyro.conf.OmitArgPrefixes],
    *,
    weights: Path,
    network: str = "flashocc-tiny",
    prior_from: Literal["none", "all", "other_scenes", "other_logs", "own_log"] = "other_logs",
    policy: Literal["newest", "overwrite", "ema", "bayes"] = "newest",
    mask_from: Literal["prediction", "truth", "none"] = "prediction",
    dynamic: Literal["retained", "v1", "v2"] = "retained",
    fusion: Literal["cp", "concat_branch", "add_branch", "concat", "add", "nmp"] = "cp",
    rays: bool = False,
    device: str = "cpu",
    json: bool = False,
) -> None:
    """Judge a network: mIoU, geometric IoU and RayIoU, with and without prior, by condition.

    Args:
        drives: What is predicted; each place in the order of its visits, with maps that begin empty.
        weights: Of `occ train`, or public ones.
        network: As it was trained.
        prior_from: Whose writes a frame reads, where the weights have a memory.
        policy: What becomes of older writes.
        mask_from: What counts as seen when a prediction is written.
        dynamic: What becomes of moving things in what is written.
        fusion: As it was trained.
        rays: Also RayIoU, 14,040 rays a frame.
        device: cpu or cuda.
        json: Print one JSON object.
    """
    from openvocab_occ.networks.lmop import Lmop
    from openvocab_occ.networks.predictor import has_memory, load_network
    from openvocab_occ.training.latents import cache_latents
    from openvocab_occ.training.memory import RayCounter, evaluate_memory
    from openvocab_occ.training.streams import MemoryConfig

    net = load_network(network, weights, memory=has_memory(weights), fusion=fusion, device=device)
    places = drives.open(net)
    flat = [drive for found in places.values() for drive in found]
    baseline = net.module.baseline if isinstance(net.module, Lmop) else net.module
    latents = cache_latents(baseline, flat, drives.drives / "latents")
    memory = MemoryConfig(
        prior_from=prior_from if isinstance(net.module, Lmop) else "none", policy=policy, mask_from=mask_from,
        dynamic=dynamic, misplaced=0.0,
    )  # fmt: skip
    counter = RayCounter(net) if rays else None
    with progress("evaluating") as advance:
        score = evaluate_memory(net, places, latents, memory, observer=counter, progress=advance)
    report: dict[str, Any] = {"weights": str(weights), "network": network, "prior_from": memory.prior_from,
                              "frames": sum(map(len, flat)), **score.summary()}  # fmt: skip
    if counter is not None:
        report["RayIoU"] = round(100 * counter.score.value, 2)
    report["synthetic"] = all(d.info.synthetic for d in flat)
    if json:
        print_json(report)
        return
    table = Table("voxels", "mIoU", "dynamic", "static", "geometric", box=None, pad_edge=False)
    rows = {
        "seen by a camera": report["seen"],
        "  with prior": report["with_prior"],
        "  without": report["without_prior"],
    }
    rows |= {f"  {name}": values for name, values in report["by_condition"].items()}
    for name, values in rows.items():
        table.add_row(name, *(f"{values[k]:.2f}" for k in ("mIoU", "dynamic", "static", "geometric")))
    console().print(table)
    rest = f"RayIoU {report['RayIoU']:.2f}; " if rays else ""
    console().print(f"{rest}{report['frames']} frames{'; synthetic data' if report['synthetic'] else ''}", markup=False)


def predict(
    source: Annotated[Source, tyro.conf.OmitArgPrefixes],
    *,
    weights: Path,
    out: Path,
    network: str = "flashocc-tiny",
    memory: Path | None = None,
    log: str | None = None,
    agent: str = "car-1",
    prior_from: Literal["all", "other_logs"] = "other_logs",
    public_quirks: bool = False,
    device: str = "cpu",
    json: bool = False,
) -> None:
    """Predict the occupancy of a drive: OUT/TOKEN.npz, the benchmark's submission format.

    Give them back to any command by `--occupancy 'OUT/{token}.npz'`.

    Args:
        source: The drive.
        weights: Of `occ train`, or public ones.
        out: Folder of the files.
        network: As it was trained.
        memory: The global map: read by networks with memory, and written; created if it is not there.
        log: Name of the drive in the map; the source's by default.
        agent: Name of the vehicle in the map.
        prior_from: Whose writes are read.
        public_quirks: For weights of FlashOCC and DHD as they are published.
        device: cpu or cuda.
        json: Print one JSON object.
    """
    from openvocab_occ.networks.predictor import has_memory, load_network
    from openvocab_occ.training.predict import MapUse, open_map, write_predictions

    net = load_network(network, weights, memory=has_memory(weights), device=device, public_quirks=public_quirks)
    sequence = source.load()
    city = None if memory is None else open_map(memory, net)
    use = None if memory is None else MapUse(log=log or sequence.name, agent=agent, prior_from=prior_from)
    with progress("predicting") as advance:
        files = write_predictions(net, sequence, out, city, use, cameras=net.cameras, progress=advance)
    report = {"out": str(out), "files": len(files), "pattern": f"{out}/{{token}}.npz", "memory": str(memory or ""),
              "synthetic": sequence.synthetic}  # fmt: skip
    if json:
        print_json(report)
    else:
        console().print(f"{len(files)} files; read them by --occupancy '{report['pattern']}'", markup=False)
