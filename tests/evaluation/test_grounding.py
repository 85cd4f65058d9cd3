from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.evaluation.grounding import calibration_of, judge, summarize
from openvocab_occ.evaluation.grounding_drive import Drive, judge_drive, questions_of
from openvocab_occ.evaluation.grounding_metrics import (
    auc_top_k,
    average_precision,
    box_iou,
    calibration_error,
    confusion,
    segmentation_scores,
    top_n_categories,
)  # fmt: skip
from openvocab_occ.evaluation.grounding_protocols import PRESETS, LabelledScene, evaluate_segmentation
from openvocab_occ.evaluation.grounding_queries import ABSENT, CATEGORIES, questions_about
from openvocab_occ.evaluation.grounding_truth import TrueThing, Truth, scene_of_truth
from openvocab_occ.evaluation.words import CLASSES
from openvocab_occ.mapping import keys_of
from openvocab_occ.mapping.keys import pack
from openvocab_occ.objects import Box
from openvocab_occ.query.relations import Viewpoint


def drawn_box(rng):
    return Box(rng.uniform(-2, 2, 3), rng.uniform(0.5, 4, 3), rng.uniform(-1.5, 1.5))


@given(st.integers(0, 10_000))
@settings(max_examples=20)
def test_iou_is_that_of_counted_points(seed):
    rng = np.random.default_rng(seed)
    a, b = drawn_box(rng), drawn_box(rng)
    points = rng.uniform(-5, 5, (40_000, 3))
    in_a, in_b = a.contains(points), b.contains(points)
    counted = (in_a & in_b).sum() / max((in_a | in_b).sum(), 1)
    assert box_iou(a, b) == pytest.approx(counted, abs=0.06)
    assert box_iou(a, b) == pytest.approx(box_iou(b, a))
    assert box_iou(a, a) == pytest.approx(1.0)


def test_average_precision_and_calibration():
    assert average_precision(np.array([True, True]), 2) == 1
    assert average_precision(np.array([False, True]), 1) == 0.5
    assert average_precision(np.array([True]), 2) == 0.5
    assert average_precision(np.zeros(0, bool), 3) == 0
    with pytest.raises(DataError, match="needs something to find"):
        average_precision(np.array([True]), 0)
    rng = np.random.default_rng(0)
    p = rng.random(200_000)
    assert calibration_error(p, rng.random(len(p)) < p) < 0.01
    assert calibration_error(np.full(100, 0.9), np.zeros(100, bool)) == pytest.approx(0.9)


def test_segmentation_by_hand():
    counts = confusion(np.array([0, 0, 1, 1, 2]), np.array([0, 1, 1, 1, -1]), 4)
    scores = segmentation_scores(counts)
    assert scores.miou == pytest.approx((1 / 2 + 2 / 3 + 0) / 3)
    assert scores.macc == pytest.approx((1 / 2 + 1 + 0) / 3)
    assert scores.fmiou == pytest.approx(0.4 * 1 / 2 + 0.4 * 2 / 3)
    assert scores.accuracy == pytest.approx(3 / 5)
    assert segmentation_scores(counts, mean_over="all").miou == pytest.approx((1 / 2 + 2 / 3) / 4)
    assert segmentation_scores(counts, ignored=[2]).macc == pytest.approx(3 / 4)
    assert segmentation_scores(counts, drop_missing=True).accuracy == pytest.approx(3 / 4)
    with pytest.raises(DataError, match="mean_over is not known"):
        segmentation_scores(counts, mean_over="some")


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_the_truth_scores_everything_under_every_protocol(name):
    rng = np.random.default_rng(3)
    names = ("car", "wall", "other", "free", "tree", "road")
    scenes = []
    for _ in range(2):
        points, truth = rng.uniform(0, 10, (300, 3)), rng.integers(0, 6, 300)
        # five equal neighbours must agree for a vote of five
        points, truth = np.repeat(points, 5, axis=0), np.repeat(truth, 5)
        scenes.append(LabelledScene(points=points, truth=truth, found_points=points, found=truth))
    scores = evaluate_segmentation(scenes, names, PRESETS[name])
    assert (scores.miou, scores.fmiou, scores.macc, scores.accuracy) == pytest.approx((1, 1, 1, 1)) or (name in (
        "openscene", "semantickitti",
    ) and scores.miou == pytest.approx(1))  # fmt: skip
    with pytest.raises(ConfigError, match="nothing to judge"):
        evaluate_segmentation([], names, PRESETS[name])


def test_auc_and_top_n():
    truth = np.arange(100)
    assert auc_top_k(np.eye(100), truth) == pytest.approx(1 - 0.5 / 100)
    assert auc_top_k(-np.eye(100), truth) == pytest.approx(0.5 / 100)
    ranked = np.array([[0, 5], [1, 5], [9, 2], [9, 9]])
    categories = [{"synonyms": frozenset({0}), "vis_sim": frozenset({1})}, {"clutter": frozenset({2})}]
    owner = np.array([0, 0, 1, 1])
    top = top_n_categories(ranked, categories, owner, n=2)
    assert top["synonyms"] == top["vis_sim"] == top["clutter"] == top["incorrect"] == 0.25
    assert top_n_categories(ranked, categories, owner, n=1)["incorrect"] == 0.5
    assert top_n_categories(ranked, categories, owner, n=1, missing=np.ones(4, bool))["missing"] == 1


@pytest.fixture(scope="module")
def truth():
    rows = [
        ("car", "red", "parked", (10, 5, 1), (4, 2, 1.5)), ("car", "blue", "parked", (20, 5, 1), (4, 2, 1.5)),
        ("car", "blue", "moving", (20, -5, 1), (4, 2, 1.5)),
        ("box truck", "green", "moving", (28, 0, 1.5), (6, 2.5, 3)),
        ("bench", "", "fixed", (12, 10, 0.5), (2, 0.6, 1)),
        ("pedestrian", "red", "stopped", (12, 14, 1), (0.5, 0.5, 1.8)),
    ]  # fmt: skip
    things = tuple(
        TrueThing(
            id=i, kind=kind, color=color, state=state, box=Box(np.array(at, float), np.array(size, float), 0.1 * i)
        )
        for i, (kind, color, state, at, size) in enumerate(rows, start=1)
    )
    return Truth(name="toy", things=things, viewer=Viewpoint(np.zeros(3)), ground=40.0)


def test_a_map_of_the_truth_answers_everything(truth):
    questions = questions_about(truth, 0)
    assert questions == questions_about(truth, 0)
    assert {question.category for question in questions} == set(CATEGORIES)
    outcomes = judge(scene_of_truth(truth, also=ABSENT), truth, questions)
    assert [o.question.text for o in outcomes if o.precision < 1 or o.verdict != o.question.verdict] == []
    for name, score in summarize(outcomes).items():
        assert set(score.accuracy.values()) == {1.0}, name
        assert (score.count_exact, score.false_found) == (1.0, 0.0), name
    assert calibration_of(outcomes) is None


def driven(truth, scene, least=10):
    """A drive that saw the truth with a flawless mapper."""
    sets = {node.id: np.unique(pack(keys_of(node.points, scene.voxels.voxel_size))) for node in scene.objects}
    sure = frozenset(id for id, keys in sets.items() if len(keys) >= least)
    return Drive(scene=scene, truth=truth, sets=sets, sure=sure, watched=frozenset(sets) - {3})


def test_a_drive_that_saw_the_truth_answers_everything(truth):
    drive = driven(truth, scene_of_truth(truth, also=(*ABSENT, *CLASSES)))
    assert 6 not in drive.sure  # the pedestrian is too small to be asked for
    words = {"automobile": "car", "sedan": "car", "barriers": "barrier", "pedestrians": "pedestrian"}
    questions = questions_of(drive, 0, synonyms=words)
    for question in questions:
        assert question.wanted <= drive.sure
        assert not question.wanted & question.either
    texts = {q.text: q for q in questions}
    assert texts["automobile"].wanted == {1, 2, 3}
    assert texts["barriers"].verdict == texts["buses"].verdict == "absent"
    assert texts["parked cars"].either == {3}  # it was not watched for long enough
    assert "pedestrians" not in texts
    outcomes = judge_drive(drive, None, 0, synonyms=words)
    assert [o.question.text for o in outcomes if not o.right] == []
    scores = summarize(outcomes)
    assert all(score.accuracy["0.5"] == score.mean_precision == score.count_exact == 1 for score in scores.values())
    assert {"class", "synonym", "state", "relation", "absent", "unobserved"} <= set(scores)


def test_what_no_class_names_may_be_called_what_it_resembles(truth):
    drive = driven(truth, scene_of_truth(truth, also=(*ABSENT, *CLASSES)))
    near = replace(drive, others={99: "van", 98: "bench"})
    cars = {q.text: q for q in questions_of(near, 0)}["cars"]
    assert 99 in cars.either
    assert 98 not in cars.either | cars.wanted


def test_a_drive_of_something_else_does_not(truth):
    """Objects that are not where the true things are."""
    drive = driven(truth, scene_of_truth(truth, also=(*ABSENT, *CLASSES)))
    away = {id: drive.sets[1 + id % 6] for id in drive.sets}
    outcomes = judge_drive(replace(drive, sets=away), None, 0)
    assert summarize(outcomes)["class"].accuracy["0.25"] < 0.5
    assert [o for o in outcomes if o.question.category == "relation"] == []  # their nouns are not found


def test_a_map_of_something_else_does_not(truth):
    """The judge sees what is wrong: the same questions to a map whose kinds are swapped."""
    kinds = [t.kind for t in truth.things]
    swapped = [
        TrueThing(id=t.id, kind=kind, color=t.color, state=t.state, box=t.box)
        for t, kind in zip(truth.things, reversed(kinds), strict=True)
    ]
    wrong = Truth(name="wrong", things=tuple(swapped), viewer=truth.viewer, ground=truth.ground)
    scores = summarize(judge(scene_of_truth(wrong, also=ABSENT), truth, questions_about(truth, 0)))
    assert scores["class"].accuracy["0.25"] < 0.5
    assert scores["class"].mean_precision < 0.5
    assert scores["absent"].verdicts == 1.0
