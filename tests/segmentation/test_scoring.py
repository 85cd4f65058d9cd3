"""Scores: definitions written out, limits, and Platt's fit against a fit that nobody here wrote."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from openvocab_occ.errors import DataError
from openvocab_occ.segmentation.card import Calibration, ScoreCard
from openvocab_occ.segmentation.scoring import Scoring, classify, fit_platt, scoring_of, unknown_words


class Text:
    """Words as axes."""

    dim = 3

    def encode(self, texts):
        return np.stack([np.eye(3, dtype=np.float32)["xyz".index(t)] for t in texts])


def directions(seed, n=20):
    v = np.random.default_rng(seed).normal(size=(n, 3)).astype(np.float32)
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@settings(max_examples=30)
@given(st.integers(0, 99), st.floats(0.1, 30), st.floats(0.1, 7))
def test_relevancy_is_the_least_softmax_against_each_negative(seed, scale, length):
    features, vector = directions(seed), np.float32([1, 0, 0])
    score = scoring_of(ScoreCard(kind="relevancy", scale=scale, negatives=("y", "z")), Text())
    e = np.exp(scale * features.astype(float))
    wanted = np.minimum(e[:, 0] / (e[:, 0] + e[:, 1]), e[:, 0] / (e[:, 0] + e[:, 2]))
    np.testing.assert_allclose(score(features * np.float32(length), vector), wanted, atol=1e-5)


@settings(max_examples=30)
@given(st.integers(0, 99), st.floats(0.1, 30), st.floats(-10, 10))
def test_sigmoid_cosine_and_probability(seed, scale, bias):
    features, vector = directions(seed), np.float32([0, 1, 0])
    np.testing.assert_allclose(scoring_of(ScoreCard(), Text())(3 * features, vector), features[:, 1], atol=1e-6)
    wanted = 1 / (1 + np.exp(-(scale * features[:, 1].astype(float) + bias)))
    score = scoring_of(ScoreCard(kind="sigmoid", scale=scale, bias=bias), Text())
    np.testing.assert_allclose(score(features, vector), wanted, atol=1e-5)
    assert score.threshold == 0.5
    told = Calibration(a=scale, b=bias, classes=3.0, others=7.0, neutral=0.5, dataset="d", date="2026-01-01", count=9)
    fitted = scoring_of(ScoreCard(kind="relevancy", scale=5.0, negatives=("x",), calibration=told), Text())
    assert fitted.kind == "probability"
    assert (fitted.classes, fitted.others, fitted.neutral) == (3, 7, 0.5)
    np.testing.assert_allclose(fitted(features, vector), wanted, atol=1e-5)


def test_features_of_no_length_score_as_cosine_zero():
    nothing, vector = np.zeros((2, 3), np.float32), np.float32([1, 0, 0])
    assert (Scoring(kind="cosine", threshold=0.2)(nothing, vector) == 0).all()
    assert (Scoring(kind="sigmoid", threshold=0.5, scale=9.0)(nothing, vector) == 0.5).all()


def test_classify_takes_the_nearest():
    vectors = directions(5, 4)
    np.testing.assert_array_equal(classify(vectors[[2, 0, 3]].reshape(1, 3, 3), vectors), [[2, 0, 3]])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_platt_is_the_maximum_of_the_likelihood(seed):
    rng = np.random.default_rng(seed)
    cosines = rng.uniform(-0.2, 0.9, 400)
    positive = rng.random(400) < 1 / (1 + np.exp(-(12 * cosines - 5)))
    found = fit_platt(cosines, positive, dataset="toy", date="2026-01-01")
    good, bad = positive.sum(), (~positive).sum()
    target = np.where(positive, (good + 1) / (good + 2), 1 / (bad + 2))

    def loss(w):
        z = w[0] * cosines + w[1]
        return (np.logaddexp(0, z) - target * z).sum()

    best = minimize(loss, [1.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-10, "maxiter": 5000})
    np.testing.assert_allclose([found.a, found.b], best.x, rtol=1e-4)
    assert (found.count, found.dataset) == (400, "toy")
    assert abs(found.a - 12) < 4


def test_labels_that_cannot_be_fitted_are_told():
    cosines, positive = np.linspace(0, 1, 40), np.arange(40) >= 20
    with pytest.raises(DataError, match="at least 10 of each kind, got 40 and 0"):
        fit_platt(cosines, np.ones(40, bool), dataset="d", date="")
    with pytest.raises(DataError, match="labels contradict the model"):
        fit_platt(-cosines, positive, dataset="d", date="")
    with pytest.raises(DataError, match="cosines are not finite"):
        fit_platt(np.full(40, np.nan), positive, dataset="d", date="")
    perfect = fit_platt(cosines, positive, dataset="d", date="")  # separable: finite by Platt's targets
    assert np.isfinite([perfect.a, perfect.b]).all()


def test_encoders_that_cannot_say_know_every_word():
    assert unknown_words(Text(), ["anything"]) == ()
