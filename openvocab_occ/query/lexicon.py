"""The words that the grammar knows beside nouns: what they mean is said here and nowhere else."""

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

from openvocab_occ.query.algebra import Color, Material, Me, Node, Relation, Sized, State

Words = tuple[str, ...]


def _table(text: str) -> dict[Words, str]:
    """Read lines of `meaning: phrase, phrase`; an indented line goes on with the one before."""
    table: dict[Words, str] = {}
    for line in text.strip().replace("\n    ", " ").splitlines():
        meaning, phrases = line.split(":")
        for phrase in phrases.split(","):
            table[tuple(phrase.split())] = meaning.strip()
    return table


RELATIONS = _table("""
next to: next to, beside, by, at, alongside, adjacent to, right next to, directly next to, next door to, at the
    side of
near: near, near to, close to, around, in the vicinity of, in the proximity of, not far from, among, amongst
far from: far from, far away from, away from, distant from
touching: touching, attached to, leaning against, leaning on, against, connected to, with, having
on: on, on top of, upon, atop, crossing
under: under, underneath, beneath
below: below
above: above, over
inside: inside, in, inside of, within, in the middle of, into
outside: outside, outside of
of: of, belonging to
along: along, lining
between: between, in between
in front of: in front of, ahead of, before
behind: behind, in back of, at the back of, to the rear of
left of: left of, to the left of, on the left of, on the left side of, on the left hand side of, at the left of
right of: right of, to the right of, on the right of, on the right side of, on the right hand side of, at the
    right of
facing: facing, towards, toward,
    looking at, pointing at, pointing to, oriented towards, oriented toward, facing towards, facing
    toward
""")
VIEWER_RELATIONS = _table("""
left of: on the left, to the left, on my left, to my left, to our left, on our left, on the left side, on the
    left hand side
right of: on the right, to the right, on my right, to my right, to our right, on our right, on the right side,
    on the right hand side
in front of: in front, ahead, straight ahead, up ahead
behind: behind me, behind us, in the back
""")
"""Said without an anchor: of the viewer."""
COLORS = _table("""
red: red, crimson, scarlet, maroon, reddish
orange: orange
yellow: yellow, golden, gold, yellowish
green: green, greenish, olive
blue: blue, navy, bluish, azure
purple: purple, violet, lilac
pink: pink, rosa
brown: brown, brownish
white: white, whitish
grey: grey, gray, silver, greyish, grayish
black: black, blackish
bright: bright, light colored, light coloured
dark: dark, dark colored, dark coloured
""")
SIZES = _table("""
large: large, big, huge, giant, massive, enormous, sizable, great
small: small, little, tiny, mini
tall: tall, high
low: low
long: long
short: short
wide: wide, broad
narrow: narrow, thin, slim
""")
MATERIALS = _table("""
wooden: wooden, timber
metal: metal, metallic, steel, iron
concrete: concrete
brick: brick
glass: glass
stone: stone
plastic: plastic
asphalt: asphalt
rubber: rubber
""")
STATES = _table("""
moving: moving, driving, walking, running, riding, travelling, traveling, rolling, in motion, on the move, in
    movement
stopped: stopped, waiting, halted, idling
parked: parked
fixed: fixed, immovable
still: stationary, static, still, motionless, standing still, immobile, unmoving, at rest
""")
SUPERLATIVES = _table("""
volume: largest, biggest, most massive, hugest
-volume: smallest, tiniest, littlest
height: tallest, highest
-height: lowest
length: longest
-length: shortest
width: widest, broadest
-width: narrowest, thinnest
distance: farthest, furthest, most distant, remotest
-distance: nearest, closest
left: leftmost, left most, most left
-left: rightmost, right most, most right
""")
"""A leading minus: the least of it."""
DIMENSIONS = _table("""
height: tall, high, in height
length: long, in length
width: wide, broad, in width
""")
COMPARATIVES = _table("""
+height: taller than, higher than
-height: lower than
+length: longer than
-length: shorter than
+width: wider than, broader than
-width: narrower than
""")
MORE = _table("more: more than, over, at least, above, no less than, beyond, further than, farther than")
LESS = _table(
    "less: less than, under, at most, below, no more than, up to, within, closer than, nearer than, not more than"
)
ABOUT = _table("about: about, around, roughly, approximately, some, circa")
UNITS = _table("""
1: m, metre, metres, meter, meters, mtr
1000: km, kilometre, kilometres, kilometer, kilometers
0.01: cm, centimetre, centimetres, centimeter, centimeters
0.3048: ft, foot, feet
0.9144: yd, yard, yards
""")
NUMBERS = {name: n for n, name in enumerate(
    ["zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven",
    "twelve"])}  # fmt: skip
PAIRS = _table("2: a couple of, a pair of, couple of, pair of, both of the")
ORDINALS = {
    name: n
    for n, name in enumerate(
        ["first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth"], start=1
    )
}
ME = _table("""
me: me, us, myself, here, my car, our car, my vehicle, our vehicle, my position, my location, ego, the ego, ego
    vehicle, the ego vehicle, ego car, the ego car, the viewer, the camera, the robot, you
""")
THINGS = _table("""
any: anything, something, everything, thing, things, object, objects, item, items, stuff, one, ones, what,
    anyone, whatever, all
person: who, whoever, somebody, someone, anybody, everybody
""")
LEVELS = _table("""
group: group of, groups of, row of, rows of, line of, lines of, cluster of, clusters of, bunch of, crowd of,
    crowds of, queue of
part: part of, parts of, piece of, pieces of
region: region of, regions of, area of, areas of
object: object of type, objects of type
""")
COUNTS = _table(
    "count: how many, number of, the number of, what is the number of, count of, count, count all, how much"
)
LIKE = _table("""
like: like, similar to, resembling, look like, looks like, looking like, same as, the same as, similar looking
    to, just like
""")
OPENINGS = _table("""
find: hello, hi, ok,
    find, show, show me, find me, give me, list, locate, highlight, search, search for, look for, looking for,
    i am looking for, i m looking for, get, get me, point out, where is, where are, where s, which, what is,
    what s, what are, is there, are there, do you see, can you see, can you find, can you show me, could you
    find, i want, i want to see, i need, please, hey, tell me, tell me about, display, select, detect, identify,
    is, are, do you know where, take me to, go to, bring me to
""")
NEGATIONS = _table("not: not, no, non, never, n t, isn t, aren t, isnt, arent, neither, nor, is not, are not, don t")
EXCEPT = _table("except: except, except for, but not, but no, excluding, other than, apart from, minus, not including")
LACKING = _table("without: without, lacking, with no")
AND = _table("and: and, &, plus, as well as, and also, and the, together with")
OR = _table("or: or, and or")
BUT = _table("but: but, yet")
FILLERS = _table("""
filler: a, an, the, any, some, all, every, each, this, that, these, those, there, here, please, is, are, was,
    were, be, been, being, it, its, which, who, also, both, either, currently, right now, now, just, really,
    very, visible, seen, located, situated, placed, positioned, found, you, me, my, in the scene, in this scene,
    in the map, in this map, on the map, in the picture, in the image, several, multiple, many, few, a few,
    various, different, of them, of those, do, does, did, can, could, we, i, have, has, colored, coloured, in
    color, in colour, in total, in all, around here, only, so, exactly, directly,  of the
""")
"""Words without a meaning of their own here."""
POSTURES = _table("posture: standing, sitting, lying, hanging, stood, set, resting, sat")
"""Said of how a thing is where a relation says; without a relation they are words like others."""
CLAUSE = _table(
    "clause: that, which, who, that is, that are, which is, which are, who is, who are, that was, that were"
)


class Found(NamedTuple):
    """A phrase of a table at a place in a text."""

    meaning: str
    length: int


@cache
def _longest(table_id: int) -> int:
    return max(map(len, _TABLES[table_id]))


_TABLES: dict[int, Mapping[Words, str]] = {}


def at(table: Mapping[Words, str], words: Words, start: int) -> Found | None:
    """Return the longest phrase of a table that begins at a word."""
    _TABLES.setdefault(id(table), table)
    for length in range(min(_longest(id(table)), len(words) - start), 0, -1):
        meaning = table.get(words[start : start + length])
        if meaning is not None:
            return Found(meaning, length)
    return None


def attribute_at(words: Words, start: int) -> tuple[Node, int] | None:
    """Return the attribute that begins at a word, and its number of words."""
    if words[start : start + 1] in (("light",), ("pale",)) and at(COLORS, words, start + 1):
        return Color("bright"), 1  # light blue
    if words[start : start + 1] == ("nearby",):
        return Relation("near", (Me(),)), 1
    for table, make in ((STATES, State), (COLORS, Color), (SIZES, Sized), (MATERIALS, Material)):
        found = at(table, words, start)
        if found:
            return make(found.meaning), found.length  # pyright: ignore[reportArgumentType]
    return None


def vocabulary() -> set[str]:
    """Return every word that some table knows, for hints about unknown ones."""
    tables = (COLORS, SIZES, MATERIALS, STATES, SUPERLATIVES, RELATIONS)
    return {word for table in tables for phrase in table for word in phrase if len(word) > 3}
