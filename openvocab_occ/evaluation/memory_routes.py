"""Routes that were really driven, in streets that are made up: does who comes again find what was there?"""

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from openvocab_occ.evaluation.simulated_streets import SimulatedStreets, kitti_route
from openvocab_occ.geometry import GridSpec
from openvocab_occ.io.files import PathLike
from openvocab_occ.memory import TileMap
from openvocab_occ.memory.health import describe
from openvocab_occ.memory.tile_map import Written
from openvocab_occ.occupancy import OCC3D_CLASSES

SPEC = GridSpec((-20.0, -20.0, -3.0), 0.4, (100, 100, 16))
"""KITTI's camera rides 1.65 m above the road."""
_CAMERA = 1.65
_AGAIN = 4.0  # m between two visits of a place
_ALONE = 60.0  # m; nothing that is seen from there is seen from here
_LATE = 100.0  # m of way after which a write is in the map, so that nobody finds his own tail


def revisits(path: PathLike, folder: Path, *, spacing: float = 8.0) -> dict[str, Any]:
    """Drive a KITTI route through made-up streets; at each place read the prior first, and write 100 m later.

    `again` are places where the route had been before, within 4 m; `new` those that it had not come within 60 m of.
    `found` is the share of what is seen there of which the map has a prior, `right` that of its labels that are true.
    """
    route = kitti_route(path, spacing=1.0)
    streets = SimulatedStreets(route, _CAMERA)
    way = np.arange(0, len(route), round(spacing))
    again, new = _visits(route[way, :2, 3], round(_LATE / spacing))
    city = TileMap.create(folder / "route.tiles", OCC3D_CLASSES, journal=False)
    late: deque[tuple[int, np.ndarray, np.ndarray]] = deque()
    found, right = np.zeros(len(way)), np.full(len(way), np.nan)
    for n, at in enumerate(way):
        prior = city.read(route[at], SPEC)
        logits, seen, labels = streets.observe(route[at], SPEC, int(at))
        both = prior.known & seen
        found[n] = both.sum() / seen.sum()
        if both.any():
            right[n] = (prior.logits.argmax(axis=-1) == labels)[both].mean()
        late.append((int(at), logits, seen))
        if len(late) * spacing > _LATE:
            _write(city, route, late.popleft())
    while late:
        _write(city, route, late.popleft())
    city.consolidate("day")
    about = describe(city)
    low, high = route[:, :2, 3].min(axis=0) - 20, route[:, :2, 3].max(axis=0) + 20
    return {
        "synthetic": "streets and logits; the route is KITTI's", "route": Path(path).name, "windows": len(way),
        "driven_km": round(len(route) / 1000, 3),
        "again": {"windows": int(again.sum()), "found": _mean(found[again]), "right": _mean(right[again]),
                  "with_prior": _mean(found[again] > 0.5)},
        "new": {"windows": int(new.sum()), "found": _mean(found[new]), "most_found": float(found[new].max(initial=0))},
        "tile_km2": about["tile_area_km2"], "gb_per_km2": about["gb_per_km2"],
        "megabytes": round(about["tile_bytes"] / 1e6, 2), "megabytes_per_driven_km":
        round(about["tile_bytes"] / 1e3 / len(route), 2),
        "dense_gb_per_km2": about["dense_float32_gb_per_km2"],
        "dense_rectangle_gb": round(float(np.prod(high - low)) / 1e6 * about["dense_float32_gb_per_km2"], 2),
        "places": {"x": route[way, 0, 3].round(1).tolist(), "y": route[way, 1, 3].round(1).tolist(),
                   "found": found.round(3).tolist()},
    }  # fmt: skip


def _visits(places: Float64[np.ndarray, "n 2"], apart: int) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Tell where the route had been before, and where it had not been near."""
    gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
    number = np.arange(len(places))
    gaps[number[:, None] - number[None] <= apart] = np.inf
    nearest = gaps.min(axis=1)
    return nearest < _AGAIN, nearest > _ALONE


def _write(city: TileMap, route: np.ndarray, late: tuple[int, np.ndarray, np.ndarray]) -> Written:
    at, logits, seen = late
    return city.write(logits, seen, route[at], SPEC, stamp=float(at), agent="car", log="day")


def _mean(values: np.ndarray) -> float | None:
    return round(float(np.nanmean(values)), 4) if len(values) else None
