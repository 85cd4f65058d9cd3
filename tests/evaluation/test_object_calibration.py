import numpy as np
import pytest

from openvocab_occ.errors import DataError
from openvocab_occ.evaluation.grounding_metrics import calibration_error
from openvocab_occ.evaluation.object_calibration import NEUTRAL, Pairs, fit_objects


def drawn(rng, n, *, a=18.0, classes=7.0, others=25.0, b=-9.0):
    """Pairs whose truth follows the model itself."""
    against = rng.choice([0.0, 0.1], n)
    evidence = np.stack([rng.normal(0.4, 0.15, n), rng.choice([0.0, 0.3], n), against], axis=1)
    p = 1 / (1 + np.exp(-(evidence @ [a, classes, -others] + b)))
    return Pairs(evidence, rng.random(n) < p), p


def test_a_fit_finds_the_law_that_made_the_pairs_and_is_calibrated():
    rng = np.random.default_rng(0)
    pairs = [drawn(rng, 20_000)[0] for _ in range(2)]
    fit = fit_objects(pairs, dataset="made up", date="2026-01-01")
    assert fit.a == pytest.approx(18, rel=0.05)
    assert fit.classes == pytest.approx(7, rel=0.05)
    assert fit.others == pytest.approx(25, rel=0.05)
    assert fit.b == pytest.approx(-9, rel=0.05)
    assert (fit.neutral, fit.count) == (NEUTRAL, 40_000)
    fresh, _ = drawn(rng, 20_000)
    p = 1 / (1 + np.exp(-(fresh.evidence @ [fit.a, fit.classes, -fit.others] + fit.b)))
    assert calibration_error(p, fresh.correct) < 0.01


def test_evidence_that_never_occurs_weighs_nothing():
    rng = np.random.default_rng(1)
    pairs, _ = drawn(rng, 5000)
    fit = fit_objects([Pairs(pairs.evidence * [1, 0, 0], pairs.correct)], dataset="made up", date="2026-01-01")
    assert (fit.classes, fit.others) == (0, 0)


def test_what_speaks_against_a_word_never_speaks_for_it():
    rng = np.random.default_rng(2)
    pairs, _ = drawn(rng, 5000, classes=-5.0, others=-20.0)
    fit = fit_objects([pairs], dataset="made up", date="2026-01-01")
    assert (fit.classes, fit.others) == (0, 0)


def test_evidence_that_never_erred_can_still_be_outvoted():
    """On true grids no car is called a truck; a network's grid will call some so."""
    rng = np.random.default_rng(3)
    pairs, _ = drawn(rng, 20_000)
    never = Pairs(pairs.evidence, pairs.correct & (pairs.evidence[:, 2] == 0))
    fit = fit_objects([never], dataset="made up", date="2026-01-01")
    more = fit_objects([never, never], dataset="made up", date="2026-01-01")
    assert 25 < fit.others < more.others < 1.5 * fit.others < 200


def test_pairs_that_tell_nothing_are_refused():
    cosine = np.linspace(0, 1, 100)
    evidence = np.stack([cosine, np.zeros(100), np.zeros(100)], axis=1)
    with pytest.raises(DataError, match="too few pairs to calibrate: expected at least 10 of each kind"):
        fit_objects([Pairs(evidence, np.zeros(100, bool))], dataset="", date="")
    with pytest.raises(DataError, match="pairs contradict the model"):
        fit_objects([Pairs(evidence, cosine < 0.5)], dataset="", date="")
