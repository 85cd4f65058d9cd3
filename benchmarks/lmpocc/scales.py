"""How large an experiment is."""

from dataclasses import dataclass, field

from openvocab_occ.training.drives import CityPlan
from openvocab_occ.training.loop import TrainConfig
from openvocab_occ.training.write_gate import GateConfig


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Cities, networks, steps and seeds."""

    networks: tuple[str, ...] = ("flashocc-tiny",)
    train: CityPlan
    test: CityPlan
    """Other cities than those of `train`: geo-disjoint."""
    base: TrainConfig = field(default_factory=TrainConfig)
    memory: TrainConfig
    gate: CityPlan
    """Cities that neither network has seen, and that are not tested on: a write gate learns from mistakes."""
    gate_training: GateConfig = field(default_factory=GateConfig)
    seeds: tuple[int, ...] = (0, 1, 2)
    tables: tuple[str, ...] = ("II", "source", "policies")


_MEMORY = TrainConfig(steps=240, batch=8, rate=1e-3, warm_up=20, flip=False)
SMOKE = Scale(
    networks=("flashocc-micro",),
    train=CityPlan(cities=(100, 101), visits=2, frames=2, every=4),
    test=CityPlan(cities=(900, 901), visits=2, frames=2, every=4),
    base=TrainConfig(steps=2, batch=2), memory=TrainConfig(steps=2, batch=2, warm_up=1, flip=False), seeds=(0, 1),
    gate=CityPlan(cities=(800,), visits=2, frames=2, every=4), gate_training=GateConfig(steps=2, frames=1, writes=2),
)  # fmt: skip
REDUCED = Scale(
    networks=("flashocc-micro",),
    train=CityPlan(cities=(100, 101, 102, 103), visits=3, frames=10, every=3),
    test=CityPlan(cities=(900, 901, 902), visits=3, frames=10, every=3),
    base=TrainConfig(steps=150, batch=4, warm_up=20, save_every=25),
    memory=TrainConfig(steps=80, batch=4, rate=1e-3, warm_up=10, flip=False),
    gate=CityPlan(cities=(800, 801), visits=3, frames=10, every=3), gate_training=GateConfig(steps=60),
)  # fmt: skip
CORE = Scale(
    train=CityPlan(cities=tuple(range(100, 116))), test=CityPlan(cities=tuple(range(900, 908))),
    base=TrainConfig(steps=1600, batch=8, save_every=50), memory=_MEMORY, gate=CityPlan(cities=tuple(range(800, 804))),
    tables=("II", "gate", "source", "policies", "noise", "cross"),
)  # fmt: skip
FULL = Scale(
    networks=("flashocc-tiny", "dhd-tiny"),
    train=CityPlan(cities=tuple(range(100, 132)), visits=6, frames=20, every=2),
    test=CityPlan(cities=tuple(range(900, 912)), visits=6, frames=20, every=2),
    base=TrainConfig(steps=8000, batch=8), memory=TrainConfig(steps=1440, batch=8, rate=1e-3, flip=False),
    gate=CityPlan(cities=tuple(range(800, 808)), visits=6, frames=20, every=2), gate_training=GateConfig(steps=960),
    seeds=(0, 1, 2, 3, 4), tables=("II", "gate", "III", "V", "VI", "source", "policies", "noise", "cross"),
)  # fmt: skip
SCALES = {"smoke": SMOKE, "reduced": REDUCED, "core": CORE, "full": FULL}
