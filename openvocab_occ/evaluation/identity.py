"""How well identities hold over frames: IDF1 (Ristani et al. 2016) and HOTA (Luiten et al. 2021)."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

_ALPHAS = np.arange(0.05, 0.96, 0.05)


@dataclass(frozen=True, kw_only=True)
class IdentityScores:
    """1 when every thing keeps one identity of its own in all frames; 0 where nothing is there to match."""

    idf1: float
    hota: float
    switches: int
    """Times that the identity of a true object's best match differs from the one before."""


@dataclass(frozen=True)
class Sight:
    """What a frame shows: true and predicted identities and how far they overlap."""

    true: tuple[int, ...]
    predicted: tuple[int, ...]
    similarity: Mapping[tuple[int, int], float]
    """IoU by (true, predicted) identity; pairs that do not touch may be left out."""


def score_identity(frames: Sequence[Sight]) -> IdentityScores:
    """Score identities over the frames of a drive."""
    return IdentityScores(idf1=_idf1(frames), hota=_hota(frames), switches=_switches(frames))


def _idf1(frames: Sequence[Sight], threshold: float = 0.5) -> float:
    from scipy.optimize import linear_sum_assignment

    together: Counter[tuple[int, int]] = Counter()
    for frame in frames:
        together.update(pair for pair, value in frame.similarity.items() if value >= threshold)
    total = sum(len(f.true) + len(f.predicted) for f in frames)
    if not together or not total:
        return 0.0
    true, predicted = sorted({t for t, _ in together}), sorted({p for _, p in together})
    table = np.zeros((len(true), len(predicted)))
    for (t, p), count in together.items():
        table[true.index(t), predicted.index(p)] = count
    rows, columns = linear_sum_assignment(table, maximize=True)
    return float(2 * table[rows, columns].sum() / total)


def _hota(frames: Sequence[Sight]) -> float:
    """Return HOTA over all thresholds, matched as its authors do: by similarity, weighed by global alignment."""
    true, predicted = Counter[int](), Counter[int]()
    potential: defaultdict[tuple[int, int], float] = defaultdict(float)
    for frame in frames:
        true.update(frame.true)
        predicted.update(frame.predicted)
        sums_t, sums_p = Counter[int](), Counter[int]()
        for (t, p), value in frame.similarity.items():
            sums_t[t] += value  # pyright: ignore[reportArgumentType]
            sums_p[p] += value  # pyright: ignore[reportArgumentType]
        for (t, p), value in frame.similarity.items():
            potential[t, p] += value / max(sums_t[t] + sums_p[p] - value, 1e-12)
    align = {(t, p): v / (true[t] + predicted[p] - v) for (t, p), v in potential.items()}
    matches = [_matched(frame, align) for frame in frames]
    scores = []
    for alpha in _ALPHAS:
        hits: Counter[tuple[int, int]] = Counter()
        for frame, pairs in zip(frames, matches, strict=True):
            hits.update(pair for pair in pairs if frame.similarity[pair] >= alpha - 1e-9)
        tp = sum(hits.values())
        missed, extra = sum(true.values()) - tp, sum(predicted.values()) - tp
        detection = tp / max(tp + missed + extra, 1)
        association = sum(c * c / (true[t] + predicted[p] - c) for (t, p), c in hits.items()) / max(tp, 1)
        scores.append((detection * association) ** 0.5)
    return float(np.mean(scores))


def _matched(frame: Sight, align: Mapping[tuple[int, int], float]) -> list[tuple[int, int]]:
    from scipy.optimize import linear_sum_assignment

    rows = {t: i for i, t in enumerate(frame.true)}
    columns = {p: i for i, p in enumerate(frame.predicted)}
    table = np.zeros((len(rows), len(columns)))
    for (t, p), value in frame.similarity.items():
        table[rows[t], columns[p]] = value * align[t, p]
    best = zip(*linear_sum_assignment(table, maximize=True), strict=True)
    return [(frame.true[r], frame.predicted[c]) for r, c in best if table[r, c] > 0]


def _switches(frames: Sequence[Sight]) -> int:
    last: dict[int, int] = {}
    count = 0
    for frame in frames:
        for t in frame.true:
            near = [(value, p) for (a, p), value in frame.similarity.items() if a == t and value >= 0.5]
            if near:
                p = max(near)[1]
                count += last.get(t, p) != p
                last[t] = p
    return count
