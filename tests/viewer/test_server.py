"""The server as other programs meet it: no browser here."""

import dataclasses
import socket
import urllib.error
import urllib.request

import numpy as np
import pytest

from openvocab_occ.errors import ConfigError, MapError, NotFoundError
from openvocab_occ.mapping import VoxelMap
from openvocab_occ.objects import ObjectTree
from openvocab_occ.query.find import find
from openvocab_occ.viewer import view
from openvocab_occ.viewer.panels import answer_line, distance_to_path, escape, hit_table, provenance_line


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
    text = escape(hostile)
    assert not set(text) & set("<>[]()|`*_{}~\"'\n=!")
    assert text.replace("&#", "").count("&") == 0
    import html

    assert html.unescape(text) == " ".join(hostile.split())
    assert escape("pick-up Straße 2") == "pick&#45;up Straße 2"


def test_answers_in_one_line(street):
    assert answer_line(find(street, "truck")).startswith("**2 objects**, ")
    assert "threshold 0.50" in answer_line(find(street, "truck"))
    assert "absent:** best 0.8" in answer_line(find(street, "truck", threshold=0.99))
    assert answer_line(find(street, "shiny car")).endswith("not understood: shiny")
    assert answer_line(find(street, "unicorn")).startswith("**not understood:** unicorn")


def test_the_list_ranks_and_measures(street):
    hits = list(find(street, "car").hits)
    rows = hit_table(street, hits).splitlines()[2:]
    assert len(rows) == 2
    for row, hit in zip(rows, hits, strict=True):
        path = [frame.T_world_ego[:3, 3] for frame in street.frames]
        away = min(float(np.linalg.norm(point - hit.object.center)) for point in path)
        assert distance_to_path(street, hit.object) == pytest.approx(away)
        assert f"car&nbsp;#{hit.object.id}" in row
        assert f"| {away:.0f}&nbsp;m |" in row
    assert "and 17 more" in hit_table(street, hits[:1] * 25)


def test_synthetic_maps_say_so(street):
    assert provenance_line(street).startswith("**Synthetic input.**")
    made = dataclasses.replace(street.provenance, synthetic=False, name="<b>")
    assert provenance_line(dataclasses.replace(street, provenance=made)).startswith("boxes, &#60;b&#62;, ")
