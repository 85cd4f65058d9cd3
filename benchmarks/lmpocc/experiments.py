"""All pieces of the experiments, each done once: what has its file is not done again."""

import gzip
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.lmpocc.scales import Scale
from benchmarks.lmpocc.ways import LONG_TERM, Way, Weights, trained, ways
from openvocab_occ.io.files import written_file
from openvocab_occ.networks.lmop import LOGIT_REACH, Lmop
from openvocab_occ.networks.predictor import OccupancyNetwork, load_network
from openvocab_occ.networks.write_gate import load_write_gate
from openvocab_occ.occupancy import OCC3D_CLASSES
from openvocab_occ.training.drives import Drive, by_place, city_drives
from openvocab_occ.training.latents import Latents, cache_latents
from openvocab_occ.training.loop import FINAL, train_baseline
from openvocab_occ.training.memory import Writer, evaluate_memory, train_memory
from openvocab_occ.training.statistics import Row
from openvocab_occ.training.stream_map import Gate
from openvocab_occ.training.streams import MemoryConfig, Visit
from openvocab_occ.training.write_gate import record, train_write_gate

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Ground:
    """A frozen baseline, the drives, and its latents of them."""

    network: OccupancyNetwork
    weights: Path
    train: list[Drive]
    test: list[Drive]
    gate: list[Drive]
    latents: Latents


def run(
    scale: Scale, out: Path, *, device: str = "cpu", seeds: Sequence[int] | None = None, tell: Tell = print
) -> None:
    """Do what is not done yet, of some seeds only if asked: several processes may so share a folder."""
    grounds = {name: _ground(name, scale, out, device, tell) for name in scale.networks}
    for name, ground in grounds.items():
        home = out / name
        others = [n for n in scale.networks if n != name]
        _evaluate(home / "results" / "base.json.gz", ground.network, ground, MemoryConfig(prior_from="none"), tell)
        wanted = {w.name: w for w in trained(scale.tables)}
        for way in ways(scale.tables, others[0] if others else ""):
            weights = wanted[way.weights]
            for seed in seeds or scale.seeds:
                path = home / "results" / f"{way.name}-{seed}.json.gz"
                if path.exists():
                    continue
                file = _train(weights, ground, scale, home, seed, device, tell)
                network = load_network(name, file, memory=True, fusion=weights.fusion, device=device)
                gate = _gate(network, ground, scale, home, seed, tell) if way.gate else None
                _evaluate(path, network, ground, way.memory, tell, writer=_writer(way, ground, grounds),
                          blind=way.blind, gate=gate)  # fmt: skip


def _ground(name: str, scale: Scale, out: Path, device: str, tell: Tell) -> Ground:
    torch.manual_seed(scale.base.seed)
    network = load_network(name, device=device)
    tell(f"{name}: drives to train on")
    train = city_drives(scale.train, network.config, out / "drives")
    weights = out / name / "base" / FINAL
    config = replace(scale.base, loss="dhd" if name.startswith("dhd") else "flashocc")
    if not weights.exists():
        tell(f"{name}: baseline, {config.steps} steps")
        train_baseline(network, train, weights.parent, config, progress=_every(tell, name))
    network = load_network(name, weights, device=device)
    tell(f"{name}: drives to test on, and latents")
    test = city_drives(scale.test, network.config, out / "drives")
    gate = city_drives(scale.gate, network.config, out / "drives") if "gate" in scale.tables else []
    module = network.module
    if isinstance(module, Lmop):
        raise TypeError("a baseline has no memory")
    latents = cache_latents(module, [*train, *test, *gate], out / name / "latents")
    return Ground(network, weights, train, test, gate, latents)


def _train(weights: Weights, ground: Ground, scale: Scale, home: Path, seed: int, device: str, tell: Tell) -> Path:
    folder = home / f"{weights.name}-{seed}"
    if (folder / FINAL).exists():
        return folder / FINAL
    torch.manual_seed(seed)
    network = load_network(ground.network.name, ground.weights, memory=True, fusion=weights.fusion, device=device)
    tell(f"{ground.network.name}: {weights.name}, seed {seed}")
    return train_memory(
        network, by_place(ground.train), ground.latents, folder, replace(scale.memory, seed=seed),
        memory=weights.memory, head_only=weights.head_only, progress=_every(tell, weights.name),
    )  # fmt: skip


def _gate(network: OccupancyNetwork, ground: Ground, scale: Scale, home: Path, seed: int, tell: Tell) -> Gate:
    folder = home / f"gate-{seed}"
    weights = folder / FINAL
    if not weights.exists():
        tell(f"{ground.network.name}: write gate, seed {seed}")
        recorded = record(network, by_place(ground.gate), ground.latents, LONG_TERM)
        config = replace(scale.gate_training, seed=seed)
        train_write_gate(network, recorded, ground.latents, folder, config, progress=_every(tell, "gate"))
    return load_write_gate(weights).choose


def _evaluate(
    path: Path, network: OccupancyNetwork, ground: Ground, memory: MemoryConfig, tell: Tell, **how: Any
) -> None:
    if path.exists():
        return
    started = time.perf_counter()
    score = evaluate_memory(network, by_place(ground.test), ground.latents, memory, **how)
    with written_file(path) as scratch, gzip.open(scratch, "wt") as stream:
        json.dump(score.to_dict(), stream)
    tell(f"{ground.network.name}: {path.name.removesuffix('.json.gz')}, {time.perf_counter() - started:.0f} s")


def _writer(way: Way, ground: Ground, grounds: dict[str, Ground]) -> Writer | None:
    if not way.writer:
        return None
    if way.writer == "truth":
        return _true_logits
    source = ground if way.writer == "base" else grounds[way.writer]
    head = source.network.module.occ_head

    def write(visits: Sequence[Visit]) -> np.ndarray:
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            return head(source.latents.of([(v.drive, v.frame) for v in visits])).float().numpy()

    return write


def _true_logits(visits: Sequence[Visit]) -> np.ndarray:
    sure = LOGIT_REACH * np.eye(len(OCC3D_CLASSES), dtype=np.float32)
    return np.stack([sure[v.drive.labels[v.frame]] for v in visits])


def read_rows(path: Path) -> list[Row]:
    """Read an evaluation."""
    with gzip.open(path, "rt") as stream:
        return json.load(stream)


def _every(tell: Tell, name: str) -> Callable[[int, int], None]:
    return lambda done, total: tell(f"  {name} {done}/{total}") if done % max(total // 8, 1) == 0 else None
