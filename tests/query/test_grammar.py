import importlib.util
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.errors import QueryError
from openvocab_occ.query import algebra as q
from openvocab_occ.query.grammar import parse, tokens_of
from openvocab_occ.query.reading import reading_of

_spec = importlib.util.spec_from_file_location("phrases", Path(__file__).with_name("phrases.py"))
assert _spec is not None
assert _spec.loader is not None
phrases = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(phrases)


def short(value):
    """A query on one line."""
    match value:
        case q.Noun(text):
            return text.replace(" ", "_")
        case q.And(of) | q.Or(of):
            return f"{type(value).__name__.lower()}({', '.join(map(short, of))})"
        case q.Node():
            fields = [getattr(value, name) for name in value.__struct_fields__]
            flat = [x for field in fields for x in (field if isinstance(field, tuple) else (field,))]
            return f"{type(value).__name__.lower()}({', '.join('-' if x is None else short(x) for x in flat)})"
    return str(value)


@pytest.mark.parametrize(("text", "query", "unread"), phrases.PHRASES, ids=[p[0] for p in phrases.PHRASES])
def test_phrases_are_read(text, query, unread):
    found = parse(text, phrases.LABELS)
    assert (found.query and short(found.query), found.unread) == (query, unread)


def test_there_are_enough_phrases():
    assert len(phrases.PHRASES) >= 150


@pytest.mark.parametrize("text", [p[0] for p in phrases.PHRASES if p[1]])
def test_what_is_read_is_valid_says_so_and_survives_json(text):
    query = parse(text, phrases.LABELS).query
    assert query is not None
    assert q.checked(query) == query
    assert q.from_json(q.to_json(query)) == query
    assert reading_of(query)


@settings(max_examples=60)
@given(st.text(min_size=1, max_size=200))
def test_no_text_breaks_the_grammar(text):
    try:
        found = parse(text, phrases.LABELS)
    except QueryError:
        return
    assert found.query is not None or found.unread


WORDS = ("car", "red", "parked", "the", "of", "within", "20", "m", "and", "or", "not", "between", "left", "to", "near",
         "-", ",", "(", ")", "#3", "largest", "second", "two", "that", "is", "but", "except", "me", "on", "how many",
         "like", "taller than", "from", "stop sign", "without", "?")  # fmt: skip


@settings(max_examples=40)
@given(st.lists(st.sampled_from(WORDS), min_size=1, max_size=30))
def test_no_word_is_dropped_unsaid(words):
    """Every content word is in the query or among the unread ones."""
    text = " ".join(words)
    try:
        found = parse(text, phrases.LABELS)
    except QueryError:
        return
    said = " ".join(found.unread) + (str(msgspec.to_builtins(found.query)) if found.query is not None else "")
    for word, seen in (("car", "car"), ("parked", "parked"), ("red", "red"), ("stop sign", "stop sign")):
        if word in words and found.query is not None:
            assert all(part in said for part in seen.split())


@settings(max_examples=25)
@given(st.sampled_from([p[0] for p in phrases.PHRASES]))
def test_case_space_and_courtesy_change_nothing(text):
    plain = parse(text, phrases.LABELS)
    if plain.query is None:
        return
    assert parse(f"  {text.upper().replace(' ', '   ')} ", phrases.LABELS).query == plain.query
    if not text.lower().startswith(("please", "not", "except")) and tokens_of(text)[0] not in ("not",):
        assert parse(f"please {text}", phrases.LABELS).query == plain.query


@pytest.mark.parametrize(
    "text", ["car " * 240, "near " * 190, "not " * 240 + "car", "car near " * 100, "(" * 900, "#1 " * 300]
)
def test_long_nonsense_is_read_or_refused_in_no_time(text):
    if len(tokens_of(text)) > 250:
        with pytest.raises(QueryError, match="too long"):
            parse(text.strip(), phrases.LABELS)
    else:
        found = parse(text.strip(), phrases.LABELS)
        assert found.query is not None or found.unread


def test_labels_of_several_words_are_not_taken_apart():
    assert parse("parked stop signs", ["stop sign"]).query == q.And((q.Noun("stop signs"), q.State("parked")))
    assert parse("left turn arrow", ["left turn arrow"]).query == q.Noun("left turn arrow")
