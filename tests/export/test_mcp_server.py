"""The tools over a map, asked by the protocol's own client."""

import asyncio
import base64
import json
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from openvocab_occ.cli import main
from openvocab_occ.errors import ConfigError
from openvocab_occ.export.mcp_server import MOST_HITS, MapTools, server

mcp = pytest.importorskip("mcp", reason="the extra [mcp] is not installed")


@pytest.fixture(scope="module")
def saved(street, tmp_path_factory):
    return street.save(tmp_path_factory.mktemp("maps") / "street.ovmap")


@pytest.fixture(scope="module")
def tools(saved, tmp_path_factory):
    return MapTools({"map": saved, "other": saved}, out=tmp_path_factory.mktemp("pictures"))


def ask(served, *calls):
    async def run():
        async with mcp.Client(served) as client:
            listed = await client.list_tools()
            return [tool.name for tool in listed.tools], [await client.call_tool(n, a) for n, a in calls]

    with ThreadPoolExecutor(1) as pool:  # browser tests leave a loop running in this thread
        return pool.submit(lambda: asyncio.run(run())).result()


def test_the_client_lists_and_calls_the_tools(tools):
    names, (ground, thing, brief, same) = ask(
        server(tools), ("ground", {"text": "trucks"}), ("object", {"id": 1}), ("brief", {"length": 40}), ("diff", {})
    )
    assert sorted(names) == ["brief", "diff", "ground", "object", "render"]
    found = json.loads(ground.content[0].text)
    assert (found["verdict"], found["hits_in_all"]) == ("found", 2)
    assert ground.structured_content["hits"] == found["hits"]
    assert json.loads(thing.content[0].text)["id"] == 1
    assert "truck" in json.loads(brief.content[0].text)["text"]
    assert json.loads(same.content[0].text)["objects_appeared"] == []


def test_pictures_come_as_images_and_as_files(tools):
    _, (shown,) = ask(server(tools), ("render", {"view": "front", "query": "trucks", "width": 640, "height": 360}))
    assert not shown.is_error
    assert [part.type for part in shown.content] == ["text", "image", "image", "text"]
    assert "| 1 | truck |" in shown.content[0].text
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(shown.content[1].data), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (360, 640, 3)
    assert shown.content[1].mime_type == "image/png"
    paths = dict(line.split(": ", 1) for line in shown.content[3].text.splitlines()[1:])
    assert Path(paths["view_marked.png"]).read_bytes() == base64.b64decode(shown.content[1].data)


def test_mistakes_are_told_in_words(tools):
    _, answers = ask(
        server(tools), ("object", {"id": 12345}), ("render", {"view": "../../etc"}), ("ground", {"text": "x" * 5000}),
        ("diff", {"a": "map", "b": "elsewhere"}), ("render", {"view": "ahead nan"}), ("brief", {"length": -3.0}),
    )  # fmt: skip
    assert all(answer.is_error for answer in answers)
    words = [answer.content[0].text for answer in answers]
    assert "no object has this id" in words[0]
    assert "view is not known" in words[1]
    assert "1 to 500 letters" in words[2]
    assert "no open map has this name" in words[3]
    assert "view is not known" in words[4]
    assert "length of a route is not usable" in words[5]


def test_what_is_returned_is_bounded(tools, tmp_path):
    bundle, text = tools.render("front", "", 100_000, 1)
    assert max(bundle.view["camera"]["width"], bundle.view["camera"]["height"]) <= 1568
    assert len(text) < 20_000
    assert len(tools.ground("anything", 10**9)["hits"]) <= MOST_HITS
    assert tools.brief(1e12)["length"] <= 1000
    names = {path.name for path in bundle.folder.parent.iterdir()}
    assert all("/" not in name and ".." not in name for name in names)
    with pytest.raises(ConfigError, match="no map to serve"):
        MapTools({})


def test_the_command_describes_its_tools(saved, capsys):
    assert main(["mcp", str(saved), "--json"]) == 0
    tools = {tool["name"]: tool for tool in json.loads(capsys.readouterr().out)["tools"]}
    assert set(tools) == {"brief", "diff", "ground", "object", "render"}
    assert tools["ground"]["arguments"]["required"] == ["text"]


def test_it_serves_on_standard_input_and_output(saved, tmp_path):
    from mcp import StdioServerParameters
    from mcp.client.stdio import stdio_client

    words = ["-m", "openvocab_occ", "mcp", str(saved), "--out", str(tmp_path)]
    parameters = StdioServerParameters(command=sys.executable, args=words, cwd=str(Path.cwd()))
    names, (found,) = ask(stdio_client(parameters), ("ground", {"text": "cars"}))
    assert "render" in names
    assert json.loads(found.content[0].text)["hits_in_all"] == 2
