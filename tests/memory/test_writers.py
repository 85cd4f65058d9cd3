"""Many writers, kills, full disks, damaged chunks: nothing that was acknowledged is lost."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from openvocab_occ.errors import MapError, StorageError
from openvocab_occ.evaluation.memory_stress import CLASSES, Stress, fight, kill
from openvocab_occ.memory import TileMap, store
from openvocab_occ.memory.fold import repair
from openvocab_occ.memory.health import verify
from tests.memory.conftest import NAMES, SPEC, contents, random_logits, write

ROOT = Path(__file__).resolve().parents[2]


def test_three_writers_on_shared_chunks_lose_nothing(tmp_path):
    city = TileMap.create(tmp_path / "m", CLASSES, heights=8, journal=False)
    assert fight(city, updates=25) == Stress(updates=75, lost=0, unreadable=0)
    assert sum(int((tile.stamps > 0).sum()) for _, tile in city.tiles()) == 3 * 25 * 4


def test_kills_at_random_points_leave_every_chunk_whole(tmp_path):
    city = TileMap.create(tmp_path / "m", CLASSES, heights=8)
    found = kill(city, kills=3)
    assert (found.kills, found.lost, found.unreadable) == (3, 0, 0)
    before = contents(city)
    city.rebuild()  # an update cut off after its journal entry is completed
    assert before.keys() <= contents(city).keys()
    assert verify(city).sound


def test_what_a_killed_writer_left_does_not_get_into_a_chunk(city, rng):
    """A longer half-written file beside a chunk, as a kill leaves it, must not become the tail of the next."""
    mask = np.ones(SPEC.shape, bool)
    write(city, random_logits(rng), mask, np.eye(4), stamp=1.0)
    for chunk in (Path(city.store.name) / "logs/one").glob("c.*"):
        chunk.with_name(chunk.name + ".__lock").write_bytes(rng.bytes(10**6))
    write(city, random_logits(rng), mask, np.eye(4), stamp=2.0)
    assert verify(city).sound
    assert not [*Path(city.store.name).rglob("*.__lock")]


def test_torn_chunks_are_told_and_made_anew(city, rng):
    mask = np.ones(SPEC.shape, bool)
    write(city, random_logits(rng), mask, np.eye(4), stamp=1.0)
    before = contents(city)
    chunk = sorted((Path(city.store.name) / "logs/one").glob("c.*"))[1]
    whole = chunk.read_bytes()
    for damage in (whole[: len(whole) // 2], b"", bytes([whole[0] ^ 1]) + whole[1:], whole[:-9] + b"\x00" + whole[-8:]):
        chunk.write_bytes(damage)
        with pytest.raises(MapError, match=r"logs/one/c\.512\.\d+\.\d+\.0 is damaged.*memory verify"):
            city.read(np.eye(4), SPEC)
        with pytest.raises(MapError, match="is damaged"):
            write(city, random_logits(rng), mask, np.eye(4), stamp=0.5)
        assert chunk.read_bytes() == damage, "nothing is written over it"
        health = verify(city)
        assert not health.sound
        assert repair(city, health.damaged) == 1
        assert contents(city) == before


def test_a_full_disk_is_told_and_what_was_there_stays(city, rng):
    write(city, random_logits(rng), np.ones(SPEC.shape, bool), np.eye(4), stamp=1.0)
    before = contents(city)
    code = """
import resource, sys
import numpy as np
from openvocab_occ.errors import StorageError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.memory import TileMap, store
city, spec = TileMap.open(sys.argv[1]), GridSpec((-4.0, -4.8, -1.0), 0.4, (20, 24, 8))
logits = np.random.default_rng(1).normal(0, 2, (20, 24, 8, 4)).astype(np.float32)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
try:
    city.write(logits, np.ones(spec.shape, bool), np.eye(4), spec, stamp=2.0, agent="a", log="one")
except StorageError as error:
    print(error)
"""
    sizes = [f.stat().st_size for f in Path(city.store.name).rglob("*") if f.is_file()]
    for limit in (1000, max(sizes) - 100):  # in the journal, in the tiles
        run = [sys.executable, "-c", code, city.store.name, str(limit)]
        done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
        assert "cannot be written: the disk is full" in done.stdout, done.stderr
        assert verify(city).sound
    stamps = [tile.stamps.max() for _, tile in city.tiles()]
    assert max(stamps) <= 2001
    assert contents(city).keys() == before.keys()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become somebody who may not write")
def test_a_read_only_map_can_be_read_and_says_so(tmp_path, rng):
    os.chmod(tmp_path, 0o755)  # noqa: PTH101
    city = TileMap.create(tmp_path / "m", NAMES, heights=8)
    write(city, random_logits(rng), np.ones(SPEC.shape, bool), np.eye(4), stamp=1.0)
    reading = TileMap.open(city.store.name, writable=False)
    with pytest.raises(StorageError, match="was opened for reading"):
        write(reading, random_logits(rng), np.ones(SPEC.shape, bool), np.eye(4))
    before = contents(city)
    real = os.geteuid()
    parents = [tmp_path, *tmp_path.parents]
    modes = [p.stat().st_mode for p in parents]
    try:
        for p in parents[:-1]:
            p.chmod(0o755)
        os.seteuid(65534)
        with pytest.raises(StorageError, match=r"cannot be written: it is read-only.*check its permissions"):
            write(TileMap.open(city.store.name), random_logits(rng), np.ones(SPEC.shape, bool), np.eye(4), stamp=2.0)
        assert TileMap.open(city.store.name).read(np.eye(4), SPEC).known.all()
    finally:
        os.seteuid(real)
        for p, mode in zip(parents, modes, strict=True):
            p.chmod(mode & 0o7777)
    assert contents(city) == before


def test_without_locks_a_lost_race_is_run_again(city, rng, monkeypatch):
    """As in a bucket: somebody writes the same tiles between the read and the commit."""
    monkeypatch.setattr(store, "fcntl", None)
    other, mask = TileMap.open(city.store.name), np.ones(SPEC.shape, bool)
    mine, theirs = random_logits(rng), random_logits(rng)
    layer, real, calls = city.overlay("one"), city.overlay("one").fetch, []

    def fetch(keys, known=None):
        found = real(keys, known)
        if not calls:
            write(other, theirs, mask, np.eye(4), stamp=2.0)
        calls.append(len(found))
        return found

    monkeypatch.setattr(layer, "fetch", fetch)
    half = mask.copy()
    half[SPEC.shape[0] // 2 :] = False
    write(city, mine, half, np.eye(4), stamp=3.0)
    assert calls == [2, 2], "both tiles were lost, and both were done again"
    label = np.where(half, mine.argmax(-1), theirs.argmax(-1))
    assert (city.read(np.eye(4), SPEC).logits.argmax(-1) == label).all()


def test_what_others_wrote_is_not_taken_for_what_was_left_here(city, rng):
    other, mask = TileMap.open(city.store.name), np.ones(SPEC.shape, bool)
    for n, handle in enumerate((city, other, city, city, other)):
        write(handle, random_logits(rng), rng.random(SPEC.shape) < 0.5, np.eye(4), stamp=float(n))
    before = contents(city)
    city.rebuild()
    assert contents(city) == before
    assert write(city, random_logits(rng), mask, np.eye(4), stamp=0.0).changed < mask.sum()
