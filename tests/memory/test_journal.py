"""What is made from the journal: rebuilt maps, folds, changes, trust."""

from pathlib import Path

import numpy as np
import pytest

from openvocab_occ.errors import ConfigError, MapError
from openvocab_occ.memory import TileMap, journal
from openvocab_occ.memory.changes import diff, diff_times
from openvocab_occ.memory.filters import remove_dynamic
from openvocab_occ.memory.fold import FoldConfig, counts, rebuild
from openvocab_occ.memory.health import describe, verify
from openvocab_occ.memory.trust import audit, quarantine_contradicting
from tests.memory.conftest import NAMES, SPEC, contents, probabilities, random_logits, random_pose, write

ALL = np.ones(SPEC.shape, bool)


def labels_as_logits(labels: np.ndarray, strength: float = 5.0) -> np.ndarray:
    return (np.eye(len(NAMES), dtype=np.float32)[labels] * strength).astype(np.float32)


def drive(city, rng, agents=("a", "b", "c"), rounds=3):
    for n in range(rounds):
        for agent in agents:
            mask = rng.random(SPEC.shape) < 0.5
            write(city, random_logits(rng), mask, random_pose(rng, reach=4), stamp=float(n), agent=agent, log=agent)


def test_rebuild_gives_the_same_map_and_may_be_repeated(city, rng):
    drive(city, rng)
    city.consolidate("b")
    before = contents(city)
    for _ in range(2):
        city.rebuild()
        assert contents(city) == before


def test_rebuild_without_an_agent_is_a_map_it_never_wrote(city, tmp_path):
    drive(city, np.random.default_rng(5))
    rng = np.random.default_rng(5)
    city.rebuild(without="b")
    honest = TileMap.create(tmp_path / "honest", NAMES, heights=8)
    for n in range(3):
        for agent in ("a", "b", "c"):
            mask, logits, T = rng.random(SPEC.shape) < 0.5, random_logits(rng), random_pose(rng, reach=4)
            if agent != "b":
                write(honest, logits, mask, T, stamp=float(n), agent=agent, log=agent)
    assert contents(city) == contents(honest)
    with pytest.raises(ConfigError, match=r"agent 'b' is quarantined: got left out by rebuild"):
        write(city, random_logits(rng), ALL, np.eye(4), agent="b")
    city.release("b")
    assert write(city, random_logits(rng), ALL, np.eye(4), agent="b").voxels


def test_an_entry_comes_back_and_the_same_write_is_one_entry(city, rng):
    logits, mask, T = random_logits(rng), rng.random(SPEC.shape) < 0.3, random_pose(rng)
    for _ in range(2):
        write(city, logits, mask, T, stamp=7.25, agent="x/y", log="l")
    (name,) = journal.names(city.store)
    entry = journal.load(city.store, name, city.schema)
    assert (entry.agent, entry.log, entry.stamp, entry.policy, entry.spec) == ("x/y", "l", 7251, "newest", SPEC)
    assert (entry.T_world_ego == T).all()
    assert (entry.flat == np.flatnonzero(mask)).all()
    assert (entry.codes == city.schema.encode(logits[mask])).all()


def test_a_damaged_entry_is_found_out(city, rng):
    drive(city, rng, rounds=1)
    file = next((Path(city.store.name) / "journal/b").iterdir())
    raw = bytearray(file.read_bytes())
    raw[len(raw) // 2] ^= 1
    file.write_bytes(raw)
    assert verify(city).damaged_entries == [f"journal/b/{file.name}"]
    with pytest.raises(MapError, match=r"journal entry journal/b/.* is damaged: got its checksum is wrong"):
        city.rebuild()


def test_counts(city, rng):
    drive(city, rng, rounds=2)
    found = counts(city)
    for key, tile in city.tiles():
        assert ((found[key] > 0) == (tile.stamps > 0)).all()
    total = sum(journal.load(city.store, n, city.schema).flat.size for n in journal.names(city.store))
    seen = sum(int(tile.sum()) for tile in found.values())
    assert 0.9 < seen / total < 1.1  # as many map voxels as grid voxels, give or take a turned lattice


def test_bayes_adds_evidence_and_ema_averages(city, tmp_path, rng):
    writes = [random_logits(rng) for _ in range(3)]
    for n, logits in enumerate(writes):
        write(city, logits, ALL, np.eye(4), stamp=float(60 * n))
    stored = [city.schema.decode(city.schema.encode(w.reshape(-1, 4))).reshape(w.shape) for w in writes]
    wanted = {
        "sum": (FoldConfig(policy="bayes", limit=1e9), sum(stored)),
        "fading": (FoldConfig(policy="bayes", half_life=60.0, limit=1e9), stored[0] / 4 + stored[1] / 2 + stored[2]),
        "mean": (FoldConfig(policy="ema", weight=0.5), stored[0] / 4 + stored[1] / 4 + stored[2] / 2),
    }
    for name, (config, logits) in wanted.items():
        rebuild(city, out=tmp_path / name, config=config)
        prior = TileMap.open(tmp_path / name).read(np.eye(4), SPEC)
        np.testing.assert_allclose(probabilities(prior.logits), probabilities(logits), atol=0.02)


def test_bayes_is_bounded_so_that_it_can_forget(city, tmp_path):
    """A fence seen a hundred times and demolished is forgotten after a few looks, not a hundred."""
    fence, gone = (labels_as_logits(np.full(SPEC.shape, label), 4.0) for label in (1, 3))
    T = np.eye(4)
    for n in range(20):
        write(city, fence, ALL, T, stamp=float(n))
    for n in range(6):
        write(city, gone, ALL, T, stamp=100.0 + n)
    rebuild(city, out=tmp_path / "bayes", config=FoldConfig(policy="bayes", limit=8.0))
    assert (TileMap.open(tmp_path / "bayes").read(T, SPEC).logits.argmax(-1) == 3).all()
    assert (city.read(T, SPEC).logits.argmax(-1) == 3).all()


def test_bayes_forgets_also_where_the_runner_up_is_the_same(city, tmp_path):
    """Free is second while the fence stands, the fence is second afterwards: each look says 1, the bound is 8."""
    T = np.eye(4)
    for n in range(30):
        logits = np.zeros((*SPEC.shape, 4), np.float32)
        logits[..., 1], logits[..., 3] = (4.0, 3.0) if n < 20 else (3.0, 4.0)
        write(city, logits, ALL, T, stamp=float(n))
    for looks, label in ((6, 1), (10, 3)):
        rebuild(city, out=tmp_path / str(looks), until=19.0 + looks, policy="bayes")
        assert (TileMap.open(tmp_path / str(looks)).read(T, SPEC).logits.argmax(-1) == label).all()


def test_diff_tells_what_appeared_vanished_and_changed(city, tmp_path):
    labels = np.full(SPEC.shape, 3)
    labels[5:8] = 1
    write(city, labels_as_logits(labels), ALL, np.eye(4), stamp=10.0)
    later = labels.copy()
    later[5] = 3  # vanished
    later[7] = 2  # changed
    later[10, :4] = 0  # appeared
    write(city, labels_as_logits(later), ALL, np.eye(4), stamp=20.0)
    changes = diff_times(city, 15.0, 25.0)
    layer = SPEC.shape[1] * SPEC.shape[2]
    assert changes.summary() == {
        "compared": SPEC.num_voxels, "learnt": 0, "forgotten": 0,
        "appeared": {"voxels": 4 * 8, "labels": {"car": 4 * 8}},
        "vanished": {"voxels": layer, "labels": {"manmade": layer}},
        "changed": {"voxels": layer, "labels": {"vegetation": layer}},
    }  # fmt: skip
    index = SPEC.index(changes.points)
    assert (labels[tuple(index.T)] == changes.before).all()
    assert (later[tuple(index.T)] == changes.after).all()
    empty = TileMap.create(tmp_path / "empty", NAMES, heights=8)
    assert diff(empty, city).learnt == diff(city, empty).forgotten == SPEC.num_voxels
    with pytest.raises(ConfigError, match="another lattice"):
        diff(city, TileMap.create(tmp_path / "other", NAMES, heights=4))


def test_the_agent_that_contradicts_the_others_is_found(city, rng):
    truth = np.where(rng.random(SPEC.shape) < 0.3, 1, 3)
    for n, agent in enumerate(("a", "b", "c", "liar")):
        labels = np.where(rng.random(SPEC.shape) < 0.05, 4 - truth, truth)  # 1 <-> 3 in one of twenty
        if agent == "liar":
            labels = 4 - truth
        write(city, labels_as_logits(labels), ALL, np.eye(4), stamp=float(n), agent=agent, log=agent)
    assert (city.read(np.eye(4), SPEC).logits.argmax(-1) == 4 - truth).all(), "the last to write was the liar"
    witnesses = audit(city)
    assert witnesses[0].agent == "liar"
    assert witnesses[0].contradicted > 0.9
    assert all(w.contradicted < 0.15 for w in witnesses[1:])
    assert [w.agent for w in quarantine_contradicting(city)] == ["liar"]
    city.rebuild()
    assert (city.read(np.eye(4), SPEC).logits.argmax(-1) == truth).mean() > 0.9
    assert describe(city)["agents"]["liar"].endswith("of 3840 voxels contradicted by the others")


def test_dynamic_removal(rng):
    names = ("car", "manmade", "pedestrian", "free")
    logits, known = random_logits(rng), rng.random(SPEC.shape) < 0.8
    label = logits.argmax(-1)
    moving, free = known & np.isin(label, [0, 2]), known & (label == 3)
    first = remove_dynamic(logits, known, names, version=1)
    assert not first[moving].any()
    assert (first[~moving] == logits[~moving]).all()
    second = remove_dynamic(logits, known, names, version=2, seed=1)
    assert (second[~moving] == logits[~moving]).all()
    assert {row.tobytes() for row in second[moving]} <= {row.tobytes() for row in logits[free]}
    assert (second == remove_dynamic(logits, known, names, version=2, seed=1)).all()
    with pytest.raises(ConfigError, match="the classes have no 'free'"):
        remove_dynamic(logits, known, ("a", "b", "c", "d"), version=1)


def test_refused(city, tmp_path, rng, unchecked):
    bare = TileMap.create(tmp_path / "bare", NAMES, journal=False)
    with pytest.raises(ConfigError, match="has no journal"):
        bare.rebuild()
    with pytest.raises(ConfigError, match="a map is not folded otherwise in place"):
        city.rebuild(policy="bayes")
    with pytest.raises(ConfigError, match="policy is not known"):
        FoldConfig(policy="median")  # type: ignore
    with pytest.raises(ConfigError, match="the times are not in order"):
        diff_times(city, 2.0, 1.0)
