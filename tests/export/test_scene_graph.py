import json

import numpy as np
import pytest

from openvocab_occ.errors import ConfigError
from openvocab_occ.export.scene_graph import (
    geojson,
    georeference,
    scene_graph,
    write_geojson,
    write_gltf,
    write_scene_graph,
)


def test_the_graph_holds_every_node_and_is_plain_json(street, tmp_path):
    graph = json.loads(write_scene_graph(street, tmp_path / "graph.json").read_text())
    assert graph == json.loads(json.dumps(scene_graph(street)))
    assert [n["id"] for n in graph["nodes"]] == [n.id for n in street.objects.nodes]
    assert graph["synthetic"] is True
    assert all(set(n["children"]) <= {m["id"] for m in graph["nodes"]} for n in graph["nodes"])


def test_geojson_without_a_reference_says_it_is_local(street):
    boxes = geojson(street)
    assert "local" in boxes["crs"]["properties"]["name"]
    ring = np.array(boxes["features"][0]["geometry"]["coordinates"][0])
    np.testing.assert_allclose(ring[:4], street.objects[boxes["features"][0]["id"]].box.corners[:4, :2], atol=1e-3)
    np.testing.assert_array_equal(ring[0], ring[-1])


def test_points_on_the_globe_lie_where_they_should(street, tmp_path):
    """A degree of latitude is 110.574 km at the equator and 111.132 km at 45 degrees; of longitude 111.320 km."""
    there = georeference(0.0, 10.0, 5.0).to_globe(np.array([[111319.49, 0, 1.0], [0, 110574.4, 0]]))
    np.testing.assert_allclose(there, [[11.0, 0, 6.0], [10, 1.0, 5.0]], atol=1e-5)
    np.testing.assert_allclose(georeference(45.0, 0.0).to_globe(np.array([[0, 1111.32, 0.0]]))[0, 1], 45.01, atol=1e-5)
    turned = georeference(45.0, 0.0, heading=np.pi / 2).to_globe(np.array([[1111.32, 0.0, 0.0]]))
    np.testing.assert_allclose(turned[0, :2], [0, 45.01], atol=1e-5)
    written = json.loads(write_geojson(street, tmp_path / "x.geojson", georeference(48.0, 11.0)).read_text())
    assert "crs" not in written
    lon, lat = np.array(written["features"][0]["geometry"]["coordinates"][0]).mean(axis=0)
    assert abs(lon - 11) < 0.01
    assert abs(lat - 48) < 0.01
    with pytest.raises(ConfigError, match="reference is not on the globe"):
        georeference(91.0, 0.0)


def test_gltf_boxes_come_back_where_they_were(street, tmp_path):
    import trimesh

    path = write_gltf(street.objects, tmp_path / "boxes.glb")
    scene = trimesh.load(path)
    assert len(scene.geometry) == len(street.objects)
    item = next(iter(street.objects))
    mesh = scene.geometry[f"{item.id} {item.label}"]
    x, y, z = item.box.center
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), [x, z, -y], atol=1e-4)
    with pytest.raises(ConfigError, match=r"expected NAME.glb, got boxes.gltf"):
        write_gltf(street.objects, tmp_path / "boxes.gltf")
    with pytest.raises(ConfigError, match="there is no object to write"):
        write_gltf([], tmp_path / "none.glb")
