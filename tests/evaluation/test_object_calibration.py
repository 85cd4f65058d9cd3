import numpy as np
import pytest

from openvocab_occ.errors import DataError
from openvocab_occ.evaluation.grounding_metrics import calibration_error
from openvocab_occ.evaluation.object_calibration import NEUTRAL, Pairs, fit_objects


def drawn(rng, n, *, a=18.0, classes=7.0, b=-9.0):
    """Pairs whose truth follows the model itself."""
    evidence = np.stack([rng.normal(0.3, 0.15, n), rng.choice([0.0, 0.3], n)], axis=1)
    p = 1 / (1 + np.exp(-(evidence @ [a, classes] + b)))
    return Pairs(evidence, rng.random(n) < p), p


def test_a_fit_finds_the_law_that_made_the_pairs_and_is_calibrated():
    rng = np.random.default_rng(0)
    pairs = [drawn(rng, 20_000)[0] for _ in range(2)]
    fit = fit_objects(pairs, dataset="made up", date="2026-01-01")
    assert fit.a == pytest.approx(18, rel=0.05)
    assert fit.classes == pytest.approx(7, rel=0.05)
    assert fit.b == pytest.approx(-9, rel=0.05)
    assert (fit.neutral, fit.count) == (NEUTRAL, 40_000)
    fresh, _ = drawn(rng, 20_000)
    p = 1 / (1 + np.exp(-(fresh.evidence @ [fit.a, fit.classes] + fit.b)))
    assert calibration_error(p, fresh.correct) < 0.01


def test_evidence_that_never_occurs_weighs_nothing():
    rng = np.random.default_rng(1)
    pairs, _ = drawn(rng, 5000)
    silent = Pairs(pairs.evidence * [1, 0], pairs.correct)
    assert fit_objects([silent], dataset="made up", date="2026-01-01").classes == 0


def test_pairs_that_tell_nothing_are_refused():
    cosine = np.linspace(0, 1, 100)
    evidence = np.stack([cosine, np.zeros(100)], axis=1)
    with pytest.raises(DataError, match="too few pairs to calibrate: expected at least 10 of each kind"):
        fit_objects([Pairs(evidence, np.zeros(100, bool))], dataset="", date="")
    with pytest.raises(DataError, match="pairs contradict the model"):
        fit_objects([Pairs(evidence, cosine < 0.5)], dataset="", date="")
