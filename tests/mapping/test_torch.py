"""Lift and fuse by torch, here on the CPU, against the kernels; on a GPU too where there is one."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.errors import ShapeError
from openvocab_occ.geometry import Camera, look_at
from openvocab_occ.mapping import Lifted, PixelWeights, Segments, Sight, VoxelMap, lift
from openvocab_occ.segmentation.encoder import FeatureMap

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]
FIELDS = ("sums", "weight", "pixels", "color_sum", "normal_sum", "box", "view", "score", "mask")


def same(a, b):
    for name in FIELDS:
        one, two = getattr(a, name), getattr(b, name)
        assert (one is None) == (two is None)
        if one is not None:
            assert one.dtype == two.dtype
            np.testing.assert_allclose(one, two, rtol=2e-5, atol=2e-4, err_msg=name)


def sight_of(rng, h, w, weights, lens):
    """A slope with a step in it, holes, and pixels that see nothing."""
    depth = (4 + 0.02 * np.arange(w)[None] + 0.05 * np.arange(h)[:, None]).astype(np.float32)
    depth[:, w // 2 :] += 3
    depth[rng.random((h, w)) < 0.1] = 0
    depth[rng.random((h, w)) < 0.05] = np.inf
    K = np.array([[w * 0.8, 0, w / 2], [0, w * 0.8, h / 2], [0, 0, 1.0]])
    distortion = (0.1, -0.05, 0.0, 0.0, 0.0) if lens == "brown" else ()
    T = look_at(np.zeros(3), np.array([1.0, 0.3, -0.2]))
    return Sight(Camera(K, w, h, T, distortion, lens), depth, weights)


@pytest.mark.parametrize("device", DEVICES)
@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.tuples(st.integers(1, 24), st.integers(1, 24)),
    stride=st.sampled_from([0.5, 1.0, 3.7, 16.0]),
    shift=st.sampled_from([0.0, -9.0, 30.0]),
    look=st.sampled_from(["none", "plain", "weighed", "lens"]),
    masks=st.booleans(),
)
def test_torch_lifts_what_the_kernels_lift(device, seed, size, stride, shift, look, masks):
    rng = np.random.default_rng(seed)
    rows = rng.integers(-1, 6, size=size).astype(np.int32)
    if masks:
        vectors = rng.normal(size=(4, 3)).astype(np.float32)
        vectors[2] = 0
        features = Segments(rng.integers(-1, 4, size=size).astype(np.int32), vectors)
    else:
        cells = rng.normal(size=(*rng.integers(1, 6, 2), 3)).astype(np.float32)
        features = FeatureMap(cells, (1 / stride, 1 / stride), (0.5 / stride - 0.5 + shift, 0.5 / stride - 0.5))
    weights = PixelWeights.none() if look == "plain" else PixelWeights()
    sight = None if look == "none" else sight_of(rng, *size, weights, "brown" if look == "lens" else "pinhole")
    image = rng.integers(0, 256, size=(*size, 3), dtype=np.uint8) if seed % 2 else None
    options = {"image": image, "sight": sight, "view": 3}
    same(lift(rows, 7, features, device=device, **options), lift(rows, 7, features, **options))


@pytest.mark.parametrize("device", DEVICES)
def test_torch_adds_up_what_the_kernels_add_up(device, rng):
    here, there = VoxelMap(0.4, 5), VoxelMap(0.4, 5, device=device)
    for n in range(4):
        keys = rng.integers(-40, 40, size=(3000, 3)).astype(np.int32)
        ones = rng.random(3000).astype(np.float32)
        lifted = Lifted(rng.normal(size=(3000, 5)).astype(np.float32), ones, np.ones(3000, np.int32))
        for voxels in (here, there):
            voxels.integrate(keys, lifted, time=float(n))
    assert len(here) > 2 * 4096  # more than two blocks
    np.testing.assert_array_equal(here.keys, there.keys)
    np.testing.assert_allclose(there.features, here.features, atol=1e-5)
    np.testing.assert_allclose(there.agreement, here.agreement, rtol=1e-4)
    twin = there.copy()
    twin.merge(there)
    here.merge(here.copy())
    np.testing.assert_allclose(twin.agreement * twin.weight, here.agreement * here.weight, rtol=1e-4, atol=1e-5)


def test_bad_masks_are_told_before_torch_is_asked():
    segments = Segments(np.full((2, 2), 3, np.int32), np.zeros((2, 3), np.float32))
    with pytest.raises(ShapeError, match=r"ids of segments have no vector: expected -1\.\.1, got 3"):
        lift(np.zeros((2, 2), np.int32), 1, segments, device="cpu")
