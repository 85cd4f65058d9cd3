"""Laws of the occupancy networks: counts as published, parts as defined, memory that cannot hurt when it is empty."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from openvocab_occ.datasets.registry import load_sequence
from openvocab_occ.errors import ConfigError, DataError, ModelError, ShapeError, UnsafeFileError
from openvocab_occ.geometry import invert
from openvocab_occ.networks.checkpoint import load_public_checkpoint
from openvocab_occ.networks.deform import DeformConv2d, deform_conv2d
from openvocab_occ.networks.dhd import DHD_S, Dhd, HeightNet
from openvocab_occ.networks.flashocc import M0, M1, TINY, FlashOcc, count_parameters, on_meta
from openvocab_occ.networks.lift_splat import BevGrid, LiftSplat, Rig
from openvocab_occ.networks.lmop import Lmop
from openvocab_occ.networks.predictor import fit_image, load_network


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def frame():
    return load_sequence("street", frames=1)[0]


@pytest.mark.parametrize(
    ("kind", "config", "millions"), [(FlashOcc, M0, 39.94), (FlashOcc, M1, 44.74), (Dhd, DHD_S, 146.69)]
)
def test_parameters_are_as_many_as_published(kind, config, millions):
    assert round(count_parameters(on_meta(kind, config)) / 1e6, 2) == millions


def test_height_net_is_as_large_as_published():
    assert round(count_parameters(on_meta(HeightNet, 256, 65)) / 1e6, 2) == 6.77


def test_backbone_has_the_names_of_torchvision():
    names = set(on_meta(FlashOcc, M0).img_backbone.state_dict())
    assert {"conv1.weight", "bn1.running_mean", "layer1.0.downsample.0.weight", "layer3.5.conv3.weight",
            "layer4.2.bn3.bias"} <= names  # fmt: skip
    assert len([n for n in names if n.endswith("conv2.weight")]) == 3 + 4 + 6 + 3


@pytest.mark.parametrize("groups", [1, 2])
def test_deformable_convolution_is_its_definition(groups):
    """out(p) = sum_k w_k x(p + p_k + d_k), written out with loops and a bilinear read."""
    b, c, h, w, o = 2, 4, 5, 6, 6
    x, offset = torch.randn(b, c, h, w), 1.5 * torch.randn(b, 18, h, w)
    weight = torch.randn(o, c // groups, 3, 3)

    def read(image, y, x):
        y0, x0 = math.floor(y), math.floor(x)
        total = torch.zeros(c)
        for yy, wy in ((y0, y0 + 1 - y), (y0 + 1, y - y0)):
            for xx, wx in ((x0, x0 + 1 - x), (x0 + 1, x - x0)):
                if 0 <= yy < h and 0 <= xx < w:
                    total += wy * wx * image[:, yy, xx]
        return total

    expected = torch.zeros(b, o, h, w)
    for i in range(b):
        for y in range(h):
            for u in range(w):
                for k in range(9):
                    dy, dx = offset[i, 2 * k : 2 * k + 2, y, u].tolist()
                    value = read(x[i], y + k // 3 - 1 + dy, u + k % 3 - 1 + dx)
                    for out in range(o):
                        g = out // (o // groups)
                        part = value[g * c // groups : (g + 1) * c // groups]
                        expected[i, out, y, u] += (weight[out, :, k // 3, k % 3] * part).sum()
    torch.testing.assert_close(deform_conv2d(x, offset, weight, groups=groups), expected, atol=1e-4, rtol=1e-4)


def test_deformable_convolution_begins_as_a_plain_one():
    layer, x = DeformConv2d(8, 8, groups=4), torch.randn(1, 8, 7, 9)
    plain = nn.functional.conv2d(x, layer.weight, padding=1, groups=4)
    torch.testing.assert_close(layer(x), plain, atol=1e-5, rtol=1e-5)


class TestLiftSplat:
    """The view transform against a loop over points."""

    grid = BevGrid((-4.0, -4.0, -1.0), (1.0, 1.0, 2.0), (8, 8, 2))

    def rig(self, n=2):
        K = torch.tensor([[10.0, 0, 16], [0, 10, 8], [0, 0, 1]]).expand(1, n, 3, 3)
        T = torch.tensor([[[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]],
                          [[0.0, 0, -1, 0], [1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]]])[None]  # fmt: skip
        move = torch.tensor([[0.5, 0, -1], [0, 0.5, 2], [0, 0, 1]]).expand(1, n, 3, 3)
        return Rig(K, T, move, torch.eye(3)[None])

    def test_points_project_back_to_their_pixels(self):
        view, rig, size = LiftSplat(4, 3, (1.0, 5.0, 1.0), self.grid), self.rig(), (16, 32)
        points = view.points(rig, (4, 8), size)
        v, u = torch.meshgrid(torch.linspace(0, 15, 4), torch.linspace(0, 31, 8), indexing="ij")
        for n in range(2):
            local = (
                points[0, n] @ rig.T_ego_cam[0, n, :3, :3] - rig.T_ego_cam[0, n, :3, 3] @ rig.T_ego_cam[0, n, :3, :3]
            )
            pixel = local @ (rig.T_net_image[0, n] @ rig.K[0, n]).T
            pixel = pixel / pixel[..., 2:]
            torch.testing.assert_close(pixel[..., 0], u.expand(4, -1, -1), atol=1e-4, rtol=0)
            torch.testing.assert_close(pixel[..., 1], v.expand(4, -1, -1), atol=1e-4, rtol=0)
            torch.testing.assert_close(local[..., 2], torch.arange(1.0, 5)[:, None, None].expand(-1, 4, 8))

    def test_splat_is_a_sum_over_points(self):
        view, rig = LiftSplat(4, 3, (1.0, 5.0, 1.0), self.grid), self.rig()
        depth, context = view.predict(torch.randn(1, 2, 4, 4, 8))
        points = view.points(rig, (4, 8), (16, 32))
        expected = torch.zeros(2, 3, 8, 8)
        inside = 0
        for n, d, y, x in np.ndindex(2, 4, 4, 8):
            cell = np.floor((points[0, n, d, y, x].numpy() - self.grid.lower) / self.grid.cell).astype(int)
            if (cell >= 0).all() and (cell < self.grid.shape).all():
                inside += 1
                expected[cell[2], :, cell[1], cell[0]] += (depth[0, n, d, y, x] * context[0, n, :, y, x]).detach()
        assert inside > 20
        torch.testing.assert_close(view.splat(depth, context, points, self.grid)[0], expected.reshape(6, 8, 8))
        assert torch.allclose(depth.sum(dim=2), torch.ones(1, 2, 4, 8))

    def test_truncation_differs_just_below_the_border(self):
        point = torch.tensor([[[-4.5, 0.0, 0.0]]])
        assert self.grid.index(point)[1].item() == 0
        assert self.grid.index(point, truncate=True)[1].item() == 1


@pytest.mark.parametrize("name", ["flashocc-tiny", "dhd-tiny"])
def test_predict_gives_logits_of_the_grid(name, frame):
    network = load_network(name)
    logits = network.predict(frame)
    assert logits.shape == (*network.spec.shape, 18)
    assert logits.dtype == np.float32
    np.testing.assert_array_equal(logits, network.predict(frame))
    fewer = network.predict(SimpleFrame(frame, frame.views[:3]))
    assert fewer.shape == logits.shape


def SimpleFrame(frame, views):
    from dataclasses import replace

    return replace(frame, views=views)


def test_gradients_reach_every_part():
    network = Dhd(TINY).train()
    rig = Rig(torch.tensor([[60.0, 0, 64], [0, 60, 24], [0, 0, 1]]).expand(1, 2, 3, 3),
              torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1]]).expand(1, 2, 4, 4),
              torch.eye(3).expand(1, 2, 3, 3), torch.eye(3)[None])  # fmt: skip
    network(torch.randn(1, 2, 3, 48, 128), rig).square().mean().backward()
    silent = {n for n, p in network.named_parameters() if p.grad is None}
    # the height distribution only chooses slabs: its gradient comes from its own loss
    assert all(n.startswith("img_view_transformer.height_net.") for n in silent)


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return load_network("flashocc-tiny", memory=True)


class TestMemory:
    """LMOP around a baseline."""

    def prior(self, net, fill=1.0):
        shape = net.spec.shape
        rng = np.random.default_rng(0)
        known = np.zeros(shape, bool)
        known[:50] = True
        logits = np.where(known[..., None], fill * rng.normal(size=(*shape, 18)), 0).astype(np.float32)
        return SimpleNamespace(logits=logits, known=known)

    def test_empty_prior_gives_the_baseline(self, net, frame):
        """Bit for bit: the head begins as a copy, and unknown cells keep the current feature."""
        baseline = net.module.baseline
        images, rig = net.prepare(frame)
        with torch.no_grad():
            np.testing.assert_array_equal(net.predict(frame), baseline(images, rig)[0].numpy())

    def test_prior_works_only_where_it_knows(self, net, frame):
        """Beyond the reach of the head's 3x3 convolution nothing changes."""
        base, fused = net.predict(frame), net.predict(frame, self.prior(net))
        assert np.abs(base[:50] - fused[:50]).max() > 1e-4
        np.testing.assert_allclose(base[52:], fused[52:], atol=1e-5)

    def test_axes_of_prior_and_feature_agree(self, net):
        """A prior that knows one corner of [x, y] changes that corner of the grid, not its mirror image."""
        current = torch.randn(1, TINY.latent, 100, 100)
        known = torch.zeros(1, 100, 100, 8, dtype=torch.bool)
        known[:, :20, 80:] = True
        prior = torch.randn(1, 100, 100, 8, 18) * known[..., None]
        with torch.no_grad():
            change = (net.module.refine(current, prior, known) - net.module.occ_head(current)).abs().amax(dim=(0, 3, 4))
        assert change[:20, 80:].min() > 0
        assert change[24:, :].max() == 0
        assert change[:, :76].max() == 0

    def test_baseline_is_not_changed_by_training(self, net, frame):
        before = {n: v.clone() for n, v in net.module.baseline.state_dict().items()}
        module = net.module.train()
        learned = [p for p in module.parameters() if p.requires_grad]
        optimiser = torch.optim.AdamW(learned, lr=1e-2)
        images, rig = net.prepare(frame)
        prior = self.prior(net)
        out = module(images, rig, torch.from_numpy(prior.logits)[None], torch.from_numpy(prior.known)[None])
        out.square().mean().backward()
        optimiser.step()
        module.eval()
        for name, value in module.baseline.state_dict().items():
            assert torch.equal(value, before[name]), name
        assert all(p.grad is not None for p in learned)

    def test_bev_augmentation_is_refused(self, net, frame):
        images, rig = net.prepare(frame)
        turned = Rig(rig.K, rig.T_ego_cam, rig.T_net_image, torch.diag(torch.tensor([1.0, -1.0, 1.0]))[None])
        prior = self.prior(net)
        with pytest.raises(ShapeError, match="augmentation"):
            net.module(images, turned, torch.from_numpy(prior.logits)[None], torch.from_numpy(prior.known)[None])

    def test_prior_of_another_grid_or_class_set_is_refused(self, net, frame):
        wrong = SimpleNamespace(logits=np.zeros((200, 200, 16, 18), np.float32), known=np.zeros((200, 200, 16), bool))
        with pytest.raises(ShapeError, match="prior does not fit"):
            net.predict(frame, wrong)
        with pytest.raises(ConfigError, match="has no memory"):
            load_network("flashocc-tiny").predict(frame, wrong)


def test_preparing_keeps_points_on_their_pixels(frame):
    """A point seen at pixel p of the image is seen at T_net_image p of the network's input."""
    network = load_network("flashocc-tiny")
    _, rig = network.prepare(frame)
    height, width = network.config.image_size
    view = sorted(frame.views, key=lambda v: v.name != "CAM_FRONT_LEFT")[0]
    point = view.camera.T_world_cam @ np.array([0.3, -0.1, 5.0, 1.0])
    uv, _ = view.camera.project(point[None, :3])
    index = [v.name for v in frame.views].index(view.name)
    order = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT")
    n = sorted(range(len(frame.views)), key=lambda i: order.index(frame.views[i].name)).index(index)
    T = rig.T_ego_cam[0, n].double().numpy()
    local = invert(T) @ invert(frame.T_world_ego) @ point
    direct = (rig.T_net_image[0, n] @ rig.K[0, n]).double().numpy() @ local[:3]
    moved = rig.T_net_image[0, n].double().numpy() @ np.array([*uv[0], 1.0])
    np.testing.assert_allclose(direct[:2] / direct[2], moved[:2], atol=1e-3)
    assert fit_image(view.image, (height, width))[0].shape == (height, width, 3)


def test_nuscenes_images_are_fitted_as_published():
    """1600 x 900 by 0.44 to 704 x 396, rows 140 to 396 kept."""
    image, move = fit_image(np.zeros((900, 1600, 3), np.uint8), (256, 704))
    assert image.shape == (256, 704, 3)
    np.testing.assert_allclose(move, [[0.44, 0, -0.28], [0, 0.44, -140.28], [0, 0, 1]], atol=1e-9)


class TestCheckpoints:
    """Synthetic files with the names and shapes of public ones."""

    def save(self, path, network, **extra):
        state = {f"module.{n}": v for n, v in network.state_dict().items()}
        torch.save({"meta": {"epoch": 24}, "state_dict": {**state, **extra}, "optimizer": {}}, path)
        return path

    def test_round_trip(self, tmp_path):
        source, target = FlashOcc(TINY), FlashOcc(TINY)
        report = load_public_checkpoint(target, self.save(tmp_path / "a.pth", source))
        assert report.complete
        assert all(
            torch.equal(a, b) for a, b in zip(source.state_dict().values(), target.state_dict().values(), strict=True)
        )

    def test_every_name_that_does_not_match_is_reported(self, tmp_path):
        source = FlashOcc(TINY)
        file = self.save(tmp_path / "a.pth", source, **{"pts_bbox_head.x": torch.zeros(1), "odd.weight": torch.zeros(2),
                                                        "occ_head.predicter.0.bias": torch.zeros(3)})  # fmt: skip
        content = torch.load(file, weights_only=True)
        del (
            content["state_dict"]["module.occ_head.predicter.0.bias"],
            content["state_dict"]["module.img_backbone.bn1.bias"],
        )
        torch.save(content, file)
        report = load_public_checkpoint(FlashOcc(TINY), file)
        assert report.unexpected == ("odd.weight",)
        assert report.missing == ("img_backbone.bn1.bias",)
        assert report.misshapen == ("occ_head.predicter.0.bias (3,) for (96,)",)
        assert "1 missing (img_backbone.bn1.bias)" in report.summary()

    def test_code_is_refused(self, tmp_path):
        class Trap:
            def __reduce__(self):
                return (print, ("ran",))

        torch.save({"state_dict": {"x": Trap()}}, tmp_path / "evil.pth")
        with pytest.raises(UnsafeFileError, match="more than tensors"):
            load_public_checkpoint(FlashOcc(TINY), tmp_path / "evil.pth")

    def test_corrupt_and_foreign_files(self, tmp_path):
        (tmp_path / "junk.pth").write_bytes(b"junk")
        with pytest.raises((ModelError, UnsafeFileError)):
            load_public_checkpoint(FlashOcc(TINY), tmp_path / "junk.pth")
        torch.save({"other": torch.zeros(1)}, tmp_path / "other.pth")
        with pytest.raises(ModelError, match="nothing in the checkpoint fits"):
            load_public_checkpoint(FlashOcc(TINY), tmp_path / "other.pth")

    def test_memory_takes_a_baselines_weights_and_its_own(self, tmp_path, frame):
        base = load_network("flashocc-tiny")
        self.save(tmp_path / "base.pth", base.module)
        net = load_network("flashocc-tiny", tmp_path / "base.pth", memory=True)
        np.testing.assert_array_equal(net.predict(frame), base.predict(frame))
        self.save(tmp_path / "memory.pth", net.module)
        again = load_network("flashocc-tiny", tmp_path / "memory.pth", memory=True)
        assert again.report is not None
        assert again.report.complete
        assert isinstance(again.module, Lmop)


def test_refusals(frame):
    with pytest.raises(ConfigError, match="network is not known"):
        load_network("flashocc-m9")
    with pytest.raises(DataError, match="has no views"):
        load_network("flashocc-tiny").predict(SimpleFrame(frame, ()))
