"""A map in memory is a tile map without disk; its other policies are their formulae."""

import numpy as np
import pytest

from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import GridSpec, pose
from openvocab_occ.memory import TileMap
from openvocab_occ.networks.lmop import LOGIT_REACH
from openvocab_occ.training.stream_map import BAYES_REACH, EMA_SHARE, StreamMap

SPEC = GridSpec((-8.0, -8.0, -1.0), 0.8, (20, 20, 4))
NAMES = ("road", "wall", "free")


def at(x: float, y: float, yaw: float) -> np.ndarray:
    return pose((x, y, 0.0), (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)))


def writes(rng, count=4):
    for n in range(count):
        T = at(*rng.uniform(-6, 6, 2), rng.uniform(-np.pi, np.pi))
        yield n, T, rng.normal(0, 1.2, (*SPEC.shape, 3)).astype(np.float32), rng.random(SPEC.shape) < 0.6


def new() -> StreamMap:
    return StreamMap(np.array([-8.0, -8.0]), np.array([8.0, 8.0]), SPEC, 3)


def test_agrees_with_the_tile_map(rng, tmp_path):
    city = TileMap.create(tmp_path / "c.tiles", NAMES, heights=4, cell=0.8, z0=-1.0, dtype="float16", journal=False)
    stream = new()
    for n, T, logits, mask in writes(rng):
        city.write(logits, mask, T, SPEC, stamp=1000.0 + n, agent="a", log="l")
        stream.write(T, logits, mask)
    for T in (at(0, 0, 0), at(3.1, -2.2, 0.7), at(-20, 0, 2.0)):
        ours, theirs = stream.read(T), city.read(T, SPEC)
        np.testing.assert_array_equal(ours.known, theirs.known)
        np.testing.assert_allclose(ours.logits, theirs.logits, atol=2e-2)
    assert stream.read(at(0, 0, 0)).known.mean() > 0.3


def test_sure_logits_keep_their_order(rng):
    """However sure a network is, no two of its likely classes become equal; and a tile map of uint8 says the same."""
    stream, T = new(), at(0, 0, 0)
    logits = rng.normal(0, 2, (*SPEC.shape, 3)).astype(np.float32) + np.float32([40, 37, -80])
    everything = np.ones(SPEC.shape, bool)
    stream.write(T, logits, everything)
    found = stream.read(T).logits
    np.testing.assert_array_equal(found.argmax(-1), logits.argmax(-1))
    apart = np.clip(logits[..., 0] - logits[..., 1], -LOGIT_REACH, LOGIT_REACH)
    np.testing.assert_allclose(found[..., 0] - found[..., 1], apart, atol=2e-2)
    assert np.abs(found.mean(-1)).max() < 1e-2
    for _ in range(5):
        stream.write(T, logits, everything, policy="bayes")
    summed = stream.read(T).logits
    np.testing.assert_array_equal(summed.argmax(-1), logits.argmax(-1))
    assert np.ptp(summed, axis=-1).max() <= BAYES_REACH + 0.1


def test_copies_live_apart(rng):
    stream = new()
    before = stream.copy()
    _, T, logits, mask = next(writes(rng))
    stream.write(T, logits, mask)
    assert not before.read(T).known.any()
    assert stream.read(T).known.any()


@pytest.mark.parametrize("policy", ["newest", "overwrite", "ema", "bayes"])
def test_policies_are_their_formulae(policy, rng):
    """At a pose on the lattice every voxel is its own map voxel."""
    stream, T = new(), at(0, 0, 0)
    (_, _, first, seen), (_, _, second, again) = (next(writes(rng)) for _ in range(2))
    a, b = (x - x.mean(-1, keepdims=True) for x in (first, second))
    stream.write(T, first, seen)
    stream.write(T, second, again, policy=policy)
    found = stream.read(T)
    both, only = seen & again, again & ~seen
    mixed = {"newest": b, "overwrite": b, "ema": a + EMA_SHARE * (b - a),
             "bayes": a + b}[policy]  # fmt: skip
    np.testing.assert_allclose(found.logits[both], mixed[both], atol=1e-2)
    np.testing.assert_allclose(found.logits[only], b[only], atol=1e-2)
    np.testing.assert_array_equal(found.known, again if policy == "overwrite" else seen | again)
    if policy != "overwrite":
        np.testing.assert_allclose(found.logits[seen & ~again], a[seen & ~again], atol=1e-2)


@pytest.mark.parametrize(("policy", "shares"), [("newest", (0, 1)), ("ema", (0.5, 0.5)), ("bayes", (1, 1))])
def test_policies_are_corners_of_the_gate(policy, shares, rng):
    """Where both writes saw the voxel; elsewhere what was there stays."""
    gated, plain = new(), new()
    for n, T, logits, mask in writes(rng, 2):
        if not n:
            for stream in (gated, plain):
                stream.write(T, logits, mask)
            continue
        before = plain.copy()
        plain.write(T, logits, mask, policy=policy)
        gated.write(T, logits, mask, policy="gate", gate=lambda a, b, c: np.tile(np.float32(shares), (len(a), 1)))
        both = before.known & (plain.writes == 2)
        assert both.sum() > 200
        np.testing.assert_allclose(gated.values[both], plain.values[both], atol=2e-2)
        np.testing.assert_array_equal(gated.known, plain.known)
        untouched = gated.writes == before.writes
        np.testing.assert_array_equal(gated.values[untouched], before.values[untouched])


def test_gate_is_told_how_often_how_long_ago_and_how_far(rng):
    stream, seen = new(), np.zeros(SPEC.shape, bool)
    seen[3, 4, 1] = seen[10, 10, 2] = True
    told = []

    def gate(fresh, old, facts):
        told.append((old.copy(), facts.copy()))
        return np.tile(np.float32([0.5, 1.0]), (len(fresh), 1))

    logits = rng.normal(size=(*SPEC.shape, 3)).astype(np.float32)
    for day in (0, 1, 3):
        stream.write(at(0, 0, 0), logits, seen, policy="gate", gate=gate, stamp=1e9 + day * 86400)
    far = np.hypot(-8 + 3.5 * 0.8, -8 + 4.5 * 0.8)
    near = np.hypot(-8 + 10.5 * 0.8, -8 + 10.5 * 0.8)
    for (_, facts), count, age in zip(told, (0, 1, 2), (0, 1, 2), strict=True):
        np.testing.assert_allclose(facts, [[count, age, far], [count, age, near]], rtol=1e-5)
    assert (told[0][0] == 0).all()
    fresh = logits[seen] - logits[seen].mean(-1, keepdims=True)
    np.testing.assert_allclose(told[2][0], 1.5 * fresh, atol=1e-2)
    with pytest.raises(ConfigError, match="policy is not known"):
        new().write(at(0, 0, 0), logits, seen, policy="gate")
