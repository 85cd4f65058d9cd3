"""One task a log, one a tile: here, on Ray and log by log, the same city."""

from functools import partial
from pathlib import Path

import pytest

from openvocab_occ.datasets.registry import load_sequence
from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.memory import TileMap, journal
from openvocab_occ.memory.health import verify
from openvocab_occ.memory.layer import TileKey
from openvocab_occ.memory.observe import observe
from openvocab_occ.pipeline.scale import LocalEngine, LogJob, RayEngine, build_city, reduce_tile
from openvocab_occ.segmentation.demo_models import street_model

JOBS = [
    LogJob(name=f"log-{n}", agent=f"car-{n}", drive=partial(load_sequence, "street", seed=n, frames=1), start=10.0 * n)
    for n in range(2)
]


def records(city: TileMap) -> dict[object, bytes]:
    return {key: tile.record.tobytes() for key, tile in city.tiles() if tile.stamps.any()}


@pytest.fixture(scope="module")
def serial(tmp_path_factory) -> TileMap:
    """The same frames, written one after the other into one map."""
    path = tmp_path_factory.mktemp("serial") / "city.tiles"
    city: TileMap | None = None
    for job in JOBS:
        for frame in job.drive():
            seen, spec = observe(frame), frame.occupancy.spec
            if city is None:
                names = frame.occupancy.class_names
                city = TileMap.create(path, names, heights=spec.shape[2], cell=spec.size[2], z0=spec.origin[2])
            city.write(seen.logits, seen.mask, seen.T_world_grid, spec,
                       stamp=seen.time + job.start, agent=job.agent, log=job.name)  # fmt: skip
    assert city is not None
    return city


def test_local_tasks_make_the_serial_map_and_may_be_repeated(tmp_path, serial):
    calls = []
    for _ in range(2):
        built = build_city(JOBS, str(tmp_path / "city.tiles"), scratch=str(tmp_path / "logs"),
                           progress=lambda done, total: calls.append((done, total)))  # fmt: skip
    city = TileMap.open(tmp_path / "city.tiles")
    assert records(city) == records(serial)
    assert built.changed == 0, "the second time changes nothing"
    assert calls[-1] == (len(JOBS) + built.tiles,) * 2
    assert city.logs() == {"log-0": True, "log-1": True}
    assert city.agents() == {"car-0": None, "car-1": None}
    assert journal.names(city.store) == journal.names(serial.store)
    assert verify(city).sound
    city.rebuild()
    assert records(city) == records(serial)


@pytest.fixture(scope="module")
def ray_engine(tmp_path_factory):
    ray = pytest.importorskip("ray", reason="the extra scale is not installed")
    root = str(Path(__file__).resolve().parents[2])
    ray.init(
        num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=80 * 2**20,
        _system_config={"worker_niceness": 0},
        runtime_env={"env_vars": {"PYTHONPATH": root}},
    )  # fmt: skip
    yield RayEngine()
    ray.shutdown()


@pytest.mark.slow
@pytest.mark.timeout(900)  # workers start slowly on a busy machine
@pytest.mark.filterwarnings("ignore")
def test_ray_makes_the_same_city(tmp_path, serial, ray_engine):
    """Real Ray on this machine: logs and tiles in its workers; what a task raises arrives as it is."""
    jobs = [JOBS[0], LogJob(**{**vars_of(JOBS[1]), "encoder": str(street_model())})]
    built = build_city(jobs, str(tmp_path / "city.tiles"), scratch=str(tmp_path / "logs"), engine=ray_engine)
    assert records(TileMap.open(tmp_path / "city.tiles")) == records(serial)
    assert [log.frames for log in built.logs] == [1, 1]
    assert built.logs[1].scene is not None
    assert Path(built.logs[1].scene, "manifest.json").is_file()
    assert [*ray_engine.run(divmod, [(7, 2), (9, 4)])] == [(3, 1), (2, 1)]
    empty = LogJob(name="x", agent="a", drive=list)
    with pytest.raises(DataError, match="log 'x' has no frames"):
        build_city([empty], str(tmp_path / "none.tiles"), scratch=str(tmp_path / "logs"), engine=ray_engine)
    assert not (tmp_path / "none.tiles").exists()


def vars_of(job: LogJob) -> dict[str, object]:
    return {name: getattr(job, name) for name in ("name", "agent", "drive", "start")}


def test_refused(tmp_path):
    with pytest.raises(ConfigError, match="logs cannot be told apart"):
        build_city([JOBS[0], JOBS[0]], str(tmp_path / "c"), scratch=str(tmp_path))
    assert not [*tmp_path.iterdir()]
    assert [*LocalEngine().run(divmod, [])] == []
    city = TileMap.create(tmp_path / "c", ("a", "free"))
    assert reduce_tile(city.store.name, (), TileKey(0, 0, 0)) == 0
