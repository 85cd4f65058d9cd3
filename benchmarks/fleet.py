"""What a fleet would ask of the global map, from what one write was measured to cost: the tables of docs/scale.md.

Usage: openvocab-occ bench memory --json > bench.json; python benchmarks/fleet.py bench.json

Nothing here was run at that size: it is arithmetic on measured costs, and a simulation of who meets whom on a tile.
"""

import heapq
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

FLEETS = (10, 1_000, 100_000)
DAY = 86_400.0
TILE_M = 25.6
WINDOW_M = 80.0


@dataclass(frozen=True)
class City:
    """A large town and how it is driven."""

    street_km: float = 5_000.0
    seen_across_m: float = 50.0
    """Width of what is seen and stored along a street."""
    hours: float = 8.0
    """That a vehicle drives a day."""
    speed_kmh: float = 25.0
    spacing_m: float = 5.0
    """Between written keyframes."""
    peak: float = 3.0
    """Busiest hour over the mean."""
    skew: float = 0.35
    """Zipf exponent: the n-th busiest stretch has 1 / n^skew of the busiest one's traffic: 46 times the mean."""
    refresh_s: float = 3_600.0
    """With a rule: a tile that is younger is not written again."""

    @property
    def tiles(self) -> int:
        """Tiles that ever hold anything."""
        return round(self.street_km * 1e3 * self.seen_across_m / TILE_M**2)

    @property
    def stretches(self) -> int:
        """Pieces of street of a tile's length."""
        return round(self.street_km * 1e3 / TILE_M)


@dataclass(frozen=True)
class Costs:
    """Of one keyframe of 200 x 200 x 16 x 18, measured by `bench memory` (synthetic logits)."""

    cpu_s: float
    """Processor time of a write, several being committed together."""
    commit_s: float
    """From reading a tile to its commit: how long another writer may spoil it."""
    chunks: int
    journal_bytes: int
    gb_per_km2: float
    batch: int = 8

    @staticmethod
    def of(report: dict, batch: int = 8) -> "Costs":
        return Costs(
            report[f"update_cpu_ms_in_batches_of_{batch}"] / 1e3, report["update_ms"] / 1e3, report["update_chunks"],
            report["journal_entry_bytes"], report["gb_per_km2_of_tiles"], batch,
        )  # fmt: skip

    @property
    def chunk_bytes(self) -> float:
        return self.gb_per_km2 * 1e9 * (TILE_M / 1e3) ** 2

    def chunks_of_batch(self, city: City) -> float:
        """Tiles of a commit: those of a window, and one more row of them for each tile's length driven."""
        return self.chunks + self.chunks**0.5 * (self.batch - 1) * city.spacing_m / TILE_M


def day(vehicles: int, city: City, costs: Costs, *, rule: bool) -> dict[str, float]:
    """Return the numbers of a day; with the `rule`, fresh tiles are not written again."""
    km = vehicles * city.hours * city.speed_kmh
    writes = km * 1e3 / city.spacing_m
    share = np.arange(1, city.stretches + 1) ** -city.skew
    share /= share.sum()
    visits = share * km * 1e3 / TILE_M  # of each stretch a day
    kept = np.minimum(1.0, DAY / city.refresh_s / np.maximum(visits, 1e-12)) if rule else np.ones_like(visits)
    passed = float((visits * kept).sum() / visits.sum())
    writes *= passed
    commits = writes / costs.batch
    rate = commits / DAY * city.peak
    puts = rate * costs.chunks_of_batch(city)
    commits_of_pass = (TILE_M + WINDOW_M) / city.spacing_m / costs.batch + 1  # windows reach it before and after
    busiest = float((visits * kept).max()) * commits_of_pass / DAY * city.peak
    return {
        "km": km, "writes": writes, "written": passed, "writes_s": rate * costs.batch, "puts_s": puts,
        "put_mb_s": puts * costs.chunk_bytes / 1e6, "cores": rate * costs.batch * costs.cpu_s,
        "journal_tb": writes * costs.journal_bytes / 1e12, "busiest_commits_s": busiest,
        "lost_races": contention(busiest, costs.commit_s), "passes": km / city.street_km,
    }  # fmt: skip


def contention(rate: float, seconds: float, *, trials: int = 20_000, seed: int = 0) -> float:
    """Simulate writers of one tile who read, work and commit, and do it again if another committed meanwhile.

    Return the tries per commit; infinite where they come faster than one after the other could be served.
    """
    if rate * seconds >= 1.0:
        return float("inf")
    rng = np.random.default_rng(seed)
    arrivals = np.cumsum(rng.exponential(1 / rate, trials)) if rate > 0 else np.arange(trials) * 1e9
    pending = [(t + seconds, t, n) for n, t in enumerate(arrivals)]
    heapq.heapify(pending)
    last, tries, done = -np.inf, 0, 0
    while pending and tries < 50 * trials:
        end, begun, n = heapq.heappop(pending)
        tries += 1
        if begun < last:  # somebody committed since this one read
            wait = float(rng.uniform(0, seconds))
            heapq.heappush(pending, (end + wait + seconds, end + wait, n))
        else:
            last, done = end, done + 1
    return tries / max(done, 1)


def main() -> None:
    report = json.loads(Path(sys.argv[1]).read_text())
    city, costs = City(), Costs.of(report)
    km2 = city.tiles * (TILE_M / 1e3) ** 2
    print(
        f"One write: {costs.cpu_s * 1e3:.0f} ms of processor time in batches of {costs.batch}, {costs.chunks} tiles of "
        f"{costs.chunk_bytes / 1e3:.0f} kB, {costs.journal_bytes / 1e6:.1f} MB of journal; a commit takes "
        f"{costs.commit_s * 1e3:.0f} ms.\nCity: {city.street_km:,.0f} km of streets, {city.tiles:,} tiles, "
        f"{km2:.0f} km²: the map is {km2 * costs.gb_per_km2:.0f} GB, dense float32 "
        f"{km2 * report['dense_float32_gb_per_km2']:,.0f} GB.\n"
    )
    columns = ("vehicles", "passes a street a day", "written", "writes/s", "tile puts/s", "MB/s", "cores",
               "journal TB a day", "busiest tile, commits/s", "tries per commit there")  # fmt: skip
    for rule in (False, True):
        print("Tiles younger than an hour are left alone:" if rule else "Everyone writes every keyframe:")
        print(f"\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
        for vehicles in FLEETS:
            d = day(vehicles, city, costs, rule=rule)
            cells = (
                f"{vehicles:,}", f"{d['passes']:,.1f}", f"{d['written']:.1%}", f"{d['writes_s']:,.1f}",
                f"{d['puts_s']:,.0f}", f"{d['put_mb_s']:,.1f}", f"{d['cores']:,.1f}", f"{d['journal_tb']:,.2f}",
                f"{d['busiest_commits_s']:.3f}",
                "never served" if np.isinf(d["lost_races"]) else f"{d['lost_races']:.2f}",
            )  # fmt: skip
            print(f"| {' | '.join(cells)} |")
        print()


if __name__ == "__main__":
    main()
