"""Objects of many maps in one index: as a search by hand would find them."""

from dataclasses import replace

import jaxtyping
import numpy as np
import pyarrow as pa
import pytest

from openvocab_occ.errors import (
    AlreadyExistsError,
    ConfigError,
    EncoderMismatchError,
    MapError,
    NotFoundError,
    QueryError,
)
from openvocab_occ.geometry import pose
from openvocab_occ.objects import EncoderInfo, ObjectTree, SceneMap

lance = pytest.importorskip("lance", reason="the extra scale is not installed")

from openvocab_occ.pipeline.city_index import CityIndex, Where  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore")  # Lance's own
DIM = 16
DENSE = EncoderInfo(name="toy", contract="dense", dim=DIM, fingerprint="cd" * 32)


class Words:
    """A text side that knows three words."""

    dim = DIM

    def encode(self, texts):
        known = {"truck": 0, "car": 1, "tree": 2}
        return np.stack([np.eye(DIM, dtype=np.float32)[known[text]] for text in texts])


class Encoder:
    name, contract, dim, labels, fingerprint, text = "toy", "dense", DIM, (), DENSE.fingerprint, Words()

    def encode(self, images):
        raise NotImplementedError


def rows(rng, count, *, dim=DIM, clusters=0):
    """Random objects of ten maps; unit features, around some directions or anywhere."""
    features = rng.standard_normal((count, dim))
    if clusters:
        features = rng.standard_normal((clusters, dim))[rng.integers(0, clusters, count)] + 0.3 * features
    features = (features / np.linalg.norm(features, axis=1, keepdims=True)).astype(np.float32)
    xyz = rng.uniform(-500, 500, (3, count))
    first = rng.uniform(0, 1000, count)
    table = pa.table({
        "key": [f"m{n % 10}/{n}" for n in range(count)], "map": [f"m{n % 10}" for n in range(count)],
        "id": np.arange(count), "label": ["thing"] * count,
        "state": np.array(["parked", "moving"])[np.arange(count) % 2],
        "x": xyz[0], "y": xyz[1], "z": xyz[2], "first_seen": first, "last_seen": first + rng.uniform(0, 50, count),
        "embedding": pa.FixedSizeListArray.from_arrays(pa.array(features.ravel()), dim),
    })  # fmt: skip
    return table, features


def best(features, vector, keep, limit):
    scores = np.where(keep, features @ vector, -np.inf)
    order = np.argsort(-scores, kind="stable")[:limit]
    return [int(n) for n in order if keep[n]]


def test_filters_are_exact(tmp_path, rng):
    index = CityIndex.create(tmp_path / "city.lance", DENSE)
    table, features = rows(rng, 3000)
    index.append(table)
    assert not index.index(), "below a million rows nothing is approximate"
    column = {name: np.array(table[name]) for name in table.column_names if name != "embedding"}
    region = np.array([[-200.0, -100, -400], [100, 300, 400]])
    xyz = np.stack([column[a] for a in "xyz"], 1)
    cases = {
        "all": (Where(), np.ones(3000, bool)),
        "box": (Where(region=region), ((xyz >= region[0]) & (xyz <= region[1])).all(1)),
        "state": (Where(states=["parked"]), column["state"] == "parked"),
        "time": (Where(since=300.0, until=400.0), (column["last_seen"] >= 300) & (column["first_seen"] <= 400)),
        "maps": (Where(maps=["m3", "it's"]), column["map"] == "m3"),
        "one each": (Where(region=region, states=["moving"], since=500.0, maps=["m1", "m5"]),
                     ((xyz >= region[0]) & (xyz <= region[1])).all(1) & (column["state"] == "moving")
                     & (column["last_seen"] >= 500) & np.isin(column["map"], ["m1", "m5"])),
        "none": (Where(since=1e9), np.zeros(3000, bool)),
    }  # fmt: skip
    for name, (where, keep) in cases.items():
        vector = features[rng.integers(3000)]
        hits = index.search(vector, where=where, limit=25)
        assert [hit.id for hit in hits] == best(features, vector, keep, 25), name
        np.testing.assert_allclose([h.score for h in hits], [features[h.id] @ vector for h in hits], atol=1e-6)


def test_an_inverted_file_finds_nearly_all(tmp_path, rng):
    """Recall of the 20 nearest on random vectors, with refinement; also behind a filter. Exact search stays there."""
    index = CityIndex.create(tmp_path / "city.lance", DENSE)
    table, features = rows(rng, 20_000, clusters=200)
    index.append(table)
    assert index.index(exact_rows=20_000)
    again = CityIndex.open(tmp_path / "city.lance")
    found = {"all": 0, "parked": 0}
    queries = features[rng.integers(0, len(features), 20)] + 0.1 * rng.standard_normal((20, DIM)).astype(np.float32)
    for vector in queries.astype(np.float32):
        for name, where, keep in (
            ("all", None, np.ones(len(features), bool)),
            ("parked", Where(states=["parked"]), np.arange(len(features)) % 2 == 0),
        ):
            wanted = best(features, vector, keep, 20)
            assert {h.id for h in again.search(vector, where=where, limit=20, exact=True)} == set(wanted)
            found[name] += len(set(wanted) & {hit.id for hit in again.search(vector, where=where, limit=20)})
    assert found["all"] / 400 > 0.95
    assert found["parked"] / 400 > 0.9


def test_words_find_the_objects_of_maps(tmp_path, street):
    """As `find` scores them; a map put in again takes the place of the old one; another is moved into the frame."""
    from openvocab_occ.query.find import find

    index = CityIndex.create(tmp_path / "city.lance", street.encoder)
    count = index.add("one", street, start=1000.0)
    assert count == len(index) == len(street.objects)
    assert index.add("one", street, start=1000.0) == len(index), "once more is once"
    street.save(tmp_path / "two.ovmap")
    index.add("two", tmp_path / "two.ovmap", T_city_map=pose((100.0, 0.0, 0.0)))
    assert len(index) == 2 * count
    hits = CityIndex.open(tmp_path / "city.lance").search("lorries", limit=len(index))
    scores = {(h.map, h.id): h.score for h in hits}
    for hit in find(street, "lorries").hits:
        for name in ("one", "two"):
            assert scores[name, hit.object.id] == pytest.approx(hit.score, abs=1e-5)
    first = hits[0]
    assert first.label == "truck"
    thing = street.objects[first.id]
    offset = 100.0 if first.map == "two" else 0.0
    np.testing.assert_allclose(first.center, thing.center + np.array([offset, 0, 0]))
    near = index.search("truck", where=Where(region=np.array([[90.0, -50, -50], [200, 50, 50]])), limit=50)
    assert {hit.map for hit in near} == {"two"}
    late = index.search("truck", where=Where(since=1000.0), limit=50)
    assert {hit.map for hit in late} == {"one"}
    smaller = replace_objects(street, 2)
    index.add("one", smaller)
    assert len(index) == count + len(smaller.objects), "what is gone from a map is gone from the index"


def replace_objects(scene: SceneMap, count: int) -> SceneMap:
    kept = list(scene.objects)[:count]
    nodes = [replace(o, parent=0, children=()) for o in kept]
    root = replace(scene.objects.root, children=tuple(o.id for o in nodes))
    return replace(scene, objects=ObjectTree([root, *nodes]))


def test_dense_words(tmp_path, rng):
    index = CityIndex.create(tmp_path / "city.lance", DENSE)
    table, features = rows(rng, 200)
    index.append(table)
    hits = index.search("trucks", Encoder(), limit=5)
    assert [h.id for h in hits] == best(features, np.eye(DIM, dtype=np.float32)[0], np.ones(200, bool), 5)


def test_refused(tmp_path, street, rng, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(NotFoundError, match="no city index there"):
        CityIndex.open(tmp_path / "none")
    (tmp_path / "other").mkdir()
    with pytest.raises(MapError, match="is not a city index"):
        CityIndex.open(tmp_path / "other")
    index = CityIndex.create(tmp_path / "city.lance", street.encoder)
    with pytest.raises(AlreadyExistsError):
        CityIndex.create(tmp_path / "city.lance", street.encoder)
    dense = CityIndex.create(tmp_path / "dense.lance", DENSE)
    with pytest.raises(EncoderMismatchError, match="map 'one' is of another encoder"):
        dense.add("one", street)
    with pytest.raises(ConfigError, match="the map has no name"):
        index.add("", street)
    index.add("one", street)
    with pytest.raises(QueryError, match="no word is known"):
        index.search("zeppelin")
    with pytest.raises(QueryError, match="vector does not fit"):
        index.search(np.zeros(3, np.float32))
    with pytest.raises(ConfigError, match="need their text encoder"):
        dense.search("truck")
    with pytest.raises(ConfigError, match="region is not a box"):
        index.search("truck", where=Where(region=np.array([[1.0, 0, 0], [0, 1, 1]])))
    with pytest.raises(ConfigError, match="state is one name"):
        index.search("truck", where=Where(states="parked"))
    with pytest.raises(ConfigError, match="limit is not usable"):
        index.search("truck", limit=0)
