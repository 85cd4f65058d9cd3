"""Reading and writing the map as a whole, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

import openvocab_occ as ovo
from openvocab_occ.errors import AlreadyExistsError, ConfigError, DataError, NotFoundError, PoseError, ShapeError
from openvocab_occ.geometry import pose
from openvocab_occ.memory import TileMap
from openvocab_occ.memory.schema import MapSchema
from tests.memory.conftest import NAMES, SPEC, centred, contents, probabilities, random_logits, random_pose, write


def test_public_names():
    assert ovo.TileMap is TileMap
    assert ovo.Prior.__name__ == "Prior"


@pytest.mark.parametrize("dtype", ["uint8", "float16", "float32"])
@pytest.mark.parametrize("shift", [(0, 0, 0), (12.0, -20.4, 0.4), (-1000.0, 800.0, -9.6)])
def test_aligned_write_reads_back_bit_for_bit(tmp_path, rng, dtype, shift):
    city = TileMap.create(tmp_path / "m", NAMES, heights=8, dtype=dtype)
    logits, mask, T = random_logits(rng), rng.random(SPEC.shape) < 0.4, pose(shift)
    report = write(city, logits, mask, T)
    prior = city.read(T, SPEC)
    assert report.voxels == report.changed == mask.sum()
    assert (prior.known == mask).all()
    assert not prior.logits[~mask].any()
    stored = city.schema.decode(city.schema.encode(logits[mask]))
    np.testing.assert_allclose(prior.logits[mask], stored, atol=2e-6 if dtype == "uint8" else 0)
    if dtype == "uint8":
        np.testing.assert_allclose(probabilities(stored), probabilities(logits[mask]), atol=0.02)
    else:
        np.testing.assert_allclose(stored, centred(logits[mask]), atol={"float16": 4e-3, "float32": 0}[dtype])


def test_older_writes_change_nothing_and_replace_does(city, rng):
    T, mask = np.eye(4), np.ones(SPEC.shape, bool)
    new, old = random_logits(rng), random_logits(rng)
    write(city, new, mask, T, stamp=200.0)
    before = contents(city)
    assert write(city, old, mask, T, stamp=100.0).changed == 0
    assert contents(city) == before
    assert write(city, old, mask, T, stamp=100.0, policy="replace").changed == mask.sum()
    np.testing.assert_allclose(probabilities(city.read(T, SPEC).logits), probabilities(old), atol=0.02)


def test_logs_can_be_left_out_until_they_are_merged(city, rng):
    T, mask = np.eye(4), np.ones(SPEC.shape, bool)
    first, second = random_logits(rng), random_logits(rng)
    write(city, first, mask, T, stamp=1.0, log="one")
    write(city, second, mask, T, stamp=2.0, log="two")
    full = city.read(T, SPEC)
    np.testing.assert_allclose(
        probabilities(city.read(T, SPEC, exclude_logs=["two"]).logits), probabilities(first), atol=0.02
    )
    assert not city.read(T, SPEC, exclude_logs=("one", "two", "never driven")).known.any()
    assert city.consolidate("one") > 0
    assert (city.read(T, SPEC).logits == full.logits).all()
    assert city.logs() == {"one": True, "two": False}
    np.testing.assert_allclose(
        probabilities(city.read(T, SPEC, exclude_logs=["two"]).logits), probabilities(first), atol=0.02
    )
    with pytest.raises(ConfigError, match="log 'one' cannot be left out: it is merged into the base"):
        city.read(T, SPEC, exclude_logs=["one"])
    write(city, second, mask, T, stamp=3.0, log="one")
    assert city.read(T, SPEC, exclude_logs=["two"]).known.all()


def test_readers_see_what_others_write(city, rng):
    other = TileMap.open(city.store.name)
    T, mask = random_pose(rng), np.ones(SPEC.shape, bool)
    assert not other.read(T, SPEC).known.any()
    for stamp in (1.0, 2.0):
        write(city, random_logits(rng), mask, T, stamp=stamp)
        assert (other.read(T, SPEC).logits == city.read(T, SPEC).logits).all()
    assert other.read(T, SPEC).known.any()


def test_a_small_cache_reads_the_same(city, rng):
    tiny = TileMap.open(city.store.name, cache_bytes=1)
    for n in range(5):
        write(city, random_logits(rng), np.ones(SPEC.shape, bool), random_pose(rng, reach=30), log=str(n))
    poses = [random_pose(rng, reach=30) for _ in range(6)]
    wanted = [city.read(T, SPEC) for T in poses]
    for prior, other in zip(wanted, tiny.read_route(poses, SPEC), strict=True):
        assert (prior.logits == other.logits).all()
        assert (prior.known == other.known).all()


def test_memories_fade_with_age(city, rng):
    T, mask = np.eye(4), np.ones(SPEC.shape, bool)
    write(city, random_logits(rng), mask, T, stamp=1000.0)
    fresh = city.read(T, SPEC)
    faded = city.read(T, SPEC, half_life=60.0, now=1120.0)
    assert (faded.known == fresh.known).all()
    np.testing.assert_allclose(faded.logits, fresh.logits / 4, rtol=1e-4)
    assert (city.read(T, SPEC, half_life=60.0, now=900.0).logits == fresh.logits).all(), "the future does not amplify"


def test_refused(tmp_path, city, rng, unchecked):
    logits, mask, T = random_logits(rng), np.ones(SPEC.shape, bool), np.eye(4)
    with pytest.raises(AlreadyExistsError, match="is not empty"):
        TileMap.create(city.store.name, NAMES)
    with pytest.raises(NotFoundError, match="no tile map there"):
        TileMap.open(tmp_path / "none")
    with pytest.raises(ConfigError, match="class names do not tell classes apart"):
        TileMap.create(tmp_path / "x", ["a", "a"])
    with pytest.raises(ConfigError, match="dtype is not known: expected uint8, float16 or float32"):
        MapSchema(NAMES, dtype="int4")  # type: ignore
    with pytest.raises(ConfigError, match="cell or z0 is not usable"):
        TileMap.create(tmp_path / "x", NAMES, cell=0.0)
    with pytest.raises(ShapeError, match=r"logits has the wrong shape: expected \(20, 24, 8, 4\)"):
        write(city, logits[..., :3], mask, T)
    with pytest.raises(ShapeError, match="mask has the wrong shape"):
        write(city, logits, mask[1:], T)
    broken = logits.copy()
    broken[3, 3, 3, 1] = np.nan
    with pytest.raises(DataError, match=r"logits under the mask are not finite: .*1 of 3840 voxels"):
        write(city, broken, mask, T)
    with pytest.raises(ConfigError, match="stamp is not a time"):
        write(city, logits, mask, T, stamp=1e12)
    with pytest.raises(ConfigError, match="stamp is not a time"):
        write(city, logits, mask, T, stamp=float("nan"))
    with pytest.raises(ConfigError, match=r"policy is not known: .*bayes and ema are folded from the journal"):
        city.write(logits, mask, T, SPEC, stamp=1.0, agent="a", log="l", policy="bayes")
    with pytest.raises(ConfigError, match="agent is not a name"):
        write(city, logits, mask, T, agent=" ")
    with pytest.raises(ConfigError, match="log is not a name"):
        write(city, logits, mask, T, log="")
    with pytest.raises(PoseError, match="lies outside what a map can hold"):
        write(city, logits, mask, pose((3e7, 0, 0)))
    with pytest.raises(ConfigError, match="interpolation is not known"):
        city.read(T, SPEC, interpolation="cubic")
    with pytest.raises(ConfigError, match="half_life is not usable"):
        city.read(T, SPEC, half_life=0.0)
    with pytest.raises(ConfigError, match="exclude_logs is one name"):
        city.read(T, SPEC, exclude_logs="one")
    assert contents(city) == {}
    assert city.agents() == {}
    assert city.store.list("journal/") == []
    broken[3, 3, 3, 1] = np.nan
    mask[3, 3, 3] = False
    assert write(city, broken, mask, T).changed == mask.sum(), "what is hidden may be anything"


def test_names_of_any_letters_and_no_way_out_of_the_folder(city, rng):
    for log in ("../../etc", "ä/ö:ü", "a b", "."):
        write(city, random_logits(rng), np.ones(SPEC.shape, bool), np.eye(4), log=log, agent=log)
    assert set(city.logs()) == {"../../etc", "ä/ö:ü", "a b", "."}
    assert {p.name for p in Path(city.store.name).iterdir()} == {
        "zarr.json", "base", "logs", "journal", "agents", "registry", ".locks",
    }  # fmt: skip
    assert sorted(p.name for p in (Path(city.store.name) / "journal").iterdir()) == sorted(
        ["%2E%2E%2F%2E%2E%2Fetc", "%C3%A4%2F%C3%B6%3A%C3%BC", "a%20b", "%2E"]
    )
