"""Training and judging: resumable to the bit, no leak of what is not to be read, controls that are controls."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from openvocab_occ.errors import ConfigError, DataError, ModelError
from openvocab_occ.networks.flashocc import TINY
from openvocab_occ.networks.predictor import load_network
from openvocab_occ.training.drives import by_place
from openvocab_occ.training.latents import cache_latents, fingerprint
from openvocab_occ.training.loop import TrainConfig, rate_at, train_baseline
from openvocab_occ.training.memory import RayCounter, evaluate_memory, train_memory
from openvocab_occ.training.streams import MemoryConfig, batches, hidden, make_streams

SHORT = TrainConfig(steps=4, batch=2, warm_up=1, flip=False, save_every=1)
READ = MemoryConfig(prior_from="other_logs", misplaced=0.0)


@pytest.fixture(scope="module")
def latents(baseline, drives, tmp_path_factory):
    return cache_latents(load_network("flashocc-micro", baseline).module, drives, tmp_path_factory.mktemp("latents"))


@pytest.fixture(scope="module")
def trained(baseline, places, latents, tmp_path_factory):
    torch.manual_seed(0)
    network = load_network("flashocc-micro", baseline, memory=True)
    return train_memory(network, places, latents, tmp_path_factory.mktemp("memory"), SHORT)


class Stop(Exception):
    """Pulls the plug."""


def test_a_stopped_run_ends_with_the_same_weights(drives, tmp_path):
    def run(folder, stop=None):
        torch.manual_seed(3)

        def watch(done, total):
            if done == stop:
                raise Stop

        config = TrainConfig(steps=4, batch=2, warm_up=1, save_every=1)
        return train_baseline(load_network("flashocc-micro"), drives, tmp_path / folder, config, progress=watch)

    whole = torch.load(run("whole"), weights_only=True)["state_dict"]
    with pytest.raises(Stop):
        run("parts", stop=2)
    parts = torch.load(run("parts"), weights_only=True)["state_dict"]
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    lines = [json.loads(line) for line in (tmp_path / "parts" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [0, 1, 2, 3]


def test_training_lowers_the_loss(baseline):
    lines = [json.loads(line) for line in (baseline.parent / "log.jsonl").read_text().splitlines()]
    assert np.mean([line["loss"] for line in lines[-3:]]) < 0.8 * lines[0]["loss"]


def test_rates_warm_up_and_fall():
    config = TrainConfig(steps=100, warm_up=10)
    rates = [rate_at(step, config) for step in range(100)]
    assert rates[0] == pytest.approx(config.rate / 10)
    assert np.argmax(rates) in (9, 10)
    assert rates[-1] < 0.05 * config.rate
    assert rate_at(99, replace(config, schedule="constant")) == config.rate


def test_latents_are_the_baselines_and_kept(baseline, drives, latents, tmp_path, monkeypatch):
    network = load_network("flashocc-micro", baseline)
    again = cache_latents(network.module, drives, tmp_path)
    both = [found.of([(drives[0], 1), (drives[1], 0)]) for found in (latents, again)]
    assert torch.equal(*both)
    monkeypatch.setattr(network.module, "latent", None)  # nothing is computed twice
    cache_latents(network.module, drives, tmp_path)
    other = load_network("flashocc-micro")
    assert fingerprint(other.module) != fingerprint(network.module)


def test_only_the_memory_learns(baseline, trained, places, latents, tmp_path):
    base = torch.load(baseline, weights_only=True)["state_dict"]
    after = torch.load(trained, weights_only=True)["state_dict"]
    assert all(torch.equal(value, after[f"baseline.{name}"]) for name, value in base.items())
    changed = {n for n in after if n.startswith("occ_head.") and not torch.equal(after[n], base[n])}
    assert len(changed) == len([n for n in after if n.startswith("occ_head.")])
    torch.manual_seed(0)
    network = load_network("flashocc-micro", baseline, memory=True)
    before = {n: v.clone() for n, v in network.module.state_dict().items()}
    control = torch.load(train_memory(network, places, latents, tmp_path, SHORT, head_only=True), weights_only=True)
    for name, value in control["state_dict"].items():
        assert torch.equal(value, before[name]) != name.startswith("occ_head."), name


def test_sources_read_what_they_may(trained, places, latents):
    network = load_network("flashocc-micro", trained, memory=True)
    covered = {}
    for source in ("none", "own_log", "other_logs", "other_scenes", "all"):
        score = evaluate_memory(network, places, latents, replace(READ, prior_from=source))
        covered[source] = dict.fromkeys((0, 1), 0)
        for (_, visit, _), parts in score.parts.items():
            covered[source][visit] += int(parts["covered"].confusion.sum())
            seen = parts["covered"].confusion + parts["uncovered"].confusion
            np.testing.assert_array_equal(seen, parts["seen"].confusion)
    assert covered["none"] == {0: 0, 1: 0}
    assert covered["other_logs"][0] == 0 < covered["other_logs"][1]
    assert covered["other_scenes"] == covered["other_logs"]  # a scene is a log here
    assert min(covered["own_log"].values()) > 0
    assert covered["all"][0] == covered["own_log"][0]
    assert covered["all"][1] > covered["own_log"][1]


def test_first_frame_reads_nothing(places):
    """Read before write, and nothing from the order of a batch."""
    streams = make_streams(places, load_network("flashocc-micro").config)
    for turn, visits in enumerate(batches(streams, 8)):
        assert len({v.stream.place for v in visits}) == len(visits)
        for visit in visits:
            known = visit.stream.read("all", visit.T_world_ego).known
            assert known.any() == (turn > 0)
            visit.stream.write(visit.T_world_ego, np.zeros((*known.shape, 18), np.float32), ~known, "newest")


def test_blind_predicts_as_with_an_empty_map_in_the_same_regions(trained, places, latents):
    network = load_network("flashocc-micro", trained, memory=True)
    blind = evaluate_memory(network, places, latents, READ, blind=True)
    empty = evaluate_memory(network, places, latents, replace(READ, prior_from="none"))
    for key, parts in blind.parts.items():
        np.testing.assert_array_equal(parts["seen"].confusion, empty.parts[key]["seen"].confusion)
    assert blind.total("covered").confusion.sum() > 0
    summary = blind.summary()
    assert set(summary["by_condition"]) == {"clear", "rain", "night"} & {k[2] for k in blind.parts}


def test_policies_and_removal_run_and_matter(trained, places, latents):
    network = load_network("flashocc-micro", trained, memory=True)
    counts = {}
    for change in ({}, {"policy": "overwrite"}, {"mask_from": "none"}, {"mask_from": "truth"}, {"misplaced": 1.0}):
        score = evaluate_memory(network, places, latents, replace(READ, prior_from="all", **change))
        counts[str(change)] = int(score.total("covered").confusion.sum())
    assert counts["{'mask_from': 'none'}"] > counts["{}"]
    assert counts["{'policy': 'overwrite'}"] <= counts["{}"]
    assert len(set(counts.values())) > 2
    for policy in ("ema", "bayes"):
        evaluate_memory(network, places, latents, replace(READ, policy=policy, dynamic="v2"))


def test_rays_count_every_frame(trained, places, latents):
    network = load_network("flashocc-micro", trained, memory=True)
    counter = RayCounter(network)
    perfect = RayCounter(network)

    def observe(visit, logits):
        counter(visit, logits)
        perfect(visit, np.eye(18, dtype=np.float32)[visit.drive.labels[visit.frame]])

    evaluate_memory(network, {"city-100": places["city-100"][:1]}, latents, READ, observer=observe)
    assert perfect.score.value == 1.0
    assert 0 <= counter.score.value < 1.0


def test_hidden_voxels_are_not_inside_things():
    truth = np.full((5, 5, 5), 17, np.uint8)
    truth[1:4, 1:4, 1:4] = 4
    mask = np.zeros(truth.shape, bool)
    mask[:, :, 4] = True
    found = hidden(truth, mask)
    assert not found[2, 2, 2]
    assert found[1, 2, 2]
    assert not found[:, :, 4].any()


class TestFaults:
    """What is refused, and what is said then."""

    def test_another_run(self, baseline, drives):
        with pytest.raises(ModelError, match="of another run"):
            train_baseline(load_network("flashocc-micro"), drives, baseline.parent, TrainConfig(steps=12, batch=1))

    def test_corrupt_checkpoints(self, drives, tmp_path):
        (tmp_path / "last.pt").write_bytes(b"PK\x03\x04 torn")
        with pytest.raises(ModelError, match="is damaged"):
            train_baseline(load_network("flashocc-micro"), drives, tmp_path, TrainConfig(steps=2))
        with pytest.raises(ModelError, match="is not a checkpoint"):
            load_network("flashocc-micro", tmp_path / "last.pt")

    def test_loss_that_is_no_number(self, drives, tmp_path):
        network = load_network("flashocc-micro")
        with torch.no_grad():
            network.module.occ_head.predicter[-1].bias.fill_(float("nan"))
        with pytest.raises(DataError, match="loss is no number at step 0"):
            train_baseline(network, drives, tmp_path, TrainConfig(steps=2, batch=2))
        assert not (tmp_path / "weights.pt").exists()

    def test_out_of_memory_names_the_remedy(self, drives, tmp_path, monkeypatch):
        def full(*_):
            raise torch.OutOfMemoryError("CUDA out of memory")

        network = load_network("flashocc-micro")
        monkeypatch.setattr(network.module, "forward", full)
        with pytest.raises(ModelError, match="a smaller batch or network"):
            train_baseline(network, drives, tmp_path, TrainConfig(steps=1, batch=2))

    def test_settings(self, drives, places, baseline, latents, tmp_path):
        memory = load_network("flashocc-micro", baseline, memory=True)
        with pytest.raises(ConfigError, match="mirrored with memory"):
            train_memory(memory, places, latents, tmp_path, TrainConfig(flip=True))
        with pytest.raises(ConfigError, match="has no memory"):
            train_memory(load_network("flashocc-micro"), places, latents, tmp_path, SHORT)
        with pytest.raises(ConfigError, match="trained baseline"):
            train_baseline(memory, drives, tmp_path, SHORT)
        with pytest.raises(DataError, match="nothing to train on"):
            train_baseline(load_network("flashocc-micro"), [], tmp_path, SHORT)
        with pytest.raises(ConfigError, match="between 0 and 1"):
            MemoryConfig(dropout=2.0)
        with pytest.raises(ConfigError, match="training cannot be done"):
            TrainConfig(steps=0)
        tiny = load_network("flashocc-tiny", memory=True)
        assert tiny.config == TINY
        with pytest.raises(ConfigError, match="made for another network"):
            train_memory(tiny, by_place(drives), latents, tmp_path, SHORT)
