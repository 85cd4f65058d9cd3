"""Streets that were really driven (KITTI), with made-up occupancy: who comes again finds what was there."""

import numpy as np
import pytest

from openvocab_occ.evaluation.simulated_streets import SimulatedStreets, kitti_route
from openvocab_occ.geometry import GridSpec
from openvocab_occ.memory import TileMap
from openvocab_occ.memory.health import describe
from openvocab_occ.occupancy import OCC3D_CLASSES

SPEC = GridSpec((-16.0, -16.0, -3.0), 0.4, (80, 80, 16))  # KITTI's camera rides 1.65 m above the road


@pytest.mark.data
@pytest.mark.parametrize("name", ["00", "05", "06"])
def test_revisits_find_their_prior_and_new_streets_find_none(data, tmp_path, name):
    route = kitti_route(data / "trajectories" / f"kitti_{name}.txt", spacing=1.0)
    streets = SimulatedStreets(route, 1.65)
    places = route[:, :2, 3]
    gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
    far = np.abs(np.subtract.outer(np.arange(len(route)), np.arange(len(route)))) > 100
    again = np.flatnonzero((np.tril(far) & (gaps < 4.0)).any(axis=1))
    assert len(again) > 50, "the route comes back"
    second = int(again[len(again) // 2])
    first = int(np.flatnonzero((gaps[second] < 4.0) & far[second] & (np.arange(len(route)) < second))[0])
    city = TileMap.create(tmp_path / "m", OCC3D_CLASSES, journal=False)
    for n in range(max(0, first - 24), first + 25, 8):
        logits, mask, _ = streets.observe(route[n], SPEC, n)
        city.write(logits, mask, route[n], SPEC, stamp=float(n), agent="car", log="first")
    prior = city.read(route[second], SPEC)
    _, seen, labels = streets.observe(route[second], SPEC, second)
    assert prior.known[seen].mean() > 0.6
    assert (prior.logits.argmax(-1) == labels)[prior.known & seen].mean() > 0.85
    assert not city.read(route[second], SPEC, exclude_logs=["first"]).known.any()
    alone = np.flatnonzero(gaps[max(0, first - 24) : first + 25].min(axis=0) > 60)
    for n in alone[:: max(1, len(alone) // 5)]:
        assert not city.read(route[n], SPEC).known.any(), "nobody has been there"
    assert describe(city)["gb_per_km2"] < 0.6  # of 7.2 dense; the density of what is seen differs by street
