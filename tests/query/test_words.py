import pytest

from openvocab_occ.query.words import match_labels

LABELS = ("road", "curb", "truck", "traffic cone", "bus", "person")


@pytest.mark.parametrize(
    ("text", "labels", "unknown"),
    [
        ("truck", {"truck"}, ()),
        ("TRUCKS", {"truck"}, ()),
        ("buses", {"bus"}, ()),
        ("bus", {"bus"}, ()),
        ("people", {"person"}, ()),
        ("traffic cones", {"traffic cone"}, ()),
        ("  Traffic-Cone ", {"traffic cone"}, ()),
        ("trafficcone", {"traffic cone"}, ()),
        ("traffic", set(), ("traffic",)),
        ("parked trucks", {"truck"}, ("parked",)),
        ("where are the trucks?", {"truck"}, ()),
        ("road or curb", {"road", "curb"}, ()),
        ("not a truck", {"truck"}, ("not",)),
        ("the", set(), ("the",)),
        ("?!", set(), ("?!",)),
        ("unicorns", set(), ("unicorns",)),
    ],
)
def test_words_are_read_as_labels_or_reported(text, labels, unknown):
    match = match_labels(text, LABELS)
    assert {name for name, meant in zip(LABELS, match.channels, strict=True) if meant} == labels
    assert match.unknown == unknown


@pytest.mark.parametrize(
    ("label", "plural"),
    [("truck", "trucks"), ("bus", "buses"), ("person", "people"), ("dining table", "dining tables"),
     ("bench", "benches"),
     ("mouse", "mice"), ("sheep", "sheep"), ("leaf", "leaves"), ("glass", "glasses"), ("tv/monitor", "tv/monitors"),
     ("lorry", "lorries"), ("traffic cone", "traffic cones"), ("building", "buildings"), ("people", "people")],
)  # fmt: skip
def test_every_label_and_its_plural_name_it(label, plural):
    for text in (label, plural, label.upper(), f"the {plural}!"):
        assert match_labels(text, ["x", label, "y"]).channels.tolist() == [False, True, False], text


def test_the_longest_label_wins_also_inflected():
    assert match_labels("traffic cones", ["traffic", "traffic cone"]).channels.tolist() == [False, True]


def test_compound_labels_are_found_written_apart():
    assert match_labels("dining tables", ["diningtable"]).channels.all()
