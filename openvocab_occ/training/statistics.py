"""Means and intervals of paired differences, over seeds and cities."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from openvocab_occ.evaluation.occupancy import DYNAMIC, STATIC, OccupancyScore
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_FREE

Row = Mapping[str, object]
GROUPS: dict[str, tuple[int, ...]] = {"all": tuple(range(OCC3D_FREE)), "dynamic": DYNAMIC, "static": STATIC}
LEAST_VOXELS = 200
"""A class with fewer true voxels in the whole evaluation is left out: its IoU is a coin toss."""
_DRAWS = 1000


@dataclass(frozen=True)
class Interval:
    """A mean and what 95 % of the bootstrap's draws lie between."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


@dataclass(frozen=True, eq=False)
class Outcome:
    """Confusions of one way to predict, of every seed and city."""

    confusion: Int64[np.ndarray, "seeds cities truth predicted"]
    cities: tuple[str, ...]

    def values(self, classes: Collection[int], weights: Float64[np.ndarray, "seeds cities"] | None = None
               ) -> Float64[np.ndarray, " seeds"]:  # fmt: skip
        """Return the mean IoU of classes for each seed, percent, cities weighing as told."""
        weight = np.ones(self.confusion.shape[:2]) if weights is None else weights
        total = np.einsum("scij,sc->sij", self.confusion, weight)
        hit = np.einsum("sii->si", total)
        union = total.sum(1) + total.sum(2) - hit
        with np.errstate(invalid="ignore", divide="ignore"):
            iou = np.where(union > 0, hit / union, np.nan)[:, sorted(classes)]
        return 100 * np.nanmean(iou, axis=1)

    @property
    def geometric(self) -> float:
        """IoU of occupied against free, percent, mean over seeds."""
        score = OccupancyScore()
        score.confusion += self.confusion.sum(axis=(0, 1))
        return 100 * score.geometric


def outcome_of(
    seeds: Sequence[Sequence[Row]],
    region: str = "seen",
    *,
    visits: Collection[int] | None = None,
    conditions: Collection[str] | None = None,
) -> Outcome:
    """Add up the rows of each seed (see `MemoryScore.to_dict`) by city; visits and conditions may be chosen."""
    cities = tuple(sorted({str(row["place"]) for rows in seeds for row in rows}))
    size = len(OCC3D_CLASSES)
    found = np.zeros((len(seeds), len(cities), size, size), np.int64)
    for s, rows in enumerate(seeds):
        for row in rows:
            if visits is not None and row["visit"] not in visits:
                continue
            if conditions is not None and row["condition"] not in conditions:
                continue
            found[s, cities.index(str(row["place"]))] += np.asarray(row[region], np.int64).reshape(size, size)
    return Outcome(found, cities)


def frequent(outcome: Outcome, least: int = LEAST_VOXELS) -> Bool[np.ndarray, " classes"]:
    """Tell which classes have enough true voxels, in one seed, to be counted."""
    return outcome.confusion[0].sum(axis=(0, 2)) >= least


def chosen(group: str, outcome: Outcome) -> list[int]:
    """Return the classes of a group that are frequent enough."""
    enough = frequent(outcome)
    return [c for c in GROUPS[group] if enough[c]]


def gain(a: Outcome, b: Outcome, group: str = "all", *, draws: int = _DRAWS, seed: int = 0) -> Interval:
    """Return a less b, percent points of mIoU, paired by seed and city; an outcome of one seed serves for all."""
    classes = chosen(group, b)
    seeds, cities = max(len(a.confusion), len(b.confusion)), len(a.cities)
    if not classes or a.cities != b.cities:
        return Interval(float("nan"), float("nan"), float("nan"))
    a, b = (Outcome(np.broadcast_to(o.confusion, (seeds, *o.confusion.shape[1:])), o.cities) for o in (a, b))
    rng = np.random.default_rng(seed)
    found = np.empty(draws)
    for n in range(draws):
        weight = np.bincount(rng.integers(cities, size=cities), minlength=cities).astype(np.float64)
        weights = np.broadcast_to(weight, (seeds, cities))
        difference = a.values(classes, weights) - b.values(classes, weights)
        found[n] = difference[rng.integers(seeds, size=seeds)].mean()
    low, high = np.nanpercentile(found, [2.5, 97.5])
    return Interval(float((a.values(classes) - b.values(classes)).mean()), float(low), float(high))
