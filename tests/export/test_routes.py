"""Ways ahead, what comes along them, viewpoints on them, and questions about views."""

import dataclasses
import json

import numpy as np
import pytest

from openvocab_occ.errors import ConfigError
from openvocab_occ.export import ViewOptions, export_views
from openvocab_occ.export.brief import brief_route
from openvocab_occ.export.questions import questions_about
from openvocab_occ.export.render import render_map
from openvocab_occ.export.route import Route, route_ahead
from openvocab_occ.export.views import choose, lookout
from openvocab_occ.objects import ObjectTree


@pytest.fixture(scope="module")
def watched(street):
    """The street with states that were observed: the truck on the left is parked, a car moves."""
    states = {"truck": "parked", "car": "moving", "person": "unknown"}
    nodes = [dataclasses.replace(n, state=states.get(n.label, n.state)) for n in street.objects.nodes]
    return dataclasses.replace(street, objects=ObjectTree(nodes))


def test_stations_and_sides_along_a_bend():
    route = Route(np.array([[0.0, 0], [10, 0], [10, 10]]))
    assert route.length == 20.0
    station, left = route.locate(np.array([[5.0, 2], [5, -2], [12, 5], [8, 5], [-3, 1], [10, 14]]))
    np.testing.assert_allclose(station, [5, 5, 15, 15, -3, 24])
    np.testing.assert_allclose(left, [2, -2, -2, 2, 1, 0])
    np.testing.assert_allclose(route.at(15.0), [10, 5])
    assert route.heading(15.0) == pytest.approx(np.pi / 2)
    assert [s for s, _ in route.stands(8.0)] == [0.0, 8.0]


@pytest.mark.parametrize("points", [np.zeros((1, 2)), np.zeros((3, 2))])
def test_a_route_leads_somewhere(points):
    with pytest.raises(ConfigError, match="a route leads nowhere: expected at least 2 different points"):
        Route(points)


def test_the_way_ahead_is_driven_and_then_read_from_the_road(street):
    route = route_ahead(street, length=45.0)
    assert route.driven == pytest.approx(16.0)  # frames at -28, -20, -12
    assert 35 < route.length <= 45.0
    np.testing.assert_allclose(route.points[0], [-28, -2])
    assert np.abs(route.points[:, 1]).max() < 5.5  # the road is 12 m wide around y = 0
    assert (np.diff(route.points[:, 0]) > 0).all()
    short = route_ahead(street, length=10.0)
    assert short.length == pytest.approx(10.0)
    assert short.driven == pytest.approx(10.0)
    later = route_ahead(street, frame=1, length=30.0)
    np.testing.assert_allclose(later.points[0], [-20, -2])
    end = route_ahead(street, frame=2, length=300.0)
    assert end.points[-1, 0] < 31  # where the road ends


def test_a_way_needs_frames_and_a_length(street):
    with pytest.raises(ConfigError, match=r"no keyframe has this index: expected one of \[0, 1, 2\], got 9"):
        route_ahead(street, frame=9)
    with pytest.raises(ConfigError, match="length of a route is not usable"):
        route_ahead(street, length=-1.0)
    with pytest.raises(ConfigError, match="keeps no frames"):
        route_ahead(dataclasses.replace(street, frames=()))


def test_a_brief_tells_objects_by_station_and_side(watched):
    brief = brief_route(watched, length=55.0)
    found = {(o.label, o.side): o for o in brief.objects}
    car = found["car", "left"]  # at x = -8, y = 4: 20 m ahead of -28, 6 m to the left of the way at y = -2
    assert car.station == pytest.approx(20.0 - 2.2, abs=0.7)
    assert car.left == pytest.approx(5.0, abs=0.7)
    assert car.narrows is None  # it moves
    truck = next(o for o in brief.objects if o.label == "truck")
    assert truck.side == "left"
    assert truck.on_road
    width, left = truck.narrows  # the road reaches from y = -6 to 6; the truck from 2.8 to 5.2
    assert width == pytest.approx(12.0, abs=0.9)
    assert left == pytest.approx(8.8, abs=0.9)
    person = next(o for o in brief.objects if o.label == "person")
    assert person.side == "right"
    assert not person.on_road
    assert [o.station for o in brief.objects] == sorted(o.station for o in brief.objects)
    text = brief.text()
    assert "parked truck" in text
    assert "narrows the road" in text
    assert "(synthetic)" in text
    json.dumps(brief.to_dict(), allow_nan=False)


def test_a_mirrored_route_swaps_sides(watched):
    way = Route(np.array([[-28.0, 0], [28, 0]]))
    back = Route(way.points[::-1])
    there = {o.id: o for o in brief_route(watched, way).objects}
    again = {o.id: o for o in brief_route(watched, back).objects}
    assert set(there) == set(again)
    swapped = {"left": "right", "right": "left", "ahead": "ahead"}
    for id, one in there.items():
        assert again[id].side == swapped[one.side]
        assert again[id].left == pytest.approx(-one.left, abs=0.01)
        assert again[id].station == pytest.approx(way.length - one.until, abs=0.02)


def test_what_nobody_saw_is_told(watched):
    brief = brief_route(watched, Route(np.array([[0.0, 0], [80, 0]])))
    (stretch,) = brief.unknown
    assert stretch.start == pytest.approx(30, abs=2)  # the road ends at x = 30
    assert stretch.end == pytest.approx(80, abs=1)


def test_views_along_a_route(watched, tmp_path):
    route = Route(np.array([[-28.0, -2], [0, -2]]))
    bundles = export_views(watched, tmp_path / "route", route=route, width=256, height=144)
    assert [b.view["viewpoint"]["method"] for b in bundles] == ["ahead", "ahead"]
    for bundle, station in zip(bundles, (0.0, 20.0), strict=True):
        np.testing.assert_allclose(np.array(bundle.view["ego"]["T_world_ego"])[:2, 3], [-28 + station, -2], atol=1e-6)
    told = json.loads((tmp_path / "route" / "brief.json").read_text())
    assert told == json.loads(json.dumps(brief_route(watched, route).to_dict()))
    road = {one["id"]: one["on_road"] for one in told["objects"]}
    asked = 0
    for bundle in bundles:
        marks = {item["mark"]: item["id"] for item in bundle.view["objects"] if item["mark"]}
        for one in json.loads((bundle.folder / "questions.json").read_text())["questions"]:
            if one["kind"] == "on_road":
                assert one["answer"] == ("yes" if road[marks[one["marks"][0]]] else "no")
                asked += 1
    assert asked
    with pytest.raises(ConfigError, match="viewpoints or a route, got both"):
        export_views(watched, tmp_path / "both", route=route, viewpoints=[])


def test_views_along_the_drive(street):
    stands = choose.along_trajectory(street, spacing=8.0, width=256, height=144)
    assert [stand.name for stand in stands] == ["frame_000_cam_front", "frame_001_cam_front", "frame_002_cam_front"]
    assert len(choose.along_trajectory(street, spacing=10.0)) == 2
    with pytest.raises(ConfigError, match="keeps no such camera: expected CAM_FRONT, got CAM_BACK"):
        choose.along_trajectory(street, camera="CAM_BACK")


def test_a_view_ahead_stands_so_far_ahead(street):
    stand = choose.ahead(street, 12.0)
    np.testing.assert_allclose(stand.T_world_ego[:2, 3], [-16, -2], atol=1e-6)
    assert stand.heading == pytest.approx(0.0, abs=1e-6)
    assert "12 m ahead" in stand.reason
    mount = np.linalg.inv(street.frames[0].T_world_ego) @ street.frames[0].cameras[0].T_world_cam
    np.testing.assert_allclose(stand.camera.T_world_cam, stand.T_world_ego @ mount, atol=1e-9)
    with pytest.raises(ConfigError, match="the way ahead does not reach so far"):
        choose.ahead(street, 500.0)


def test_the_best_view_of_an_object_shows_it_whole(street):
    trucks = [item for item in street.objects if item.label == "truck"]
    for truck in trucks:
        stand = choose.looking_at(street, truck.id, width=512, height=288)
        view = render_map(street, stand.camera)
        assert (view.item == truck.id).sum() > 2000
        assert "100%" in stand.reason or "95%" in stand.reason
        again = choose.looking_at(street, truck.id, width=512, height=288)
        np.testing.assert_array_equal(again.camera.T_world_cam, stand.camera.T_world_cam)
    with pytest.raises(ConfigError, match="cannot be shown: expected an object with voxels of its own, got scene"):
        choose.looking_at(street, 0)


def test_few_views_cover_many_objects(street):
    wanted = [item.id for item in street.objects if item.label in ("truck", "car", "person", "tree")]
    cover = choose.covering(street, wanted, width=512, height=288)
    assert set(cover.shown) | set(cover.missed) == set(wanted)
    assert not set(cover.shown) & set(cover.missed)
    assert len(cover.missed) <= 1
    assert len(cover.lookouts) < len(wanted)
    scale = (1024 * 576) / (512 * 288)
    for id, number in cover.shown.items():
        pixels = int((render_map(street, cover.lookouts[number].camera).item == id).sum())
        assert pixels * 1.3 > 150, (id, pixels, scale)
    assert choose.covering(street, []).lookouts == ()


def test_a_rig_has_all_its_cameras(street):
    (stand,) = lookout.rig(street, 1, 320, 180)
    assert stand.name == "CAM_FRONT"
    assert stand.time == 1.0
    with pytest.raises(ConfigError, match=r"no keyframe with cameras has this index: expected one of \[0, 1, 2\]"):
        lookout.rig(street, 7)


def test_questions_follow_from_the_view(watched, tmp_path):
    bundle = export_views(watched, tmp_path / "asked")
    questions = json.loads((bundle.folder / "questions.json").read_text())["questions"]
    assert questions == json.loads(json.dumps(questions_about(bundle.view)))
    assert {q["kind"] for q in questions} == {"count", "exists", "side", "nearest", "state", "ahead"}
    marked = {item["mark"]: item for item in bundle.view["objects"] if item["mark"]}
    for q in questions:
        assert q["answer"] in q["choices"] if "choices" in q else isinstance(q["answer"], int)
        assert set(q["marks"]) <= set(marked)
        if q["kind"] == "side":
            left = marked[q["marks"][0]]["center_ego"][1] > 0
            assert q["answer"] == ("left" if left else "right")
        if q["kind"] == "state":
            assert q["answer"] == marked[q["marks"][0]]["state"] != "unknown"
        if q["kind"] == "nearest":
            same = [m for m in marked.values() if m["label"] == marked[q["answer"]]["label"]]
            assert min(same, key=lambda m: m["range_m"])["mark"] == q["answer"]
        if q["kind"] == "exists":
            label = q["question"].split('"')[1]
            assert (q["answer"] == "yes") == any(m["label"] == label for m in marked.values())
    yes = [q["answer"] for q in questions if q["kind"] == "exists"]
    assert yes.count("yes") == yes.count("no")


def test_nothing_is_asked_of_nothing(watched, tmp_path):
    bundle = export_views(watched, tmp_path / "none", options=ViewOptions(most_marks=0))
    assert json.loads((bundle.folder / "questions.json").read_text())["questions"] == []
