"""The frame loop with the global map, submission files, ONNX, commands, experiments."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from openvocab_occ.cli import main
from openvocab_occ.datasets.predictions import join_occupancy
from openvocab_occ.errors import ConfigError, DataError, GridError, ModelError, ShapeError
from openvocab_occ.evaluation.fusion_bench import bench
from openvocab_occ.memory import TileMap
from openvocab_occ.networks.flashocc import MICRO
from openvocab_occ.networks.onnx_network import LogitMemory, OnnxNetwork, export_onnx
from openvocab_occ.networks.predictor import load_network
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_FREE
from openvocab_occ.training.latents import cache_latents
from openvocab_occ.training.loop import TrainConfig
from openvocab_occ.training.memory import train_memory
from openvocab_occ.training.predict import (
    MapUse,
    check_map,
    occ3d_labels,
    occupancy_of,
    open_map,
    predictions,
    write_predictions,
)
from openvocab_occ.training.statistics import Outcome, chosen, gain, outcome_of

from .conftest import PLAN, drive_frames


@pytest.fixture(scope="module")
def memory(baseline, drives, places, tmp_path_factory):
    """Weights of a memory that has learned a little."""
    torch.manual_seed(0)
    network = load_network("flashocc-micro", baseline, memory=True)
    folder = tmp_path_factory.mktemp("memory")
    latents = cache_latents(network.module.baseline, drives, folder / "latents")
    return train_memory(network, places, latents, folder, TrainConfig(steps=4, batch=2, warm_up=1, flip=False))


def test_submission_files_are_read_back(baseline, tmp_path):
    network, frames = load_network("flashocc-micro", baseline), drive_frames(1)
    files = write_predictions(network, frames, tmp_path)
    assert [f.name for f in files] == ["t1-0-0.npz", "t1-0-1.npz"]
    back = join_occupancy(frames, str(tmp_path / "{token}.npz"))
    for given, frame in zip(frames, back, strict=True):
        expected = occ3d_labels(network.predict(given), network)
        np.testing.assert_array_equal(frame.occupancy.labels, expected)
        assert expected[:50].min() == OCC3D_FREE  # beyond the network's reach
        assert (expected[50:150:2, 50:150:2, ::2] == network.predict(given).argmax(-1)).all()


def test_grids_given_to_a_map_are_those_of_the_files(memory, tmp_path, capsys):
    network, frames = load_network("flashocc-micro", memory, memory=True), drive_frames(1)
    city = open_map(tmp_path / "c.tiles", network)
    write_predictions(network, drive_frames(1, day=1), tmp_path / "other", city, MapUse(log="b"))
    write_predictions(network, frames, tmp_path / "mine", city, MapUse(log="a", write=False))
    give = occupancy_of(network, city)
    for frame in join_occupancy(frames, str(tmp_path / "mine" / "{token}.npz")):
        grid = give(frame)
        np.testing.assert_array_equal(grid.labels, frame.occupancy.labels)
        np.testing.assert_array_equal(grid.T_world_grid, frame.occupancy.T_world_grid)
    assert set(city.logs()) == {"b"}
    assert main(["eval", "grounding", "--seeds", "1", "--occupancy", "network"]) == 2
    assert "--weights" in capsys.readouterr().err


def test_second_drive_remembers_the_first(memory, tmp_path):
    network = load_network("flashocc-micro", memory, memory=True)
    city = open_map(tmp_path / "c.tiles", network)
    alone = {f.token: x for f, x in predictions(network, drive_frames(1, day=1))}
    first = list(predictions(network, drive_frames(1), city, MapUse(log="a")))
    np.testing.assert_array_equal(first[0][1], network.predict(first[0][0]))  # the map was empty
    np.testing.assert_array_equal(first[1][1], network.predict(first[1][0]))  # and its own log is not read
    second = list(predictions(network, drive_frames(1, day=1), city, MapUse(log="b", write=False)))
    for frame, logits in second:
        prior = city.read(frame.T_world_ego, network.spec)
        assert prior.known.any()
        np.testing.assert_array_equal(logits, network.predict(frame, prior))
        assert np.abs(logits - alone[frame.token]).max() > 0
    assert set(city.logs()) == {"a"}
    again = open_map(tmp_path / "c.tiles", network)
    mine = list(predictions(network, drive_frames(1), again, MapUse(log="a", prior_from="all", write=False)))
    assert np.abs(mine[0][1] - first[0][1]).max() > 0


def test_removed_things_are_not_written(memory, tmp_path):
    network = load_network("flashocc-micro", memory, memory=True)
    with torch.no_grad():
        network.module.occ_head.predicter[-1].bias[4::18] += 50.0  # everything is a car
    for version in ("v1", "retained"):
        city = open_map(tmp_path / f"{version}.tiles", network)
        list(predictions(network, drive_frames(1, frames=1), city, MapUse(log="a", dynamic=version)))
        prior = city.read(np.eye(4), network.spec)
        assert prior.known.any()
        assert (np.abs(prior.logits[prior.known]).max() < 0.1) == (version == "v1")


def test_foreign_priors_are_refused(memory, tmp_path):
    network = load_network("flashocc-micro", memory, memory=True)
    other = TileMap.create(tmp_path / "a.tiles", ("road", "free"), heights=8, cell=0.8)
    with pytest.raises(ConfigError, match="other classes"):
        check_map(other, network)
    TileMap.create(tmp_path / "b.tiles", OCC3D_CLASSES)
    with pytest.raises(ConfigError, match="voxels of another size"):
        open_map(tmp_path / "b.tiles", network)
    with pytest.raises(ConfigError, match="name of the drive"):
        next(predictions(network, drive_frames(1), open_map(tmp_path / "c.tiles", network)))


def test_missing_cameras_are_told(baseline):
    network = load_network("flashocc-micro", baseline)
    assert network.cameras == 2
    with pytest.raises(DataError, match="lacks cameras"):
        next(predictions(network, drive_frames(1, cameras=1), cameras=network.cameras))


@pytest.mark.parametrize(
    "error", [torch.OutOfMemoryError("CUDA out of memory"), MemoryError(),
              RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried")]
)  # fmt: skip
def test_out_of_memory_names_the_remedy(baseline, monkeypatch, error):
    def full(*_):
        raise error

    network = load_network("flashocc-micro", baseline)
    monkeypatch.setattr(network.module, "forward", full)
    with pytest.raises(ModelError, match=r"does not fit into the memory of cpu.*smaller network"):
        network.predict(drive_frames(1)[0])


def test_other_failures_are_not_taken_for_it(baseline, monkeypatch):
    def broken(*_):
        raise RuntimeError("shapes differ")

    network = load_network("flashocc-micro", baseline)
    monkeypatch.setattr(network.module, "forward", broken)
    with pytest.raises(RuntimeError, match="shapes differ"):
        network.predict(drive_frames(1)[0])


def test_images_of_any_size_are_taken_and_too_small_ones_told(baseline):
    network = load_network("flashocc-micro", baseline)
    frame = drive_frames(1)[0]
    twice = [
        replace(
            v, image=v.image.repeat(2, 0).repeat(2, 1), camera=v.camera.resized(2 * v.camera.width, 2 * v.camera.height)
        )
        for v in frame.views
    ]
    large = network.predict(replace(frame, views=tuple(twice)))
    assert (large.argmax(-1) == network.predict(frame).argmax(-1)).mean() > 0.98
    small = [
        replace(v, image=np.ascontiguousarray(v.image[::16, ::16]), camera=v.camera.resized(8, 3)) for v in frame.views
    ]
    with pytest.raises(DataError, match="too small for the network"):
        next(predictions(network, drive_frames(1).map(lambda f: replace(f, views=tuple(small)))))


def test_weights_that_are_no_numbers_are_told(baseline):
    network = load_network("flashocc-micro", baseline)
    with torch.no_grad():
        network.module.occ_head.predicter[-1].bias[0] = float("nan")
    with pytest.raises(ModelError, match="gives no numbers"):
        network.predict(drive_frames(1)[0])


@pytest.mark.filterwarnings("ignore")  # torch.onnx warns of torchvision's absence, and of its own deprecations
class TestOnnx:
    """Files that any runtime runs."""

    @pytest.fixture(scope="class")
    def pair(self, memory, tmp_path_factory):
        network = load_network("flashocc-micro", memory, memory=True)
        return network, OnnxNetwork(export_onnx(network, tmp_path_factory.mktemp("onnx") / "m.onnx", cameras=2))

    def test_gives_what_torch_gives(self, pair):
        network, exported = pair
        frame = drive_frames(1)[0]
        rng = np.random.default_rng(0)
        known = rng.random(network.spec.shape) < 0.5
        logits = rng.normal(0, 3, (*network.spec.shape, 18)).astype(np.float32) * known[..., None]
        prior = type("P", (), {"logits": logits, "known": known})()
        for given in (None, prior):
            np.testing.assert_allclose(exported.predict(frame, given), network.predict(frame, given), atol=2e-4)
        assert np.abs(exported.predict(frame, prior) - exported.predict(frame)).max() > 1e-2
        assert exported.spec == network.spec

    @pytest.mark.parametrize("with_memory", [False, True])
    def test_dhd_too(self, with_memory, tmp_path):
        """Its deformable convolution and its slabs have standard operators; close calls of heights may differ."""
        torch.manual_seed(1)
        network = load_network("dhd-tiny", memory=with_memory)
        baseline = network.module.baseline if with_memory else network.module
        torch.nn.init.normal_(baseline._height_net[0].depth_conv[-1].weight, std=0.5)  # heights that differ by pixel
        exported = OnnxNetwork(export_onnx(network, tmp_path / "d.onnx", cameras=2))
        frame = drive_frames(1)[0]
        rng = np.random.default_rng(0)
        known = rng.random(network.spec.shape) < 0.5
        logits = rng.normal(0, 3, (*network.spec.shape, 18)).astype(np.float32) * known[..., None]
        prior = type("P", (), {"logits": logits, "known": known})() if with_memory else None
        ours, theirs = network.predict(frame, prior), exported.predict(frame, prior)
        assert (np.abs(ours - theirs) < 1e-3).mean() > 0.999
        assert ours.std() > 1e-3

    def test_runs_with_the_map_as_ours_do(self, pair, tmp_path):
        network, exported = pair
        city = open_map(tmp_path / "c.tiles", network)
        found = list(predictions(exported, drive_frames(1), city, MapUse(log="a", prior_from="all")))
        prior = city.read(found[1][0].T_world_ego, network.spec)
        assert prior.known.any()
        assert found[1][1].shape == network.predict(found[1][0]).shape

    def test_refuses(self, pair, tmp_path):
        _, exported = pair
        (tmp_path / "torn.onnx").write_bytes(exported.path.read_bytes()[:1000])
        with pytest.raises(ModelError, match="is not an ONNX model"):
            OnnxNetwork(tmp_path / "torn.onnx")
        with pytest.raises(DataError, match="as many views"):
            exported.predict(drive_frames(1, cameras=1)[0])
        network = load_network("flashocc-micro")
        torch.nn.init.constant_(network.module.occ_head.predicter[-1].bias, float("nan"))
        with pytest.raises(ModelError, match="gives no numbers"):
            OnnxNetwork(export_onnx(network, tmp_path / "n.onnx", cameras=2)).predict(drive_frames(1)[0])
        wrong = type("P", (), {"logits": np.zeros((2, 2, 2, 18), np.float32), "known": np.zeros((2, 2, 2), bool)})()
        with pytest.raises(ShapeError, match="prior does not fit"):
            exported.predict(drive_frames(1)[0], wrong)


def test_logits_of_a_foreign_model_get_a_memory():
    """Unchanged where nothing is known, and able to learn from a prior."""
    config = replace(MICRO, shape=(10, 10, 4))
    module = LogitMemory(config, width=16)
    truth = torch.randint(0, 18, (1, 10, 10, 4))
    prior = 6.0 * torch.nn.functional.one_hot(truth, 18).float()
    foreign = torch.randn(1, 10, 10, 4, 18)
    known = torch.ones(1, 10, 10, 4, dtype=torch.bool)
    optimiser = torch.optim.Adam(module.parameters(), lr=3e-3)
    losses = []
    for _ in range(60):
        loss = torch.nn.functional.cross_entropy(module(foreign, prior, known).flatten(0, 3), truth.flatten())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.7 * losses[0]
    assert torch.equal(module(foreign, prior * 0, known & False), foreign)
    with pytest.raises(ShapeError, match="prior does not fit the logits"):
        module(foreign, prior[:, :5], known[:, :5])


def test_commands_train_judge_and_predict(drives, tmp_path, capsys):
    """On the files of the made-up street in the place of the city's."""
    folder = drives[0].path.parent
    plan = ["city", "any", "--drives", str(folder), "--cities", "100", "101", "--visits", "2", "--frames", "2"]
    renamed = [d.path.rename(folder / d.path.name.replace("2x4", "2x3")) for d in drives]
    try:
        base, out = tmp_path / "base", tmp_path / "memory"
        net = ["--network", "flashocc-micro", "--json"]
        assert main(["occ", "train", *plan, *net, "--out", str(base), "--steps", "3", "--batch", "2"]) == 0
        assert json.loads(capsys.readouterr().out)["places"] == 2
        more = ["--base", str(base / "weights.pt"), "--out", str(out), "--steps", "2", "--batch", "2"]
        assert main(["occ", "train", *plan, *net, *more]) == 0
        capsys.readouterr()
        assert main(["occ", "eval", *plan, *net, "--weights", str(out / "weights.pt"), "--rays"]) == 0
        report = json.loads(capsys.readouterr().out)
        assert report["frames"] == 8
        assert {"seen", "with_prior", "without_prior", "by_condition", "RayIoU"} <= report.keys()
        assert main(["occ", "eval", *plan, *net[:2], "--weights", str(base / "weights.pt")]) == 0
        assert "seen by a camera" in capsys.readouterr().out
        assert main(["occ", "eval", *plan, *net, "--weights", str(folder / "none.pt")]) == 2
    finally:
        for path in renamed:
            path.rename(folder / path.name.replace("2x3", "2x4"))


def test_experiments_end_in_tables(drives, tmp_path, monkeypatch):
    """The smoke scale from end to end, and again: nothing is done twice."""
    from pathlib import Path

    monkeypatch.syspath_prepend(Path(__file__).parents[2])
    from benchmarks.lmpocc import experiments, report, scales

    (tmp_path / "drives").symlink_to(drives[0].path.parent)
    scale = replace(scales.SMOKE, tables=("II", "gate"), gate=PLAN)
    assert list(scale.train.drives()) == list(PLAN.drives())
    scale = replace(scale, test=PLAN)
    said: list[str] = []
    experiments.run(scale, tmp_path, tell=said.append)
    page = tmp_path / "page.md"
    page.write_text(f"before\n{report.BEGIN}\nold\n{report.END}\nafter\n")
    found = report.report(scale, tmp_path, command="c", where="w", docs=page)
    numbers = found["flashocc-micro"]
    assert set(numbers["ways"]) == {"base", "head", "empty", "other_logs", "all", "elsewhere", "write-gate"}
    assert set(numbers["map_gains"]) == {"write-gate"}
    assert len(numbers["bars"]) == 4
    text = page.read_text()
    assert text.startswith("before")
    assert text.endswith("after\n")
    assert "old" not in text
    assert "frozen baseline" in text
    assert (tmp_path / "flashocc-micro.png").stat().st_size > 5000
    said.clear()
    monkeypatch.setattr(experiments, "train_memory", None)
    monkeypatch.setattr(experiments, "evaluate_memory", None)
    experiments.run(scale, tmp_path, tell=said.append)
    assert not [line for line in said if "steps" in line]


class TestStatistics:
    """Intervals hold what they say."""

    def outcome(self, right: float, seeds=3, cities=5) -> Outcome:
        """Two classes and free; a share of each is right, with a little luck of seed and city."""
        rng = np.random.default_rng(round(right * 1000))
        found = np.zeros((seeds, cities, 18, 18), np.int64)
        for s, c in np.ndindex(seeds, cities):
            for label in (4, 11):
                hit = round(1000 * (right + 0.02 * rng.normal()))
                found[s, c, label, label], found[s, c, label, 17] = hit, 1000 - hit
            found[s, c, 17, 17] = 5000
        return Outcome(found, tuple("abcde"[:cities]))

    def test_gain_is_the_difference_with_its_sign(self):
        better, worse = self.outcome(0.7), self.outcome(0.5)
        found = gain(better, worse, "static", draws=200)
        assert found.low < found.mean < found.high
        assert found.mean == pytest.approx(20, abs=3)
        assert found.low > 10
        assert gain(worse, better, "all", draws=50).mean < 0
        same = gain(better, better, draws=50)
        assert (same.low, same.mean, same.high) == (0, 0, 0)

    def test_one_seed_serves_for_all(self):
        base = self.outcome(0.5, seeds=1)
        assert gain(self.outcome(0.6), base, draws=50).mean > 5

    def test_rare_classes_are_left_out(self):
        outcome = self.outcome(0.5)
        outcome.confusion[0, 0, 2, 2] = 100
        assert chosen("dynamic", outcome) == [4]
        assert np.isnan(gain(outcome, outcome_of([[]], "seen"), draws=5).mean)

    def test_rows_are_added_by_city_visit_and_condition(self):
        row = np.zeros((18, 18), int)
        row[4, 4] = 7
        rows = [{"place": p, "visit": v, "condition": "rain" if v else "clear", "seen": row.ravel().tolist()}
                for p in "ab" for v in (0, 1, 2)]  # fmt: skip
        assert outcome_of([rows, rows], visits={1, 2}).confusion[:, :, 4, 4].tolist() == [[14, 14], [14, 14]]
        assert outcome_of([rows], conditions={"clear"}).confusion[0, 0, 4, 4] == 7


def test_fusion_bench_reports_its_parts():
    report = bench(channels=16, cells=20, repeats=1)
    assert report["cpfusion"]["parameters"] == 5 * 9 * 16 * 16 + 3 * 16
    assert report["ratio"] > 0
    full = 2 * 200 * 200 * 9 * 5 * 256**2 / 1e9
    assert full == pytest.approx(235.9, abs=0.1)


def test_grids_that_are_not_occ3ds_are_not_submitted(baseline):
    network = load_network("flashocc-micro", baseline)
    network.config = replace(MICRO, cell=0.5)
    with pytest.raises(GridError, match="not Occ3D's"):
        occ3d_labels(np.zeros((*MICRO.shape, 18), np.float32), network)


def test_predicted_occupancy_becomes_a_map_that_answers(baseline, tmp_path):
    """predict, depth, map, find: the whole way on files of a network (whose road is put into its bias)."""
    from openvocab_occ.pipeline.build import build_map
    from openvocab_occ.query.find import find
    from openvocab_occ.segmentation.demo_models import street_model
    from openvocab_occ.segmentation.onnx import load_encoder

    network = load_network("flashocc-micro", baseline)
    with torch.no_grad():
        network.module.occ_head.predicter[-1].bias[18 * 1 + 11] += 30.0
    city = open_map(tmp_path / "c.tiles", network)
    frames = drive_frames(1)
    write_predictions(network, frames, tmp_path / "pred", city, MapUse(log="a"))
    encoder = load_encoder(street_model())
    scene = build_map(join_occupancy(frames, str(tmp_path / "pred" / "{token}.npz")), encoder)
    assert len(scene.voxels) > 100
    assert find(scene, "road", encoder).verdict in ("found", "absent")
    assert scene.voxels.centers[:, 2].min() > -0.6
    assert city.read(frames[0].T_world_ego, network.spec).known.any()
