"""The same map in a bucket, on an emulator of S3."""

import sys
from types import ModuleType

import numpy as np
import pytest

from openvocab_occ.memory import TileMap
from openvocab_occ.memory.health import verify
from tests.memory.conftest import NAMES, SPEC, contents, random_logits, random_pose, write


@pytest.fixture
def bucket(monkeypatch):
    try:
        import flask_cors  # noqa: F401
    except ImportError:  # headers for browsers, which moto's server imports and no S3 client looks at
        stand_in = ModuleType("flask_cors")
        stand_in.CORS = lambda *_, **__: None  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "flask_cors", stand_in)
    server = pytest.importorskip("moto.server")
    boto3 = pytest.importorskip("boto3")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    running = server.ThreadedMotoServer(port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    url = f"http://{host}:{port}"
    boto3.client("s3", endpoint_url=url, region_name="us-east-1").create_bucket(Bucket="city")
    yield {"driver": "s3", "bucket": "city", "path": "maps/one", "endpoint": url, "aws_region": "us-east-1"}
    running.stop()


@pytest.mark.filterwarnings("ignore")
def test_a_bucket_holds_the_same_map(bucket, tmp_path):
    maps = []
    for place in (bucket, tmp_path / "m"):
        rng = np.random.default_rng(0)
        city = TileMap.create(place, NAMES, heights=8)
        for n in range(3):
            write(city, random_logits(rng), rng.random(SPEC.shape) < 0.5, random_pose(rng, reach=4), stamp=float(n))
        maps.append(city)
    remote, local = maps
    assert contents(remote) == contents(local)
    T = random_pose(np.random.default_rng(1), reach=2)
    again = TileMap.open(bucket)
    assert (again.read(T, SPEC).logits == local.read(T, SPEC).logits).all()
    assert verify(again).sound
    again.consolidate("one")
    again.rebuild()
    assert contents(again) == contents(local)
