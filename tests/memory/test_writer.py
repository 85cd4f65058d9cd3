"""Writes in the background end as writes that are waited for; and the layout of Neural Map Prior."""

import threading

import numpy as np
import pytest

from openvocab_occ.errors import ConfigError, DataError, PoseError, StorageError
from openvocab_occ.geometry import GridSpec, pose
from openvocab_occ.memory import TileMap
from openvocab_occ.memory.nmp import NMP_CITIES, NmpMap
from openvocab_occ.memory.writer import Writer
from tests.memory.conftest import NAMES, SPEC, contents, random_logits, random_pose, write


def drive(rng, count=9):
    return [(random_logits(rng), rng.random(SPEC.shape) < 0.5, random_pose(rng, reach=4)) for _ in range(count)]


@pytest.mark.parametrize("policy", ["newest", "replace"])
def test_background_writes_give_the_same_map(tmp_path, rng, policy):
    frames = drive(rng)
    slow, fast = (TileMap.create(tmp_path / name, NAMES, heights=8) for name in ("slow", "fast"))
    with Writer(fast, agent="a", log="one", policy=policy, most=4) as writer:
        for n, (logits, mask, T) in enumerate(frames):
            scratch = logits.copy()
            writer.write(scratch, mask, T, SPEC, stamp=100.0 - n)
            scratch[:] = np.nan  # it may be used again
            write(slow, logits, mask, T, stamp=100.0 - n, policy=policy)
    assert contents(fast) == contents(slow)
    assert fast.store.list("journal/") == slow.store.list("journal/")


def test_durable_means_stored_on_return(city, rng):
    logits, mask, T = drive(rng, 1)[0]
    writer = Writer(city, agent="a", log="one")
    writer.write(logits, mask, T, SPEC, stamp=1.0, durable=True)
    assert contents(TileMap.open(city.store.name))
    writer.write(logits, mask, T, SPEC, stamp=2.0)
    assert writer.flush().changed > 0
    assert writer.flush().changed == 0
    writer.close()
    with pytest.raises(ConfigError, match="the writer is closed"):
        writer.write(logits, mask, T, SPEC, stamp=3.0)


def test_what_fails_is_told_and_tried_again(city, rng, monkeypatch):
    frames, real, full = drive(rng, 3), city.put, threading.Event()

    def put(entries):
        if full.is_set():
            raise StorageError("the disk is full")
        return real(entries)

    monkeypatch.setattr(city, "put", put)
    full.set()
    writer = Writer(city, agent="a", log="one")
    writer.write(*frames[0], SPEC, stamp=1.0)
    with pytest.raises(StorageError, match="the disk is full"):
        writer.flush()
    full.clear()
    for n in (1, 2):
        while True:
            try:
                writer.write(*frames[n], SPEC, stamp=1.0 + n)
                break
            except StorageError:
                continue
    writer.close()
    assert len(city.store.list("journal/")) == 3, "nothing that was taken is lost"


def test_bad_arguments_are_told_at_once(city, rng, unchecked):
    (logits, mask, T), *_ = drive(rng, 1)
    with Writer(city, agent="a", log="one") as writer:
        with pytest.raises(DataError, match="mask is not a mask"):
            writer.write(logits, mask.astype(np.uint8), T, SPEC, stamp=1.0)
        with pytest.raises(ConfigError, match="stamp is not a time"):
            writer.write(logits, mask, T, SPEC, stamp=-1.0)
    city.quarantine("a", "why not")
    with pytest.raises(ConfigError, match="is quarantined"):
        Writer(city, agent="a", log="one")
    with pytest.raises(ConfigError, match="most is not usable"):
        Writer(city, agent="b", log="one", most=0)


# --- nmp4x4 ---

FLAT = GridSpec((-8.0, -8.0, -1.0), 0.4, (40, 40, 1))


def test_nmp_reads_back_what_it_wrote_and_drops_what_leaves_the_tile(rng):
    city = NmpMap((0.0, 0.0), (400.0, 400.0), channels=4, padding=0.0)
    assert city.shape == (250, 250)
    values = rng.normal(size=(40, 40, 4)).astype(np.float32)
    T = pose((50.4, 50.4, 3.0))
    city.write(values, T, FLAT)
    assert (city.read(T, FLAT) == values).all()
    edge = pose((98.4, 50.4, 0.0))  # the ego is in tile 0, half of its window is not
    city.write(values, edge, FLAT)
    back = city.read(edge, FLAT)
    assert (back[:24] == values[:24]).all()
    assert not back[24:].any()
    assert [*city.tiles] == [(0, 0)]
    with pytest.raises(PoseError, match="the ego is outside the city"):
        city.read(pose((500.0, 0.0, 0.0)), FLAT)


def test_nmp_leaves_holes_where_the_tile_map_leaves_none(tmp_path, rng):
    turned = pose((50.0, 50.0, 0.0), (np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)))
    city = NmpMap((0.0, 0.0), (400.0, 400.0), channels=4, padding=0.0)
    wide = GridSpec((-24.0, -24.0, -1.0), 0.4, (120, 120, 1))
    city.write(np.ones((120, 120, 4), np.float32), turned, wide)
    ours = TileMap.create(tmp_path / "m", NAMES, heights=1, journal=False)
    write(ours, random_logits(rng, wide), np.ones(wide.shape, bool), turned, spec=wide)
    small = GridSpec((-12.0, -12.0, -1.0), 0.4, (60, 60, 1))
    missing = 1 - (city.read(pose((50.0, 50.0, 0.0)), small)[..., 0] != 0).mean()
    assert 0.15 < missing < 0.19  # a sixth at 45 degrees
    assert ours.read(pose((50.0, 50.0, 0.0)), small).known.all()


def test_nmp_cities_have_the_published_size():
    """Rectangles of 295 to 660 m; at 0.4 m and 288 channels 0.7 to 2.8 GB each."""
    sizes = [NmpMap.of_city(name).tile_bytes / 1e9 for name in NMP_CITIES]
    assert 0.7 < min(sizes) < max(sizes) < 3.0
    with pytest.raises(ConfigError, match="city is not known"):
        NmpMap.of_city("paris")
