import numpy as np
import pytest
from block_frames import vector
from scipy.cluster.hierarchy import is_monotonic, is_valid_linkage

from openvocab_occ.mapping import Lifted, VoxelMap
from openvocab_occ.mapping.cover import cover_keys
from openvocab_occ.objects import Box, SceneObject
from openvocab_occ.objects.ground import Ground, find_junctions, junction_kind
from openvocab_occ.objects.groups import find_groups
from openvocab_occ.objects.hierarchy import build_tree, dendrogram
from openvocab_occ.objects.parts import find_parts
from openvocab_occ.objects.regions import find_regions
from openvocab_occ.objects.tree import LEVELS

NAMES = ("driveable surface", "sidewalk", "terrain", "car", "truck", "manmade", "free")
SIZE = 0.4


def voxel_map(cells):
    """A map of {key: (class, feature name)}."""
    keys = np.array(list(cells), np.int32)
    sums = np.array([vector(f) for _, f in cells.values()], np.float32)
    voxels = VoxelMap(SIZE, 16, num_classes=len(NAMES))
    ones = np.ones(len(keys), np.float32)
    labels = np.array([NAMES.index(c) for c, _ in cells.values()], np.uint8)
    voxels.integrate(cover_keys(keys), Lifted(sums, ones, ones.astype(np.int32)), time=0.0, labels=labels, frame=0)
    return voxels


def crossing(arms, half=100, width=9):
    """A crossing of streets along the axes; `arms` of n, e, s, w."""
    cells = {}
    for x in range(-half, half):
        for y in range(-half, half):
            inside = abs(x) < width and abs(y) < width
            way = (abs(x) < width and ((y > 0 and "n" in arms) or (y < 0 and "s" in arms))) or (
                abs(y) < width and ((x > 0 and "e" in arms) or (x < 0 and "w" in arms))
            )
            if inside or way:
                cells[x, y, 0] = ("driveable surface", "road")
            elif max(abs(x), abs(y)) < 60 and min(abs(x), abs(y)) < width + 8:
                cells[x, y, 0] = ("sidewalk", "walk")
    return voxel_map(cells)


@pytest.mark.parametrize(("arms", "kind"), [("nesw", "cross"), ("esw", "T"), ("nes", "T"), ("ew", None), ("ns", None)])
def test_junctions_are_told_by_their_arms(arms, kind):
    path = np.c_[np.linspace(-30, 30, 31), np.zeros(31)]
    found = find_junctions(Ground.of(crossing(arms), NAMES), path)
    assert [j.kind for j in found] == ([kind] if kind else [])
    for junction in found:
        assert np.hypot(*junction.center) < 3.0
        assert len(junction.arms) == len(arms)


def test_kinds_of_junctions():
    assert junction_kind([0.0, np.pi / 2, np.pi]) == "T"
    assert junction_kind([0.0, 2 * np.pi / 3, 4 * np.pi / 3]) == "Y"
    assert junction_kind([0.0, 1.0, 2.0, 3.0]) == "cross"
    assert junction_kind([0.0, 1.0, 2.0, 3.0, 4.0]) == "star"


def test_a_crossing_has_four_stretches_of_road_that_meet_in_it():
    path = np.c_[np.linspace(-30, 30, 31), np.zeros(31)]
    regions = find_regions(crossing("nesw"), NAMES, path)
    kinds = [r.kind for r in regions.regions]
    assert kinds.count("junction") == 1
    assert kinds.count("road segment") == 4
    assert kinds.count("sidewalk") == 4
    assert [e.junctions for e in regions.lanes.edges] == [(0,)] * 4
    assert regions.nearest(np.array([[0.0, 0.0]])) == 1


def thing(id, label, center, size=(4.4, 2.0, 1.6), state="parked", yaw=0.0):
    return SceneObject(
        id=id, label=label, score=1.0, box=Box(np.array(center, float), np.array(size, float), yaw),
        voxels=np.empty(0, np.int64), points=np.empty((0, 3), np.float32), embedding=vector(label), state=state,
        parent=0,
    )  # fmt: skip


def test_parked_cars_in_line_are_a_row_and_moving_ones_are_not():
    row = [thing(n + 1, "car", (6.0 * n, 0, 0.8)) for n in range(4)]
    lone = thing(9, "car", (60, 0, 0.8))
    across = thing(10, "car", (24.0, 0, 0.8), yaw=np.pi / 4)
    (group,) = find_groups([*row, lone, across])
    assert group.label == "row of parked cars"
    assert group.members == (1, 2, 3, 4)
    moving = [thing(n + 1, "car", (6.0 * n, 0, 0.8), state="moving") for n in range(4)]
    assert find_groups(moving) == []
    assert find_groups([]) == []


def truck_map():
    """A truck on a road, whose cab and box look different."""
    cells = {(x, y, 0): ("driveable surface", "road") for x in range(-30, 60) for y in range(-9, 9)}
    cells |= {(x, y, z): ("truck", "cab" if x < 5 else "box") for x in range(18) for y in range(6) for z in range(1, 9)}
    return voxel_map(cells)


def truck_of(voxels):
    members = np.flatnonzero(voxels.labels == NAMES.index("truck"))
    return SceneObject(
        id=7, label="truck", score=1.0, box=Box.around(voxels.keys[members], SIZE), voxels=members,
        points=voxels.centers[members].astype(np.float32), embedding=vector("box"), state="parked", parent=0,
    )  # fmt: skip


def test_parts_are_where_features_differ():
    voxels = truck_map()
    parts = find_parts(truck_of(voxels), voxels)
    assert [len(p) for p in parts] == [13 * 48, 5 * 48]
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), truck_of(voxels).voxels)


def test_the_tree_goes_from_scene_to_parts_and_its_cuts_are_its_levels():
    voxels = truck_map()
    cars = [thing(n + 20, "car", (13.5 + 5.0 * n, 1.0, 0.8)) for n in range(3)]
    tree = build_tree([truck_of(voxels), *cars], voxels, names=NAMES, ego=[np.eye(4)])
    assert {node.level for node in tree.nodes} == set(LEVELS)
    assert tree[7].parent == tree[20].parent or tree[tree[20].parent].parent == tree[7].parent
    assert tree.region_of(7).label == "road segment"
    assert tree[tree[20].parent].label == "row of parked cars"
    assert [tree[id].level for id in tree[7].children] == ["part", "part"]
    assert next(depth for depth, _ in tree.walk()) == 0
    assert len(list(tree.walk())) == len(tree.nodes)
    cuts = dendrogram(tree)
    assert is_valid_linkage(cuts.linkage)
    assert is_monotonic(cuts.linkage)
    for level in LEVELS:
        cluster = cuts.cut(level)
        depth = LEVELS.index(level)

        def above(id, depth=depth):
            node = tree[id]
            while node.parent is not None and LEVELS.index(tree[node.parent].level) >= depth:
                node = tree[node.parent]
            return node.id

        homes = {id: above(id) for id in cuts.leaves}
        same = {(a, b) for a in cuts.leaves for b in cuts.leaves if homes[a] == homes[b]}
        assert same == {(a, b) for a in cuts.leaves for b in cuts.leaves if cluster[a] == cluster[b]}


def test_an_empty_map_is_a_scene_alone():
    tree = build_tree([], VoxelMap(SIZE, 16, num_classes=len(NAMES)), names=NAMES)
    assert [node.level for node in tree.nodes] == ["scene"]
    assert dendrogram(tree).cut("scene") == {0: 1}
