"""The query algebra: what a query means, as values that can be built, compared, and sent as JSON.

    from openvocab_occ.query import algebra as q
    q.And((q.Noun("truck"), q.State("parked"), q.Relation("next to", (q.Noun("fence"),))))

Nodes are msgspec structs: frozen and comparable like dataclasses, and the union of them is checked by tag when JSON is
read, which msgspec does for structs only. `to_json` and `from_json` are inverse; `json_schema()` is what a writer of
such JSON, a person or a language model, has to keep to.
"""

from collections.abc import Iterator
from typing import Annotated, Any, Literal, Union

import msgspec
from msgspec import Meta

from openvocab_occ.errors import QueryError

MAX_JSON_BYTES = 8 << 20  # a crop or a long vector
MAX_NODES = 200
MAX_DEPTH = 24

Colour = Literal["red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "white", "grey", "black",
                 "bright", "dark"]  # fmt: skip
Size = Literal["large", "small", "tall", "low", "long", "short", "wide", "narrow"]
Motion = Literal["moving", "stopped", "parked", "fixed", "still"]
"""As tracks tell it; `still` is any of stopped, parked and fixed."""
Dimension = Literal["volume", "length", "width", "height"]
RelationName = Literal[
    "next to", "near", "far from", "touching", "on", "under", "above", "below", "inside", "outside", "of", "along",
    "between", "in front of", "behind", "left of", "right of", "facing",
]  # fmt: skip
LevelName = Literal["region", "group", "object", "part"]
Text = Annotated[str, Meta(min_length=1, max_length=200)]
Metres = Annotated[float, Meta(ge=0, le=1e6)]
Point = Annotated[tuple[float, float, float], Meta(description="metres, world")]


class Node(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="op", tag=str.lower):
    """Any part of a query."""


class Noun(Node, frozen=True):
    """Things of a kind, in words: matched with labels or with an embedding, by the map's encoder."""

    text: Text


class Anything(Node, frozen=True):
    """Every object."""


class Color(Node, frozen=True):
    """Things of a colour, by the colours of their voxels."""

    name: Colour


class Sized(Node, frozen=True):
    """Things large or small for their kind: against the median of what the rest of the query leaves."""

    name: Size


class Material(Node, frozen=True):
    """Things of a material, by their embedding; a map without embeddings of free text does not know it."""

    name: Text


class Measure(Node, frozen=True):
    """Things whose box measures so much."""

    dimension: Literal["length", "width", "height"]
    at_least: Metres = 0.0
    at_most: Metres | None = None


class State(Node, frozen=True):
    """Things that were seen to move or rest so; undecided for those whose motion was not observed."""

    name: Motion


class Me(Node, frozen=True):
    """The viewer: ego at a time, or a given viewpoint."""


class Place(Node, frozen=True):
    """A point of the world."""

    at: Point


class Relation(Node, frozen=True):
    """Things that stand so to an anchor; "between" has two anchors, or one that names several things."""

    name: RelationName
    anchors: Annotated[tuple["Query", ...], Meta(min_length=1, max_length=2)]


class Within(Node, frozen=True):
    """Things whose gap to an anchor lies between two distances."""

    anchor: "Query"
    at_most: Metres | None = None
    at_least: Metres = 0.0


class Not(Node, frozen=True):
    """Everything else."""

    of: "Query"


class And(Node, frozen=True):
    """What all parts agree on."""

    of: Annotated[tuple["Query", ...], Meta(min_length=1, max_length=32)]


class Or(Node, frozen=True):
    """What any part holds."""

    of: Annotated[tuple["Query", ...], Meta(min_length=1, max_length=32)]


class Superlative(Node, frozen=True):
    """The n-th most of something, in one order: largest, second tallest, nearest to an anchor, third from the left."""

    of: "Query"
    by: Literal["volume", "length", "width", "height", "distance", "left"]
    """`distance` is to the anchor, or to the viewer without one; `left` is the bearing from the viewer."""
    least: bool = False
    """Count from the other end: smallest, nearest, rightmost."""
    rank: Annotated[int, Meta(ge=1, le=1000)] = 1
    anchor: Union["Query", None] = None


class Some(Node, frozen=True):
    """The best few."""

    of: "Query"
    number: Annotated[int, Meta(ge=1, le=10_000)]


class Count(Node, frozen=True):
    """How many there are."""

    of: "Query"


class Level(Node, frozen=True):
    """Nodes of one level of the tree; without it a query speaks of objects and regions."""

    of: "Query"
    level: LevelName


class Like(Node, frozen=True):
    """Things that look like an object of the map, itself left out."""

    id: Annotated[int, Meta(ge=0)]


class Item(Node, frozen=True):
    """One object of the map, by its id."""

    id: Annotated[int, Meta(ge=0)]


class Vector(Node, frozen=True):
    """Things near a vector of the encoder's space."""

    values: Annotated[tuple[float, ...], Meta(min_length=1, max_length=65536)]


class Crop(Node, frozen=True):
    """Things that look like a picture: PNG or JPEG bytes (base64 in JSON)."""

    image: Annotated[bytes, Meta(min_length=8)]


class Click(Node, frozen=True):
    """The thing that a ray hits first, and what looks like it."""

    origin: Point
    direction: Point


Query = Union[  # noqa: UP007  (msgspec resolves the forward references of a Union)
    Noun, Anything, Color, Sized, Material, Measure, State, Me, Place, Relation, Within, Not, And, Or, Superlative,
    Some, Count, Level, Like, Item, Vector, Crop, Click,
]  # fmt: skip
NODE_KINDS: tuple[type[Node], ...] = Query.__args__  # pyright: ignore[reportAttributeAccessIssue]


def children(query: Node) -> Iterator[Node]:
    """Yield the queries directly inside a query."""
    for name in query.__struct_fields__:
        value = getattr(query, name)
        for item in value if isinstance(value, tuple) else (value,):
            if isinstance(item, Node):
                yield item


def walk(query: Node) -> Iterator[Node]:
    """Yield a query and everything inside it."""
    stack = [query]
    while stack:
        node = stack.pop()
        yield node
        stack.extend(children(node))


def conjunction(*parts: Node) -> Node:
    """Return the And of parts, flattened; one part is itself."""
    flat = [x for part in parts for x in (part.of if isinstance(part, And) else (part,))]
    flat = list(dict.fromkeys(flat))
    return flat[0] if len(flat) == 1 else And(tuple(flat))  # pyright: ignore[reportArgumentType]


def disjunction(*parts: Node) -> Node:
    """Return the Or of parts, flattened; one part is itself."""
    flat = list(dict.fromkeys(x for part in parts for x in (part.of if isinstance(part, Or) else (part,))))
    return flat[0] if len(flat) == 1 else Or(tuple(flat))  # pyright: ignore[reportArgumentType]


def to_json(query: Node) -> str:
    """Return a query as JSON."""
    return msgspec.json.encode(query).decode()


def from_json(text: str | bytes) -> Node:
    """Read a query from JSON; raises QueryError for anything the schema or `check` refuses."""
    if len(text) > MAX_JSON_BYTES:
        raise QueryError("query JSON is too large", expected=f"at most {MAX_JSON_BYTES} bytes", got=len(text))
    try:
        query = msgspec.json.decode(text, type=Query)
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise QueryError("query JSON is not valid", expected="the schema of json_schema()", got=error) from None
    except RecursionError:
        raise QueryError("query JSON is nested too deeply", expected=f"depth up to {MAX_DEPTH}") from None
    return check(query)


def from_builtins(value: object) -> Node:
    """Read a query from dicts and lists, as `from_json` does from text."""
    try:
        return from_json(msgspec.json.encode(value))
    except (TypeError, RecursionError, msgspec.MsgspecError) as error:
        raise QueryError("query is not plain JSON values", expected="dicts, lists, text, numbers", got=error) from None


def check(query: object) -> Node:
    """Return a query if it makes sense, or raise QueryError.

    It must be small, its numbers finite, and viewer and places may only stand as anchors.
    """
    if not isinstance(query, Node):
        raise QueryError("query is neither text nor algebra", expected="str or a node", got=type(query).__name__)
    if isinstance(query, Me | Place):
        raise QueryError("a viewpoint or place is not a thing to find", expected="a kind of thing", got=query)
    count, level = 0, [query]
    for _ in range(MAX_DEPTH):
        count += len(level)
        for node in level:
            _check_node(node)
        level = [child for node in level for child in children(node)]
        if not level or count > MAX_NODES:
            break
    if level:
        raise QueryError("query is too large", expected=f"up to {MAX_NODES} nodes, nested {MAX_DEPTH} deep")
    return query


def checked(query: object) -> Node:
    """Return a query if `check` and the schema accept it; nodes built in Python are not checked when made."""
    try:
        return from_json(to_json(check(query)))
    except (TypeError, UnicodeError) as error:
        raise QueryError("query holds values of another kind", expected="the fields' types", got=error) from None


def _check_node(node: Node) -> None:
    numbers = [v for name in node.__struct_fields__ for v in _numbers(getattr(node, name))]
    if any(not abs(v) < 1e300 for v in numbers):  # NaN too
        raise QueryError("query holds a number that is not finite", got=type(node).__name__)
    if isinstance(node, Relation) and (len(node.anchors) == 2) and node.name != "between":
        raise QueryError(f'"{node.name}" has one anchor', got=len(node.anchors), fix="join anchors by Or")
    if isinstance(node, Within | Measure) and node.at_most is not None and node.at_most < node.at_least:
        raise QueryError("query asks for an empty range", expected="at_least <= at_most", got=node)
    if isinstance(node, Click) and not any(node.direction):
        raise QueryError("click has no direction", expected="a direction other than 0, 0, 0")
    anchors = node.anchors if isinstance(node, Relation) else (getattr(node, "anchor", None),)
    for child in children(node):
        if isinstance(child, Me | Place) and child not in anchors:
            raise QueryError("a viewpoint or place is not a thing to find", expected="an anchor", got=child)
        if isinstance(child, Count):
            raise QueryError("a count stands outside everything else", got=f"inside {type(node).__name__}")


def _numbers(value: Any) -> list[float]:
    if isinstance(value, float | int):
        return [float(value)] if isinstance(value, float) else []
    return [float(v) for v in value if isinstance(v, float)] if isinstance(value, tuple) else []


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a query (draft 2020-12)."""
    schema = msgspec.json.schema(Query)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "openvocab_occ query", **schema}
