"""The learned gate: the unrolled writes are those of the map, learning helps, faults are told."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from openvocab_occ.errors import ConfigError, DataError, ModelError
from openvocab_occ.networks.predictor import load_network
from openvocab_occ.networks.write_gate import WriteGate, load_write_gate
from openvocab_occ.training.latents import cache_latents
from openvocab_occ.training.memory import evaluate_memory
from openvocab_occ.training.stream_map import StreamMap
from openvocab_occ.training.streams import MemoryConfig
from openvocab_occ.training.write_gate import GateConfig, Written, earlier, record, train_write_gate, unroll

READ = MemoryConfig(prior_from="other_logs", misplaced=0.0)


@pytest.fixture(scope="module")
def network(baseline):
    torch.manual_seed(0)
    return load_network("flashocc-micro", baseline, memory=True)


@pytest.fixture(scope="module")
def latents(network, drives, tmp_path_factory):
    return cache_latents(network.module.baseline, drives, tmp_path_factory.mktemp("latents"))


@pytest.fixture(scope="module")
def recorded(network, places, latents):
    return record(network, places, latents, READ)


def lively_gate(seed: int = 0) -> WriteGate:
    torch.manual_seed(seed)
    gate = WriteGate()
    with torch.no_grad():
        gate.shares[-1].weight.normal_(0, 0.5)
    return gate.eval()


def test_recorded_is_every_frame_in_its_turn(recorded, places):
    for name, seen in recorded.items():
        assert [(w.drive.info.name, w.frame) for w in seen] == [
            (d.info.name, f) for d in places[name] for f in range(len(d))
        ]
        assert earlier(seen, 0) == []
        last = earlier(seen, len(seen) - 1)
        assert last == [i for i, w in enumerate(seen) if w.drive is not seen[-1].drive]
        assert all(np.abs(w.logits.astype(np.float32).mean(-1)).max() < 1e-2 for w in seen)


def test_unrolled_writes_are_the_maps(recorded, network):
    """From one pose, where each voxel of the window is a voxel of the lattice."""
    gate, spec = lively_gate(), network.spec
    T = np.eye(4)
    seen = [
        Written(replace_poses(w.drive, T, 86400.0 * k), w.frame, w.logits, w.mask)
        for k, w in enumerate(recorded["city-100"])
    ]
    held, known = unroll(gate, seen, T, spec)
    stream = StreamMap(np.zeros(2), np.zeros(2), spec, 18)
    for w in seen:
        stamp = float(w.drive.stamps[w.frame])
        logits = w.logits.astype(np.float32)
        stream.write(T, logits, w.mask, policy="gate", gate=gate.choose, stamp=stamp)
    found = stream.read(T)
    np.testing.assert_array_equal(found.known, known)
    np.testing.assert_allclose(held.detach().numpy()[known], found.logits[known], atol=5e-2)
    assert known.sum() > 500


def replace_poses(drive, T, stamp):
    other, frames = copy.copy(drive), len(drive)
    content = {**drive._content, "poses": np.tile(T, (frames, 1, 1)), "stamps": np.full(frames, stamp)}
    other.__dict__["_content"] = content  # in place of what is read from the file
    return other


def test_gradient_reaches_through_all_writes(recorded, network):
    gate = lively_gate()
    seen = recorded["city-101"]
    held, _ = unroll(gate, seen, seen[-1].drive.poses[0], network.spec)
    grads = torch.autograd.grad(held.square().mean(), list(gate.parameters()), retain_graph=True)
    assert all(g.abs().max() > 0 for g in grads)
    first = unroll(gate, seen[:1], seen[-1].drive.poses[0], network.spec)[0]
    assert not torch.equal(first, held)


def test_gate_learns_whom_to_believe(network, recorded, latents, tmp_path):
    """Loud writes are right and faint ones wrong: the map that a learned gate makes is nearer to the truth."""
    rng = np.random.default_rng(0)

    def told(w: Written) -> Written:
        truth = w.drive.labels[w.frame]
        faint = rng.random(truth.shape) < 0.5
        said = np.where(faint, rng.integers(0, 18, truth.shape), truth)
        logits = np.eye(18, dtype=np.float16)[said] * np.where(faint, 1.5, 6.0)[..., None]
        return replace(w, logits=(logits - logits.mean(-1, keepdims=True)).astype(np.float16))

    given = {name: [told(w) for w in seen] for name, seen in recorded.items()}

    def judged(gate: WriteGate) -> float:
        total = []
        for seen in given.values():
            held, known = unroll(gate, seen[:-1], seen[-1].drive.poses[seen[-1].frame], network.spec)
            truth = torch.from_numpy(seen[-1].drive.labels[seen[-1].frame].astype(np.int64))
            total.append(torch.nn.functional.cross_entropy(held[known], truth[known]).item())
        return float(np.mean(total))

    config = GateConfig(steps=25, frames=1, writes=3, rate=3e-2, map_weight=10.0)
    learned = load_write_gate(train_write_gate(network, given, latents, tmp_path, config))
    assert judged(learned) < 0.9 * judged(WriteGate())


def test_gate_is_evaluated(network, recorded, places, latents, tmp_path):
    config = GateConfig(steps=2, frames=1, writes=2, rate=2e-2)
    gate = load_write_gate(train_write_gate(network, recorded, latents, tmp_path, config))
    rows = torch.randn(5, 18), torch.randn(5, 18), torch.rand(5, 3)
    shares = gate(*rows)
    assert ((shares > 0) & (shares < 1)).all()
    np.testing.assert_allclose(gate.choose(*(r.numpy() for r in rows)), shares.detach().numpy(), atol=1e-6)
    score = evaluate_memory(network, places, latents, replace(READ, policy="gate"), gate=gate.choose)
    plain = evaluate_memory(network, places, latents, READ)
    for region in ("seen", "covered", "map"):  # what is known does not depend on the gate's first writes
        if region == "seen":
            assert score.total(region).confusion.sum() == plain.total(region).confusion.sum()
        assert score.total(region).confusion.sum() > 0
    assert (score.total("map").confusion != plain.total("map").confusion).any()


def test_a_stopped_training_ends_with_the_same_gate(network, recorded, latents, tmp_path, monkeypatch):
    config = GateConfig(steps=4, frames=1, writes=2)
    whole = train_write_gate(network, recorded, latents, tmp_path / "a", config)

    class Stop(Exception):
        pass

    def watch(done, _):
        if done == 3:
            raise Stop

    with pytest.raises(Stop):
        train_write_gate(network, recorded, latents, tmp_path / "b", config, progress=watch)
    parts = train_write_gate(network, recorded, latents, tmp_path / "b", config)
    first, second = (torch.load(p, weights_only=True)["state_dict"] for p in (whole, parts))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_refusals(network, recorded, latents, baseline, tmp_path):
    with pytest.raises(ConfigError, match="has no memory"):
        train_write_gate(load_network("flashocc-micro"), recorded, latents, tmp_path)
    alone = {name: seen[:2] for name, seen in recorded.items()}
    with pytest.raises(DataError, match="visited twice"):
        train_write_gate(network, alone, latents, tmp_path)
    with pytest.raises(ConfigError, match="cannot be trained"):
        GateConfig(steps=0)
    with pytest.raises(ModelError, match="is no write gate"):
        load_write_gate(baseline)
