import json

import pytest

from openvocab_occ.errors import QueryError
from openvocab_occ.query import algebra as q

ONE_OF_EACH = [
    q.Noun("truck"), q.Anything(), q.Color("red"), q.Sized("large"), q.Material("wooden"), q.Measure("height", 2.0),
    q.State("parked"), q.Relation("near", (q.Me(),)), q.Relation("between", (q.Noun("a"), q.Place((1.0, 2.0, 0.0)))),
    q.Within(q.Noun("bus"), 20.0), q.Not(q.Noun("car")), q.And((q.Noun("a"), q.State("moving"))),
    q.Or((q.Noun("a"), q.Item(3))), q.Superlative(q.Noun("a"), "distance", True, 2, q.Me()), q.Some(q.Noun("a"), 2),
    q.Count(q.Noun("a")), q.Level(q.Noun("wheel"), "part"), q.Like(42), q.Item(7), q.Vector((0.0, 1.0)),
    q.Crop(b"\x89PNG....."), q.Click((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
]  # fmt: skip


def test_every_kind_of_node_survives_json():
    kinds = {type(node) for query in ONE_OF_EACH for node in q.walk(query)}
    assert kinds == set(q.NODE_KINDS)
    for query in ONE_OF_EACH:
        assert q.from_json(q.to_json(query)) == query
        assert q.from_builtins(json.loads(q.to_json(query))) == query
        assert q.checked(query) == query
        assert hash(query) == hash(q.from_json(q.to_json(query)))


def test_nodes_cannot_be_changed():
    with pytest.raises(AttributeError):
        q.Noun("car").text = "bus"  # pyright: ignore[reportAttributeAccessIssue]


def test_the_schema_names_every_node_and_is_json():
    schema = json.loads(json.dumps(q.json_schema()))
    assert {ref["$ref"].rsplit("/", 1)[1] for ref in schema["anyOf"]} == {kind.__name__ for kind in q.NODE_KINDS}
    assert all(not entry["additionalProperties"] for entry in schema["$defs"].values() if entry["type"] == "object")


def nested(depth):
    query = '{"op":"noun","text":"a"}'
    for _ in range(depth):
        query = f'{{"op":"not","of":{query}}}'
    return query


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not valid"),
        ("null", "not valid"),
        ("[" * 50_000, "not valid|too deeply"),
        (nested(5000), "too deeply|too large"),
        (nested(24), "too large"),
        ('{"op":"noun","text":""}', "length >= 1"),
        ('{"op":"noun","text":"' + "a" * 201 + '"}', "length <= 200"),
        ('{"op":"noun","text":"a","also":1}', "unknown field `also`"),
        ('{"op":"eval","of":"import os"}', "Invalid value 'eval'"),
        ('{"op":"noun"}', "missing required field `text`"),
        ('{"op":"noun","text":7}', "Expected `str`"),
        ('{"op":"color","name":"octarine"}', "Invalid enum value 'octarine'"),
        ('{"op":"within","anchor":{"op":"me"},"at_most":1e999}', "not valid"),
        ('{"op":"within","anchor":{"op":"me"},"at_most":-1}', ">= 0"),
        ('{"op":"within","anchor":{"op":"me"},"at_most":1,"at_least":2}', "empty range"),
        ('{"op":"me"}', "not a thing to find"),
        ('{"op":"not","of":{"op":"me"}}', "not a thing to find"),
        ('{"op":"and","of":[{"op":"count","of":{"op":"anything"}}]}', "a count stands outside"),
        ('{"op":"relation","name":"near","anchors":[{"op":"like","id":1},{"op":"like","id":1}]}', "has one anchor"),
        ('{"op":"click","origin":[0,0,0],"direction":[0,0,0]}', "no direction"),
        ('{"op":"and","of":[]}', "length >= 1"),
        ('{"op":"or","of":[' + ",".join(['{"op":"anything"}'] * 33) + "]}", "length <= 32"),
        (b'\xff\xfe{"op":"me"}', "not valid"),
        ("x" * (q.MAX_JSON_BYTES + 1), "too large"),
    ],
)  # fmt: skip
def test_hostile_json_is_refused(text, message):
    with pytest.raises(QueryError, match=message):
        q.from_json(text)


def test_nodes_made_in_python_are_checked_before_use():
    for query in (q.Noun(""), q.Color("octarine"), q.Vector((float("nan"),)), q.Noun(3), q.And(()), "text", None):  # pyright: ignore
        with pytest.raises(QueryError):
            q.checked(query)
    with pytest.raises(QueryError, match="plain JSON"):
        q.from_builtins({"op": object()})


def test_joining_flattens_and_drops_repetition():
    a, b = q.Noun("a"), q.Noun("b")
    assert q.conjunction(a, q.And((b, a))) == q.And((a, b))
    assert q.disjunction(q.Or((a, b)), a) == q.Or((a, b))
    assert q.conjunction(a) == q.disjunction(a, a) == a
