"""Frames made of blocks of voxels, for tests of segments and tracks."""

import numpy as np

from openvocab_occ.mapping.keys import pack
from openvocab_occ.objects.frame_voxels import FrameVoxels, PixelRows

NAMES = ("car", "truck", "bus", "pedestrian", "manmade", "vegetation", "driveable surface", "free")
SIZE = 0.4


def block(label, low, size, feature=None):
    """A box of voxels, corners and sides in voxels."""
    keys = np.argwhere(np.ones(size)) + np.asarray(low)
    return keys, NAMES.index(label) if label else 255, label if feature is None else feature


def vector(name, dim=16):
    v = np.random.default_rng([ord(c) for c in str(name)]).standard_normal(dim)
    return (v / np.linalg.norm(v)).astype(np.float32)


def frame_of(blocks, *, index=0, time=0.0, hidden=(), views=()):
    """A frame that sees all blocks; those of `hidden` are known but not seen."""
    keys, labels, features = {}, {}, {}
    for cells, label, feature in blocks:
        for key in map(tuple, cells.tolist()):
            keys[key], labels[key], features[key] = True, label, vector(feature)
    for cells, label, _ in hidden:
        for key in map(tuple, cells.tolist()):
            keys.setdefault(key, False)
            labels.setdefault(key, label)
    names = np.array(list(keys), np.int32).reshape(-1, 3)
    packed = pack(names)
    order = np.argsort(packed)
    shown = np.array(list(keys.values()), bool)[order]
    at = [tuple(names[i].tolist()) for i in order]
    seen = np.flatnonzero(shown)
    cells = np.array([features[at[i]] for i in seen], np.float32).reshape(len(seen), 16)
    return FrameVoxels(
        index=index, timestamp=time, T_world_ego=np.eye(4), voxel_size=SIZE, contract="dense", packed=packed[order],
        seen=seen, features=cells, weight=np.full(len(seen), 9.0, np.float32),
        labels=np.array([labels[k] for k in at], np.uint8), views=tuple(PixelRows(n, r, 1) for n, r in views),
    )  # fmt: skip
