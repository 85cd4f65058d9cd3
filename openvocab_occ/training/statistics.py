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

    def values(self, classes: Collection[int]) -> Float64[np.ndarray, " seeds"]:
        """Return the mean IoU of classes for each seed, percent."""
        return self.draws(classes, np.ones((1, len(self.cities))))[0]

    def draws(
        self, classes: Collection[int], weights: Float64[np.ndarray, "draws cities"]
    ) -> Float64[np.ndarray, "draws seeds"]:
        """Return the mean IoU of classes for each seed, percent, once for each row of weights of the cities."""
        c = sorted(classes)
        hit = np.einsum("scii->sci", self.confusion)[..., c]
        union = self.confusion.sum(2)[..., c] + self.confusion.sum(3)[..., c] - hit
        hits, unions = (np.einsum("dc,sck->dsk", weights, x.astype(np.float64)) for x in (hit, union))
        iou = np.where(unions > 0, hits / np.maximum(unions, 1), np.nan)
        count = np.isfinite(iou).sum(axis=-1)
        return 100 * np.where(count > 0, np.nansum(iou, axis=-1) / np.maximum(count, 1), np.nan)

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
    rng = np.random.default_rng(seed)
    towns = rng.multinomial(cities, np.full(cities, 1 / cities), size=draws).astype(np.float64)
    runs = rng.multinomial(seeds, np.full(seeds, 1 / seeds), size=draws) / seeds
    difference = a.draws(classes, towns) - b.draws(classes, towns)  # draws, seeds
    found = (np.broadcast_to(difference, (draws, seeds)) * runs).sum(axis=1)
    low, high = np.nanpercentile(found, [2.5, 97.5]) if np.isfinite(found).any() else (np.nan, np.nan)
    return Interval(float((a.values(classes) - b.values(classes)).mean()), float(low), float(high))
