"""What the global map is good for, shown in the demo city with a stand-in for perception: all of it synthetic."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32

from openvocab_occ.datasets.city.city import City
from openvocab_occ.datasets.city.keyframes import labels
from openvocab_occ.datasets.city.labels import Labels
from openvocab_occ.datasets.city.oracle import perceive
from openvocab_occ.evaluation.occupancy import OccupancyScore
from openvocab_occ.geometry import GridSpec, pose
from openvocab_occ.memory import TileMap
from openvocab_occ.memory.fold import FoldConfig, rebuild
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_FREE, OccupancyGrid

_DAY = 86400.0
_MANMADE, _ROAD = OCC3D_CLASSES.index("manmade"), OCC3D_CLASSES.index("driveable surface")
_FOLDS = ("newest", "bayes", "ema")
_PASSES = 2  # of the map that is read with wrong poses


@dataclass(frozen=True)
class Street:
    """Keyframes of the demo city's first route, the same of every traversal."""

    seed: int = 11
    frames: tuple[int, ...] = (8, 12, 16, 20, 24)

    def keyframes(self, city: City, number: int, condition: str) -> Iterator[tuple[int, Labels]]:
        """Yield the numbers and the truth of a traversal's keyframes."""
        drive = city.traversal(0, number, condition)
        for index in self.frames:
            yield index, labels(drive, index)


def passes(folder: Path, *, street: Street | None = None, count: int = 4) -> dict[str, Any]:
    """Drive a street `count` times by day; judge the map after each pass by one more drive, by day and at night.

    mIoU in percent over the voxels that the cameras of that last drive see and that the map knew after one pass,
    against the truth of that drive: what was parked elsewhere then counts against the map.
    """
    street = street or Street()
    town = City(street.seed)
    city = TileMap.create(folder / "passes.tiles", OCC3D_CLASSES)
    for number in range(count):
        for index, truth in street.keyframes(town, number, "clear"):
            seen = perceive(truth, seed=_seed(street, number, index))
            city.write(_logits(seen), truth.mask_camera, seen.T_world_grid, seen.spec,
                       stamp=number * _DAY + index, agent=f"car-{number + 1}", log=f"day-{number + 1}")  # fmt: skip
    tests = [(i, t) for i, t in street.keyframes(town, count, "clear")]
    masks: list[np.ndarray] = []
    report: dict[str, Any] = {"synthetic": True, "seed": street.seed, "keyframes": len(street.frames), "by_pass": []}
    for number in range(count):
        row: dict[str, Any] = {"passes": number + 1}
        for policy in _FOLDS:
            path = folder / f"{policy}-{number}.tiles"
            rebuild(city, out=path, until=number * _DAY + 1000, policy=policy)
            priors = [TileMap.open(path).read(t.grid.T_world_grid, t.grid.spec) for _, t in tests]
            if not masks:
                masks = [prior.known & t.mask_camera for prior, (_, t) in zip(priors, tests, strict=True)]
                report["known_after_one_pass"] = _mean(
                    [m.sum() / t.mask_camera.sum() for m, (_, t) in zip(masks, tests, strict=True)]
                )
            row[policy] = _score([p.logits for p in priors], [t for _, t in tests], masks)
        report["by_pass"].append(row)
    for condition in ("clear", "night"):
        report[condition] = _conditions(folder / f"bayes-{count - 1}.tiles", tests, masks, condition, street)
    return report


def _conditions(
    path: Path, tests: Sequence[tuple[int, Labels]], masks: Sequence[np.ndarray], condition: str, street: Street
) -> dict[str, Any]:
    """Judge what is seen in a condition alone, the prior alone, and their sum."""
    city, truths = TileMap.open(path), [t for _, t in tests]
    now = [_centred(_logits(perceive(t, condition, seed=_seed(street, 99, i)))) for i, t in tests]
    prior = [city.read(t.grid.T_world_grid, t.grid.spec).logits for t in truths]
    ways = {"seen": now, "prior": prior, "seen and prior": [a + b for a, b in zip(now, prior, strict=True)]}
    return {name: _score(logits, truths, masks) for name, logits in ways.items()}


def pose_noise(
    folder: Path, *, street: Street | None = None, metres: Sequence[float] = (0.0, 0.2, 0.4, 0.7, 1.0),
    degrees: Sequence[float] = (0.0, 0.5, 1.0, 2.0),
) -> dict[str, Any]:  # fmt: skip
    """Read a map at poses that are off by so much, in directions drawn for each keyframe.

    The map is of two passes, folded by `bayes`. `prior` is the mIoU in percent of the prior alone, `fused` with what is
    seen by day, `written` of a map whose second pass was off by that much when it was written, read where it should be
    (for the first of `degrees`).
    """
    street = street or Street(frames=(8, 16, 24))
    town = City(street.seed)
    drives = [[*street.keyframes(town, number, "clear")] for number in range(_PASSES + 1)]
    last = drives.pop()
    rng = np.random.default_rng(street.seed)
    turns = {index: (rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0])) for index in street.frames}
    seen = [(n, i, t, perceive(t, seed=_seed(street, n, i))) for n, drive in enumerate(drives) for i, t in drive]

    def moved(index: int, T: np.ndarray, off: float, turn: float) -> np.ndarray:
        heading, sign = turns[index]
        half = np.deg2rad(turn) * sign / 2
        error = pose((off * np.cos(heading), off * np.sin(heading), 0.0), (np.cos(half), 0.0, 0.0, np.sin(half)))
        return T @ error

    def written(name: str, off: float, turn: float) -> TileMap:
        city = TileMap.create(folder / f"{name}.tiles", OCC3D_CLASSES)
        for number, index, truth, grid in seen:
            T = moved(index, grid.T_world_grid, off, turn) if number else grid.T_world_grid
            city.write(_logits(grid), truth.mask_camera, T, grid.spec,
                       stamp=number * _DAY + index, agent="car", log=f"day-{number}")  # fmt: skip
        rebuild(city, out=folder / f"{name}-bayes.tiles", policy="bayes")
        return TileMap.open(folder / f"{name}-bayes.tiles")

    city = written("clean", 0.0, 0.0)
    truths = [t for _, t in last]
    masks = [city.read(t.grid.T_world_grid, t.grid.spec).known & t.mask_camera for t in truths]
    now = [_centred(_logits(perceive(t, seed=_seed(street, 99, i)))) for i, t in last]
    rows = []
    for off in metres:
        for turn in degrees:
            priors = [city.read(moved(i, t.grid.T_world_grid, off, turn), t.grid.spec).logits for i, t in last]
            both = [a + b for a, b in zip(now, priors, strict=True)]
            row = {"metres": off, "degrees": turn, "prior": _score(priors, truths, masks)["mIoU"]}
            row["fused"] = _score(both, truths, masks)["mIoU"]
            if turn == degrees[0]:
                other = written(f"off-{off}", off, turn)
                row["written"] = _score(
                    [other.read(t.grid.T_world_grid, t.grid.spec).logits for t in truths], truths, masks
                )["mIoU"]
            rows.append(row)
    return {"synthetic": True, "seed": street.seed, "seen": _score(now, truths, masks)["mIoU"], "sweep": rows}


def fence(folder: Path, *, before: int = 20, after: int = 12, seed: int = 5) -> dict[str, Any]:
    """See a fence `before` times, then the place without it; how much of it does each policy still hold after n looks?

    Two looks a second. `frames` is the first number of looks after which less than a tenth of the fence is left.
    """
    spec = GridSpec((-12.0, -12.0, -1.0), 0.4, (60, 60, 8))
    ground = np.full(spec.shape, OCC3D_FREE, dtype=np.uint8)
    ground[:, :, :2] = _ROAD
    standing = ground.copy()
    standing[10:50, 44, 2:6] = _MANMADE
    there = standing != ground
    city = TileMap.create(folder / "fence.tiles", OCC3D_CLASSES, heights=8)
    all_seen = np.ones(spec.shape, dtype=np.bool_)
    for n in range(before + after):
        grid = OccupancyGrid(standing if n < before else ground, spec)
        truth = Labels(grid, np.zeros(spec.shape, np.int32), all_seen, all_seen)
        seen = perceive(truth, seed=seed * 1000 + n)
        city.write(_logits(seen), all_seen, np.eye(4), spec, stamp=n / 2, agent="car", log="day")
    ways = {
        "newest": FoldConfig(),
        "bayes": FoldConfig(policy="bayes"),
        "bayes, limit 20": FoldConfig(policy="bayes", limit=20.0),
        "bayes, limit 20, half-life 5 s": FoldConfig(policy="bayes", limit=20.0, half_life=5.0),
        "ema 0.3": FoldConfig(policy="ema"),
        "ema 0.1": FoldConfig(policy="ema", weight=0.1),
    }
    report: dict[str, Any] = {"synthetic": True, "looks_before": before, "voxels": int(there.sum()), "left": {}}
    for name, config in ways.items():
        left = []
        for looks in range(after + 1):
            path = folder / f"{len(report['left'])}-{looks}.tiles"
            rebuild(city, out=path, until=(before + looks - 1) / 2, config=config)
            labels_now = TileMap.open(path).read(np.eye(4), spec).logits.argmax(axis=-1)
            left.append(round(float((labels_now[there] == _MANMADE).mean()), 4))
        report["left"][name] = left
    report["frames"] = {
        name: next((n for n, share in enumerate(left) if share < 0.1), None) for name, left in report["left"].items()
    }
    return report


def _seed(street: Street, number: int, index: int) -> int:
    return street.seed * 100_000 + number * 1000 + index


def _logits(grid: OccupancyGrid) -> Float32[np.ndarray, "x y z c"]:
    assert grid.logits is not None
    return grid.logits


def _centred(logits: Float32[np.ndarray, "x y z c"]) -> Float32[np.ndarray, "x y z c"]:
    return logits - logits.mean(axis=-1, keepdims=True)


def _score(
    logits: Sequence[Float[np.ndarray, "x y z c"]], truths: Sequence[Labels], masks: Sequence[Bool[np.ndarray, "x y z"]]
) -> dict[str, float]:
    score = OccupancyScore()
    for values, truth, mask in zip(logits, truths, masks, strict=True):
        score.add(values.argmax(axis=-1).astype(np.uint8), truth.grid.labels, mask)
    return score.to_dict()


def _mean(values: Sequence[float]) -> float:
    return round(float(np.mean(values)), 4)


SHOWINGS: dict[str, Callable[[Path], dict[str, Any]]] = {"passes": passes, "pose_noise": pose_noise, "fence": fence}
"""By name; each writes maps into a folder that may be thrown away, and returns plain numbers."""
