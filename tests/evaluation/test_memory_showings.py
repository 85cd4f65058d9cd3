"""The showings of the global map, small: what is gone is forgotten, who comes again finds what was there."""

import numpy as np

from openvocab_occ.evaluation.memory_plots import draw_fence, draw_revisits
from openvocab_occ.evaluation.memory_routes import revisits
from openvocab_occ.evaluation.memory_showings import fence
from openvocab_occ.io.images import read_image


def test_policies_forget_in_their_own_time(tmp_path):
    report = fence(tmp_path / "maps", before=6, after=2)
    left = report["left"]
    assert all(shares[0] > 0.9 for shares in left.values()), "the fence was there"
    assert report["frames"]["newest"] == 1, "one look is enough"
    assert left["ema 0.1"][1] > 0.9 > 0.1 > left["newest"][1]
    assert left["bayes"][1] > 0.9, "one look is not enough"
    draw_fence(report, tmp_path / "fence.png")
    assert read_image(tmp_path / "fence.png").std() > 5


def test_there_and_back(tmp_path):
    """A KITTI file of a street that is driven out and home again."""
    way = np.concatenate([np.arange(0.0, 300.0), np.arange(299.0, 140.0, -1.0)])
    rows = np.tile(np.eye(4)[:3], (len(way), 1, 1))
    rows[:, 2, 3] = way  # the camera looks along z
    np.savetxt(tmp_path / "route.txt", rows.reshape(-1, 12))
    report = revisits(tmp_path / "route.txt", tmp_path / "maps", spacing=20.0)
    assert report["again"]["windows"] >= 4
    assert report["again"]["found"] > 0.9
    assert report["again"]["right"] > 0.85
    assert report["new"]["windows"] >= 12
    assert report["new"]["most_found"] == 0, "nobody has been there"
    assert 0 < report["gb_per_km2"] < 0.2 * report["dense_gb_per_km2"]
    draw_revisits([report], tmp_path / "revisits.png")
    assert read_image(tmp_path / "revisits.png").std() > 5
