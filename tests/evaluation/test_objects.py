import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openvocab_occ.datasets import load_sequence
from openvocab_occ.datasets.street import street
from openvocab_occ.evaluation.identity import Sight, score_identity
from openvocab_occ.evaluation.instances import average_precision, overlaps, score_instances
from openvocab_occ.evaluation.object_truth import StreetTruth
from openvocab_occ.evaluation.objects import TruthEncoder, judge_objects

sets = [np.arange(0, 20), np.arange(20, 50), np.arange(100, 112)]


def test_the_truth_scores_perfectly():
    report = score_instances(sets, [1.0, 2.0, 3.0], sets, [False] * 3)
    assert (report.ap25, report.ap50, report.precision50, report.recall50, report.odr, report.mean_iou) == (1,) * 6


def test_what_is_cut_in_two_is_a_duplicate_and_what_is_ignored_is_nothing():
    halves = [np.arange(0, 10), np.arange(10, 20), *sets[1:]]
    report = score_instances(halves, [1.0] * 4, sets, [False] * 3)
    assert report.odr == pytest.approx(4 / 3)
    assert report.recall50 == 1.0  # a half is an IoU of one half
    assert report.precision50 == 0.75
    ignored = score_instances(sets, [1.0] * 3, sets, [True, False, False])
    assert (ignored.true_objects, ignored.predicted_objects, ignored.ap50) == (2, 2, 1.0)
    nothing = score_instances([], [], sets, [False] * 3)
    assert (nothing.ap50, nothing.recall50, nothing.odr) == (0.0, 0.0, 0.0)


@given(
    st.lists(st.sets(st.integers(0, 30), min_size=1), max_size=5),
    st.lists(st.sets(st.integers(0, 30), min_size=1), max_size=5),
)
def test_overlaps_are_those_of_sets(mine, yours):
    a, b = ([np.array(sorted(s), np.int64) for s in side] for side in (mine, yours))
    iou, share = overlaps(a, b)
    for i, p in enumerate(mine):
        for j, q in enumerate(yours):
            assert iou[i, j] == pytest.approx(len(p & q) / len(p | q))
            assert share[i, j] == pytest.approx(len(p & q) / len(p))


def test_average_precision_of_known_curves():
    assert average_precision([True, True], 2) == 1.0
    assert average_precision([False, True], 1) == 0.5
    assert average_precision([True, False, True], 2) == pytest.approx(0.5 + 0.5 * 2 / 3)


def one_to_one(ids):
    return [Sight((1, 2), tuple(p), {(1, p[0]): 1.0, (2, p[1]): 1.0}) for p in ids]


def test_identities_that_hold_score_one_and_switches_cost():
    perfect = score_identity(one_to_one([(7, 8)] * 6))
    assert (perfect.idf1, perfect.hota, perfect.switches) == (1.0, pytest.approx(1.0), 0)
    swapped = score_identity(one_to_one([(7, 8)] * 3 + [(8, 7)] * 3))
    assert swapped.idf1 == 0.5
    assert swapped.switches == 2
    # detection is perfect, association of each match 3 of 9 frames
    assert swapped.hota == pytest.approx((1 / 3) ** 0.5)
    assert score_identity([]).idf1 == 0.0


def test_with_truth_fed_in_the_whole_way_scores_near_perfect():
    """True features on the true grid of a street whose things stand apart."""
    report, scene = judge_objects(load_sequence("street", seed=5, frames=7), StreetTruth(street(5)), TruthEncoder())
    assert report.instances.ap50 == 1.0
    assert report.instances.odr == 1.0
    assert report.identity.idf1 > 0.98
    assert report.state_accuracy == 1.0
    assert report.boxes.center_m < 0.3
    assert {"region", "object"} <= {node.level for node in scene.objects.nodes}
