"""Pruned journals: the map stays, and what needs the dropped entries is refused."""

import json

import pytest

from openvocab_occ.cli import main
from openvocab_occ.errors import ConfigError, MapError, StorageError
from openvocab_occ.memory import TileMap, journal
from openvocab_occ.memory.fold import rebuild, repair
from openvocab_occ.memory.foundation import pruned
from openvocab_occ.memory.health import describe, verify
from openvocab_occ.memory.merge import merge
from openvocab_occ.memory.prune import prune
from tests.memory.conftest import NAMES, SPEC, contents, random_logits, random_pose, write


def drive(city, rng, agents, *, start=0.0):
    for n, agent in enumerate(agents):
        mask = rng.random(SPEC.shape) < 0.5
        write(city, random_logits(rng), mask, random_pose(rng, reach=4), stamp=start + n, agent=agent, log=agent)


@pytest.fixture
def kept(city, rng):
    """A map of four drives; those of a and b are merged, and a third of what c saw came before."""
    drive(city, rng, ("c", "a", "b", "a", "b", "c", "d"))
    for log in ("a", "b"):
        city.consolidate(log)
    return city


def test_the_map_stays_and_is_rebuilt_to_the_same_bytes(kept):
    before, size = contents(kept), len(kept.store.list("journal/"))
    dropped = prune(kept)
    assert (dropped.entries, dropped.agents) == (4, ("a", "b"))
    assert len(kept.store.list("journal/")) == size - 4
    assert contents(kept) == before
    kept.rebuild()
    assert contents(kept) == before
    assert prune(kept).entries == 0
    assert describe(kept)["pruned_entries"] == 4
    assert verify(kept).sound


def test_rebuild_leaves_out_whom_it_can(kept, tmp_path):
    rebuild(kept, out=tmp_path / "wanted", without=("d",))
    kept.consolidate("c")
    prune(kept, before=4.5)  # of c the first entry goes as well
    with pytest.raises(ConfigError, match=r"agent 'c' cannot be left out: 5 entries up to 4 are pruned"):
        kept.rebuild(without="c")
    assert kept.agents()["c"] is None, "what is refused does nothing"
    kept.rebuild(without="d")
    assert contents(kept) == contents(TileMap.open(tmp_path / "wanted"))
    kept.quarantine("a", "found out too late")
    with pytest.raises(ConfigError, match="agent 'a' cannot be left out"):
        kept.rebuild()


def test_an_agent_of_kept_entries_goes_without_a_trace(city, rng, tmp_path):
    drive(city, rng, ("a", "b", "a", "b"))
    city.consolidate("a")
    honest = tmp_path / "honest"
    rebuild(city, out=honest, without=("b",))
    prune(city)
    city.consolidate("b")
    city.rebuild(without="b")
    assert contents(city) == contents(TileMap.open(honest))
    city.consolidate("b")  # nothing of it is left
    prune(city)
    assert pruned(city).agents == ("a",)
    assert city.store.list("journal/") == []


def test_what_was_cut_off_is_repeated(kept, monkeypatch):
    before, real = contents(kept), kept.store.delete

    def delete(prefix):
        if prefix.startswith("journal/b"):
            raise StorageError("the plug was pulled")
        real(prefix)

    monkeypatch.setattr(kept.store, "delete", delete)
    with pytest.raises(StorageError):
        prune(kept)
    kept.rebuild()
    assert contents(kept) == before
    monkeypatch.undo()
    prune(kept)
    kept.rebuild()
    assert contents(kept) == before


def test_merged_maps_carry_what_was_pruned(kept, tmp_path):
    before = contents(kept)
    prune(kept)
    other = TileMap.create(tmp_path / "other", NAMES, heights=8)
    merge(other, kept)
    assert contents(other) == before
    other.rebuild()
    assert contents(other) == before
    with pytest.raises(ConfigError, match="agent 'a' cannot be left out"):
        other.rebuild(without="a")


def test_damage_is_mended_where_it_can_be(kept, tmp_path):
    before = contents(kept)
    prune(kept)
    for layer, mends in (("base", True), ("pruned", False)):
        chunk = next((tmp_path / "city.tiles" / layer).glob("c.*"))
        whole = chunk.read_bytes()
        chunk.write_bytes(whole[:-7])
        health = verify(kept)
        assert [*health.damaged] == [f"{layer}/"]
        if mends:
            assert repair(kept, health.damaged) == 1
            assert contents(kept) == before
        else:
            with pytest.raises(MapError, match="the entries that made it are pruned"):
                repair(kept, health.damaged)


def test_refused(kept, tmp_path, capsys):
    prune(kept)
    with pytest.raises(ConfigError, match="cannot be folded by bayes: 4 entries up to 4 are pruned"):
        rebuild(kept, out=tmp_path / "x", policy="bayes")
    with pytest.raises(ConfigError, match="cannot be folded by newest up to that time"):
        rebuild(kept, out=tmp_path / "x", until=3.0)
    rebuild(kept, out=tmp_path / "x", until=4.0)
    assert not (tmp_path / "y").exists()
    with pytest.raises(StorageError, match="opened for reading"):
        prune(TileMap.open(kept.store.name, writable=False))
    assert main(["memory", "consolidate", kept.store.name, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["logs"] == ["c", "d"]
    assert main(["memory", "prune", kept.store.name, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["agents"] == ["c", "d"]
    assert journal.names(kept.store) == []
