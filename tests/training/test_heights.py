"""DHD's height: its truth is what a ray meets, and its loss teaches it."""

import json

import numpy as np
import pytest
import torch

from openvocab_occ.networks.dhd import HEIGHT_STEP, SLABS
from openvocab_occ.networks.flashocc import TINY
from openvocab_occ.networks.losses import height_loss
from openvocab_occ.networks.predictor import load_network
from openvocab_occ.occupancy import OCC3D_FREE
from openvocab_occ.training.drives import DriveInfo, write_drive
from openvocab_occ.training.heights import NO_HEIGHT, height_bins
from openvocab_occ.training.loop import TrainConfig, batch_of, train_baseline
from openvocab_occ.training.samples import network_spec

from .conftest import drive_frames

CELLS = (6, 16)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    info = DriveInfo(name="a", place="p", log="l", scene="s")
    return write_drive(tmp_path_factory.mktemp("tiny") / "a.npz", drive_frames(3), info, TINY)


def test_height_is_that_of_the_first_voxel_on_the_ray(drive):
    """Against a walk in steps of a centimetre along the points of the view transform itself."""
    network = load_network("dhd-tiny")
    _, rig, _, _ = batch_of([(drive, 1)])
    view = network.module.img_view_transformer
    depths = np.arange(0.5, 60, 0.01)
    view.depths = depths.tolist()
    points = view.points(rig, CELLS, TINY.image_size)[0].numpy()  # n d h w 3
    spec, labels = network_spec(TINY), drive.labels[1]
    cells = np.floor((points - np.asarray(spec.origin)) / spec.size).astype(int)
    inside = ((cells >= 0) & (cells < spec.shape)).all(-1)
    full = inside & (labels[tuple(np.where(inside[..., None], cells, 0).transpose(4, 0, 1, 2, 3))] != OCC3D_FREE)
    bins = height_bins(drive, 1, TINY, CELLS)
    assert bins.shape == (2, *CELLS)
    checked = 0
    for n, y, x in np.ndindex(bins.shape):
        hits = np.flatnonzero(full[n, :, y, x])
        if not len(hits):
            assert bins[n, y, x] == NO_HEIGHT
            continue
        z = points[n, hits[0], y, x, 2]
        assert SLABS[0][0] + bins[n, y, x] * HEIGHT_STEP == pytest.approx(z, abs=0.11)
        checked += 1
    assert checked > 50
    assert (bins == NO_HEIGHT).any()


def test_slabs_hold_the_voxels_that_are_seen(drive):
    """A pixel whose height is known exactly goes to the slab of the voxel that it looks at."""
    bins = torch.from_numpy(height_bins(drive, 0, TINY, CELLS))[None]
    there = bins != NO_HEIGHT
    exact = torch.nn.functional.one_hot(torch.where(there, bins, 0).long(), 65).movedim(-1, 2).float()
    masks = load_network("dhd-tiny").module.slab_masks(exact)
    assert (sum(m.int() for m in masks) == 1).all()
    road = bins == round((0.6 - 0.06 + 1) / HEIGHT_STEP)  # seen from above, through the roof of its voxel
    assert road.any()
    assert masks[0][road].all()


def test_height_loss_is_its_definition():
    p = torch.rand(1, 2, 5, 2, 3).softmax(dim=2)
    bins = torch.randint(0, 5, (1, 2, 2, 3))
    bins[0, 0, 0, 0] = 255
    total, count = 0.0, 0
    for n, y, x in np.ndindex(2, 2, 3):
        if bins[0, n, y, x] == 255:
            continue
        count += 1
        for k in range(5):
            q = p[0, n, k, y, x]
            total -= (q.log() if k == bins[0, n, y, x] else (1 - q).log()).item()
    assert height_loss(p, bins).item() == pytest.approx(total / count, rel=1e-4)
    assert height_loss(p, torch.full_like(bins, 255)).item() == 0.0


def test_training_teaches_the_height(drive, tmp_path):
    torch.manual_seed(0)
    network = load_network("dhd-tiny")
    before = {n: v.clone() for n, v in network.module.named_parameters() if ".height_net." in n}
    bins = torch.from_numpy(height_bins(drive, 0, TINY, CELLS))[None]
    images, rig, _, _ = batch_of([(drive, 0)])

    def judged() -> float:
        with torch.no_grad():
            return float(height_loss(network.module.eval().latent_and_height(images, rig)[1], bins))

    first = judged()
    train_baseline(network, [drive], tmp_path, TrainConfig(steps=4, batch=1, warm_up=1, loss="dhd", ema=0.0))
    after = dict(network.module.named_parameters())
    assert sum(not torch.equal(after[n], v) for n, v in before.items()) > 0.9 * len(before)
    assert judged() < first - 0.02
    lines = (tmp_path / "log.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["loss"] < json.loads(lines[0])["loss"]
