import numpy as np
import pytest

from openvocab_occ.objects.frame_voxels import FrameVoxels, PixelRows, PixelSight
from openvocab_occ.objects.looks import added, looks_of, palette
from openvocab_occ.segmentation.encoder import FeatureMap

POST, CAR, WALL, ROAD = np.eye(4, dtype=np.float32)
RED, GREY = (200, 20, 20), (120, 120, 120)
H, W, FOCAL, VOXEL = 48, 96, 100.0, 0.4


def frame_of(ids, cells, image, depth, labels, *, contract="dense"):
    """A frame of one view in which pixel (v, u) sees voxel ids[v, u]; a cell a pixel."""
    n = int(ids.max()) + 1
    view = PixelRows("front", np.where(ids < 0, n, ids).astype(np.int32), 1)
    sight = PixelSight(image, depth.astype(np.float32), FOCAL, FeatureMap(cells, (1.0, 1.0), (0.0, 0.0)))
    return FrameVoxels(
        index=0, timestamp=0.0, T_world_ego=np.eye(4), voxel_size=VOXEL, contract=contract,
        packed=np.arange(n, dtype=np.int64), seen=np.arange(n), features=np.zeros((n, 4), np.float32),
        weight=np.ones(n, np.float32), labels=np.array(labels, np.uint8),
        views=(PixelRows(view.view, view.rows, 1, sight),),
    )  # fmt: skip


def scene(left, right, shown, *, depth, behind=20.0):
    """A thing in columns left..right before a wall, of whose pixels only the columns `shown` show it."""
    ids = np.ones((H, W), int)
    ids[:, left:right] = 0
    cells, image = np.tile(WALL, (H, W, 1)), np.tile(np.uint8(GREY), (H, W, 1))
    cells[:, shown], image[:, shown] = POST, RED
    far = np.full((H, W), behind)
    far[:, left:right] = depth
    return frame_of(ids, cells, image, far, [3, 3])


def share(look, vector):
    return float(look.feature_sum @ vector) / float(look.feature_sum.sum())


@pytest.mark.parametrize("width", [1, 2, 4])
def test_a_post_thinner_than_its_voxel_looks_like_itself(width):
    frame = scene(40, 50, slice(44, 44 + width), depth=4.0)  # a voxel spans 10 pixels
    look = looks_of(frame, [np.array([0])])[0]
    assert width / 10 < 0.5
    assert share(look, POST) > 0.95
    red = palette(look)[0]
    assert red[1] > 150
    assert red[0] > 0.9


def test_what_looks_like_its_surroundings_all_over_looks_like_them():
    look = looks_of(scene(40, 50, slice(0, 0), depth=4.0), [np.array([0])])[0]
    assert share(look, WALL) == pytest.approx(1.0)


def test_deep_inside_a_silhouette_every_pixel_counts():
    frame = scene(20, 80, slice(45, 55), depth=20.0, behind=30.0)  # a voxel spans 2 pixels: a window in a wide thing
    look = looks_of(frame, [np.array([0])])[0]
    assert share(look, POST) == pytest.approx(10 / 56, abs=0.03)


def test_what_is_in_front_is_not_what_is_seen_past_a_thing():
    """A car between two nearer ones that look the same keeps its look, though its own window shows the wall."""
    ids = np.full((H, W), 1)
    ids[:, 40:50] = 0
    cells, image = np.tile(CAR, (H, W, 1)), np.tile(np.uint8(GREY), (H, W, 1))
    cells[:, 44:46] = WALL
    depth = np.full((H, W), 2.0)
    depth[:, 40:50] = 4.0
    look = looks_of(frame_of(ids, cells, image, depth, [3, 3]), [np.array([0])])[0]
    assert share(look, CAR) == pytest.approx(0.8, abs=0.01)


def test_looks_add_up_and_do_not_depend_on_the_contract_or_the_order():
    frame = scene(40, 50, slice(44, 46), depth=4.0)
    one, other = looks_of(frame, [np.array([0]), np.array([1])])
    assert share(other, WALL) > 0.99
    both = added(one, added(None, other))
    np.testing.assert_allclose(both.feature_sum, added(other, one).feature_sum)
    assert both.color_sum[:, 0].sum() == pytest.approx(one.color_sum[:, 0].sum() + other.color_sum[:, 0].sum())
    shares = palette(both)[:, 0]
    assert shares.sum() == pytest.approx(1)
    assert (np.diff(shares) <= 0).all()
    assert added(None, None) is None


def test_a_model_of_masks_gives_no_look():
    frame = scene(40, 50, slice(44, 46), depth=4.0)
    blind = [PixelRows(v.view, v.rows, v.stride) for v in frame.views]
    object.__setattr__(frame, "views", tuple(blind))
    assert looks_of(frame, [np.array([0])]) == [None]
