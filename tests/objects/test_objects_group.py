import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.mapping import Lifted, VoxelMap
from openvocab_occ.objects import Box, ObjectTree, group_objects
from openvocab_occ.objects.group import components


def voxel_map(keys, features, *, contract="logits", labels=None):
    voxels = VoxelMap(0.5, features.shape[1], contract=contract)
    n = len(keys)
    lifted = Lifted(features.astype(np.float32), np.ones(n, np.float32), np.ones(n, np.int32))
    voxels.integrate(np.asarray(keys, np.int32), lifted, time=0.0, labels=labels)
    return voxels


def flooded(voxels):
    """Components by flood fill over a dict, for logits maps."""
    best = dict(zip(map(tuple, voxels.keys.tolist()), voxels.features.argmax(1).tolist(), strict=True))
    groups = []
    while best:
        key, label = best.popitem()
        group, todo = {key}, [key]
        while todo:
            x, y, z = todo.pop()
            for d in np.ndindex(3, 3, 3):
                near = (x + d[0] - 1, y + d[1] - 1, z + d[2] - 1)
                if best.get(near) == label:
                    del best[near]
                    group.add(near)
                    todo.append(near)
        groups.append(frozenset(group))
    return set(groups)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 80))
def test_components_are_those_of_a_flood_fill(seed, count):
    rng = np.random.default_rng(seed)
    keys = np.unique(rng.integers(-4, 4, size=(count, 3)), axis=0)
    voxels = voxel_map(keys, np.eye(2)[rng.integers(0, 2, len(keys))])
    groups = components(voxels, 0.5)
    assert {frozenset(map(tuple, voxels.keys[g].tolist())) for g in groups} == flooded(voxels)
    assert sorted(np.concatenate(groups).tolist()) == list(range(len(voxels)))
    assert [len(g) for g in groups] == sorted(map(len, groups), reverse=True)


def two_blocks():
    """A block of 3 x 3 x 2 voxels of label 1 that touches one of 2 x 2 x 2 of label 0, and a lone voxel."""
    a = np.argwhere(np.ones((3, 3, 2)))
    b = np.argwhere(np.ones((2, 2, 2))) + np.array([3, 0, 0])
    keys = np.concatenate([a, b, [[20, 20, 20]]])
    return keys, np.array([[0.2, 0.8]] * len(a) + [[0.9, 0.1]] * len(b) + [[0.0, 1.0]])


def test_objects_are_named_scored_and_ordered():
    tree = group_objects(voxel_map(*two_blocks()), labels=("car", "road"))
    assert len(tree) == 2
    assert [(o.id, o.label, len(o.voxels)) for o in tree] == [(1, "road", 18), (2, "car", 8)]
    np.testing.assert_allclose([o.score for o in tree], [0.8, 0.9], rtol=1e-6)
    assert tree[2].state == "unknown"
    np.testing.assert_allclose(tree[2].box.size, [1, 1, 1])
    np.testing.assert_allclose(tree[2].center, [2.0, 0.5, 0.5])
    assert tree.root.children == (1, 2)
    assert tree.level("object") == tuple(tree)
    assert tree.level("scene") == (tree.root,)
    with pytest.raises(ConfigError, match="no object has this id: expected one of 3 ids from 0, got 7"):
        tree[7]


def test_ids_do_not_depend_on_the_order_of_arrival(rng):
    keys, features = two_blocks()
    order = rng.permutation(len(keys))
    first, second = (group_objects(voxel_map(keys[o], features[o])) for o in (slice(None), order))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
        assert (a.id, a.label) == (b.id, b.label)


def test_dense_neighbours_split_where_their_cosine_is_low():
    keys = np.stack([np.arange(8), np.zeros(8, int), np.zeros(8, int)], axis=1)
    features = np.array([[1, 0.0]] * 4 + [[0.6, 0.8]] * 4)
    labels = np.array([3] * 4 + [1] * 4, np.uint8)
    voxels = voxel_map(keys, features, contract="dense", labels=labels)
    tree = group_objects(voxels, min_cosine=0.7, class_names=("a", "b", "c", "d"))
    assert [o.label for o in tree] == ["d", "b"]
    assert all(abs(np.linalg.norm(o.embedding) - 1) < 1e-6 for o in tree)
    assert len(group_objects(voxels, min_cosine=0.5)) == 1


def test_an_empty_map_has_a_root_and_no_objects():
    tree = group_objects(VoxelMap(0.5, 2))
    assert len(tree) == 0
    assert tree.root.box.volume == 0


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*[st.integers(-20, 20)] * 3), min_size=1, max_size=40))
def test_box_holds_its_voxels_and_is_no_larger_than_the_axis_aligned_one(keys):
    keys = np.array(keys, np.int32)
    box = Box.around(keys, 0.4)
    assert box.contains((keys + 0.5) * 0.4).all()
    corners = np.concatenate([keys + np.array(d) for d in np.ndindex(2, 2, 2)]) * 0.4
    assert box.contains(corners).all()
    assert box.volume <= np.ptp(corners, axis=0).prod() * (1 + 1e-6)
    assert box.size[0] >= box.size[1] * (1 - 1e-6)
    assert -np.pi / 2 < box.yaw <= np.pi / 2 + 1e-12
    assert box.contains(box.corners).all()


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(*[st.integers(-20, 20)] * 3), min_size=1, max_size=30))
def test_box_area_is_that_of_opencv(keys):
    import cv2

    keys = np.array(keys, np.int32)
    corners = np.concatenate([keys[:, :2] + np.array(d) for d in np.ndindex(2, 2)]).astype(np.float32)
    _, (w, h), _ = cv2.minAreaRect(corners)
    np.testing.assert_allclose(Box.around(keys, 1.0).size[:2].prod(), w * h, rtol=1e-4)


def test_a_diagonal_row_gets_a_turned_box():
    box = Box.around(np.array([[i, i, 0] for i in range(20)], np.int32), 1.0)
    np.testing.assert_allclose(box.yaw, np.pi / 4)
    assert box.size[0] > 10 * box.size[1]


def test_a_tree_that_hangs_together_wrongly_is_told():
    tree = group_objects(voxel_map(*two_blocks()))
    with pytest.raises(DataError, match="object tree has no root"):
        ObjectTree(list(tree))
    with pytest.raises(DataError, match="object ids repeat"):
        ObjectTree([tree.root, *tree, tree[1]])
    with pytest.raises(DataError, match="children of object 0"):
        ObjectTree([tree.root, tree[1]])


@pytest.mark.parametrize("wrong", [{"min_voxels": 0}, {"min_cosine": 2.0}, {"labels": ("one",)}])
def test_options_that_make_no_sense_are_told(wrong):
    with pytest.raises(ConfigError, match=r"min_|labels do not fit"):
        group_objects(voxel_map(*two_blocks()), **wrong)
