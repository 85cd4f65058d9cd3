"""The server as other programs meet it: no browser here."""

import dataclasses
import io
import json
import socket
import threading
import time
import urllib.error
import urllib.request
import zipfile

import numpy as np
import pytest

from openvocab_occ.errors import ConfigError, MapError, NotFoundError
from openvocab_occ.mapping import VoxelMap
from openvocab_occ.objects import ObjectTree
from openvocab_occ.query.find import find
from openvocab_occ.viewer import view
from openvocab_occ.viewer.downloads import FORMATS, converted
from openvocab_occ.viewer.export_panel import file_stem, readable_views
from openvocab_occ.viewer.live import Follower
from openvocab_occ.viewer.markup import (
    answer_line,
    distance_to_path,
    escape,
    escape_markdown,
    facts,
    hit_table,
    preformatted,
    provenance_line,
    swatches,
)  # fmt: skip
from openvocab_occ.viewer.shelf import Shelf
from openvocab_occ.viewer.work import Lane


@pytest.fixture(scope="module")
def viewer(street):
    with view(street, port=0, block=False) as viewer:
        yield viewer


def connect(viewer, origin):
    import viser
    from websockets.sync.client import connect

    address = viewer.url.replace("http", "ws")
    with connect(address, origin=origin, subprotocols=[f"viser-v{viser.__version__}"], proxy=None) as socket:
        return socket.recv(timeout=10)


def status(viewer, **headers):
    request = urllib.request.Request(viewer.url, headers=headers)
    try:
        with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(request, timeout=10) as response:
            return response.status
    except urllib.error.HTTPError as error:
        with error:
            return error.code


def test_listens_on_this_machine_only(viewer):
    assert viewer.url == f"http://127.0.0.1:{viewer.port}"
    sockets = viewer.server._websock_server._host
    assert sockets == "127.0.0.1"


def test_foreign_pages_get_403_and_our_own_is_served(viewer):
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus) as refused:
        connect(viewer, "https://evil.example")
    assert refused.value.response.status_code == 403
    assert connect(viewer, viewer.url)
    assert status(viewer) == 200
    assert status(viewer, Host="evil.example") == 403
    assert status(viewer, Origin="https://evil.example") == 403


def test_nobody_can_ask_for_a_public_tunnel(viewer):
    import viser._messages

    assert viser._messages.ShareUrlRequest not in viewer.server._websock_server._incoming_handlers


def test_a_taken_port_is_told_and_nothing_else_is_opened(street, viewer):
    with pytest.raises(ConfigError, match=f"port {viewer.port} is taken"):
        view(street, port=viewer.port, block=False)


def test_a_foreign_host_is_refused(street):
    with pytest.raises(ConfigError, match="ssh -L 8080"):
        view(street, host="0.0.0.0", block=False)


def test_an_empty_map_and_a_missing_one_are_refused(street, tmp_path):
    tree = ObjectTree([dataclasses.replace(street.objects.root, children=())])
    empty = dataclasses.replace(street, voxels=VoxelMap(0.4, 7, contract="logits"), objects=tree)
    with pytest.raises(MapError, match="no voxels to look at"):
        view(empty, port=0, block=False)
    with pytest.raises(NotFoundError):
        view(tmp_path / "none.ovmap", port=0, block=False)


def test_a_saved_map_is_opened_and_its_port_is_free_again_when_closed(street, tmp_path, capsys):
    viewer = view(street.save(tmp_path / "street.ovmap"), port=0, block=False)
    port = viewer.port
    assert len(viewer.scene.voxels) == len(street.voxels)
    viewer.close()
    viewer.close()
    with socket.socket() as free:
        free.bind(("127.0.0.1", port))
    assert capsys.readouterr().out == ""  # stdout is the caller's


def test_letters_that_could_be_markup_are_written_by_number():
    hostile = "<img src=x onerror=alert(1)>\n# [a](b) |`*_{}~&amp;"
    text = escape_markdown(hostile)
    assert not set(text) & set("<>[]()|`*_{}~\"'\n=!")
    assert text.replace("&#", "").count("&") == 0
    import html

    assert html.unescape(text) == " ".join(hostile.split())
    assert escape_markdown("pick-up Straße 2") == "pick&#45;up Straße 2"


def test_answers_in_one_line(street):
    assert answer_line(find(street, "truck")).startswith("<b>2 objects</b>, ")
    assert "threshold 0.50" in answer_line(find(street, "truck"))
    assert "absent:</b> best 0.8" in answer_line(find(street, "truck", threshold=0.99))
    assert answer_line(find(street, "shiny car")).endswith("not understood: shiny")
    assert answer_line(find(street, "unicorn")).startswith("<b>not understood:</b> unicorn")


def test_the_list_ranks_and_measures(street):
    hits = list(find(street, "car").hits)
    rows = hit_table(street, hits).split("<tr>")[1:]
    assert len(rows) == 2
    for row, hit in zip(rows, hits, strict=True):
        path = [frame.T_world_ego[:3, 3] for frame in street.frames]
        away = min(float(np.linalg.norm(point - hit.object.center)) for point in path)
        assert distance_to_path(street, hit.object) == pytest.approx(away)
        assert f">#{hit.object.id}<" in row
        assert f">{away:.0f}&nbsp;m<" in row
        assert f">{hit.score:.2f}<" in row
    assert "and 17 more" in hit_table(street, hits[:1] * 25)


def test_synthetic_maps_say_so(street):
    assert provenance_line(street).startswith("<b>Synthetic input.</b>")
    made = dataclasses.replace(street.provenance, synthetic=False, name="<b>")
    assert provenance_line(dataclasses.replace(street, provenance=made)).startswith("boxes, &lt;b&gt;, ")


HOSTILE = "<img src=x onerror='alert(1)'>"


def test_no_helper_lets_markup_through(street):
    item = next(item for item in street.objects if item.label == "truck")
    named = dataclasses.replace(item, label=HOSTILE, state=HOSTILE)
    hit = dataclasses.replace(find(street, "truck").hits[0], object=named)
    for text in (
        escape(HOSTILE), preformatted(HOSTILE), facts([(HOSTILE, HOSTILE)]), hit_table(street, [hit]),
        swatches([((1, 2, 3), HOSTILE, HOSTILE)]),
        answer_line(dataclasses.replace(find(street, "car"), unknown=(HOSTILE,))),
    ):  # fmt: skip
        assert "<img" not in text
        assert "&lt;img" in text
        assert "='alert" not in text


def test_a_place_that_nobody_saw_is_told(street):
    answer = dataclasses.replace(find(street, "truck"), hits=(), verdict="unobserved", region_seen=0.04)
    assert answer_line(answer).startswith("<b>not observed there</b>: 4% of that place was seen")


def test_a_token_opens_the_door_to_the_page(street):
    token = "open-sesame-0123456789"
    with view(street, host="127.0.0.1", port=0, token=token, block=False) as viewer:
        assert viewer.invitation == f"{viewer.url}/?token={token}"
        assert status(viewer) == 403
        request = urllib.request.Request(viewer.invitation)
        jar = urllib.request.HTTPCookieProcessor()
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), jar)
        with opener.open(request, timeout=10) as response:
            assert response.status == 200
            assert response.url == viewer.url + "/"  # the token is not left in the address
        with opener.open(viewer.url, timeout=10) as response:
            assert response.status == 200


def test_a_folder_of_maps_is_a_shelf(street, tmp_path):
    for name in ("b", "a"):
        street.save(tmp_path / f"{name}.ovmap")
    shelf = Shelf(tmp_path)
    assert shelf.names == ("a", "b")
    assert shelf.content("a") is shelf.first
    assert len(shelf.content("b").scene.voxels) == len(street.voxels)
    (tmp_path / "none").mkdir()
    with pytest.raises(NotFoundError, match="no map in"):
        Shelf(tmp_path / "none")


def test_a_followed_map_is_shown_anew_when_it_is_written_again(street, tmp_path):
    path = street.save(tmp_path / "street.ovmap")
    with view(path, port=0, block=False) as viewer, Follower(viewer, path, every=0.05):
        first = viewer.scene
        smaller = dataclasses.replace(street, voxels=street.voxels.subset(np.arange(len(street.voxels)) % 2 == 0))
        tree = ObjectTree([dataclasses.replace(street.objects.root, children=())])
        dataclasses.replace(smaller, objects=tree).save(path)
        wait_for(lambda: viewer.scene is not first)
        assert len(viewer.scene.voxels) == len(smaller.voxels)
        assert len(viewer.scene.objects) == 0


def wait_for(met, seconds=30):
    end = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def test_a_map_is_shown_while_it_is_built():
    from openvocab_occ.datasets.registry import load_sequence
    from openvocab_occ.pipeline.build import MapBuilder
    from openvocab_occ.segmentation.demo_models import street_model
    from openvocab_occ.segmentation.onnx import load_encoder
    from openvocab_occ.viewer.live import view_build

    encoder = load_encoder(street_model())
    sequence = load_sequence("street", frames=2)
    seen = []
    viewer = view_build(
        sequence, encoder, MapBuilder(encoder), port=0, every=0.0, started=lambda v: seen.append(len(v.scene.frames))
    )
    with viewer:
        assert seen == [1]
        assert len(viewer.scene.frames) == 2


def test_of_waiting_work_only_the_latest_is_done():
    done, errors, busy = [], [], []
    started, release = threading.Event(), threading.Event()
    lane = Lane(errors.append, busy.append)

    def first(current):
        started.set()
        release.wait(10)
        done.append(("first", current()))

    lane.put(first)
    assert started.wait(10)
    assert not lane.idle()
    for name in ("second", "third", "fourth"):
        lane.put(lambda current, name=name: done.append((name, current())))
    release.set()
    wait_for(lane.idle)
    assert done == [("first", False), ("fourth", True)]
    lane.put(lambda _current: 1 / 0)
    wait_for(lambda: errors and lane.idle())
    assert isinstance(errors[0], ZeroDivisionError)
    lane.put(lambda current: done.append(("after", current())))
    wait_for(lambda: ("after", True) in done)
    wait_for(lane.idle)
    assert busy[-1] is False
    lane.close()
    lane.put(lambda _current: done.append("closed"))
    assert "closed" not in done


@pytest.mark.parametrize("format", FORMATS)
def test_a_selection_leaves_in_every_format(street, format):
    chosen = np.zeros(len(street.voxels), bool)
    truck = next(item for item in street.objects if item.label == "truck")
    chosen[truck.voxels] = True
    name, content = converted(street, chosen, format, "truck")
    assert name.startswith("truck.")
    assert len(content) > 100
    if format == ".ply":
        assert f"element vertex {chosen.sum()}".encode() in content
    if format == ".ovmap":
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            assert {"truck.ovmap/manifest.json", "truck.ovmap/voxels.parquet"} <= set(archive.namelist())


def test_nothing_selected_is_told(street):
    with pytest.raises(ConfigError, match="nothing is selected"):
        converted(street, np.zeros(len(street.voxels), bool), ".ply", "x")


def test_file_names_are_tame():
    assert file_stem("../../etc/passwd") == "etc_passwd"
    assert file_stem("städt <b>") == "st_dt_b"
    assert file_stem("...") == "map"


def test_damaged_saved_views_are_left_out():
    good = {"position": [1, 2, 3], "look_at": [0, 0, 0], "fov": 1, "query": "car", "selected": None, "mode": "rgb",
            "frame": 2}  # fmt: skip
    bad = [dict(good, position=[1, 2]), dict(good, look_at=[0, 0, float("nan")]), dict(good, frame="x"), 7, {}]
    text = json.dumps({"good": good, **{f"bad {i}": one for i, one in enumerate(bad)}})
    assert list(readable_views(text)) == ["good"]
    assert readable_views("{") == {}
    assert readable_views("[1]") == {}
