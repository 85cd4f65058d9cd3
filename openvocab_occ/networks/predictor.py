"""Networks by name, and frames to logits."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.errors import ConfigError, DataError, ModelError, ShapeError
from openvocab_occ.geometry import GridSpec, invert
from openvocab_occ.io.files import PathLike
from openvocab_occ.networks.checkpoint import LoadReport, fill, read_checkpoint
from openvocab_occ.networks.dhd import DHD_S, Dhd
from openvocab_occ.networks.flashocc import M0, M1, MICRO, TINY, FlashOcc, FlashOccConfig
from openvocab_occ.networks.fusion import FusionKind
from openvocab_occ.networks.lift_splat import Rig
from openvocab_occ.networks.lmop import Lmop

NETWORKS: dict[str, tuple[type[FlashOcc], FlashOccConfig]] = {
    "flashocc-m0": (FlashOcc, M0),
    "flashocc-m1": (FlashOcc, M1),
    "dhd-s": (Dhd, DHD_S),
    "flashocc-tiny": (FlashOcc, TINY),
    "flashocc-micro": (FlashOcc, MICRO),
    "dhd-tiny": (Dhd, TINY),
}
CAMERA_ORDER = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT")
"""The order public networks were trained with; views of other names follow in their own order."""
_MEAN, _STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)


@runtime_checkable
class Prior(Protocol):
    """What memory knows of a window; the record that a tile map's `read` returns."""

    @property
    def logits(self) -> Float32[np.ndarray, "x y z classes"]:
        """Class-centred log-probabilities, 0 where not known."""
        ...

    @property
    def known(self) -> Bool[np.ndarray, "x y z"]:
        """Which voxels the map has seen."""
        ...


def load_network(
    name: str,
    weights: PathLike | None = None,
    *,
    memory: bool = False,
    fusion: FusionKind = "cp",
    device: str = "cpu",
    public_quirks: bool = False,
) -> "OccupancyNetwork":
    """Open an occupancy network by name.

    Args:
        name: `flashocc-m0`, `flashocc-m1`, `dhd-s` (256 x 704 images, 0.4 m voxels of Occ3D), `flashocc-tiny` or
            `dhd-tiny` (48 x 128, 0.8 m), `flashocc-micro` (those within 20 m).
        weights: A checkpoint of ours or a public one; without it the weights are random and its predictions noise.
        memory: Wrap it with a memory prior (LMPOcc).
        fusion: How prior and current feature are fused.
        device: Where it runs.
        public_quirks: Reproduce what public weights were trained with: points truncated into cell 0, BGR planes with
            RGB statistics, the ego at the time of CAM_FRONT_LEFT.
    """
    if name not in NETWORKS:
        raise ConfigError("network is not known", expected=", ".join(NETWORKS), got=repr(name))
    kind, config = NETWORKS[name]
    if public_quirks:
        config = replace(config, public_quirks=True)
    baseline = kind(config)
    network = Lmop(baseline, fusion=fusion) if memory else baseline
    report, cameras = None, None
    if weights is not None:
        content = read_checkpoint(weights)
        whole = any(name.startswith("fusion.") for name in content.state)
        report = fill(network if not memory or whole else baseline, content.state)
        cameras = content.cameras
        if isinstance(network, Lmop) and not whole:
            network.occ_head.load_state_dict(baseline.occ_head.state_dict())
    return OccupancyNetwork(name, network.to(device).eval(), config, report, cameras)


def has_memory(weights: PathLike) -> bool:
    """Tell whether a checkpoint is of a network with memory."""
    return any(name.startswith("fusion.") for name in read_checkpoint(weights).state)


class OccupancyNetwork:
    """A network with what surrounds it: image preparation, device, and the grid it predicts."""

    def __init__(
        self,
        name: str,
        module: FlashOcc | Lmop,
        config: FlashOccConfig,
        report: LoadReport | None = None,
        cameras: int | None = None,
    ) -> None:
        self.name = name
        self.module = module
        self.config = config
        self.report = report
        """How the checkpoint's names met the network's; None without one."""
        self.cameras = cameras
        """Views that it was trained with, where the checkpoint says so."""

    @property
    def memory(self) -> bool:
        """Whether it reads a prior."""
        return isinstance(self.module, Lmop)

    @property
    def spec(self) -> GridSpec:
        """The grid of its logits, in the ego frame."""
        return GridSpec(self.config.lower, self.config.cell, self.config.shape)

    @torch.no_grad()
    def predict(self, frame: Frame, prior: Prior | None = None) -> Float32[np.ndarray, "x y z classes"]:
        """Return logits of every voxel around the ego.

        Args:
            frame: At least one view; the network was trained with six.
            prior: Window of a tile map read at `frame.T_world_ego` with `spec`; needs `memory=True`. None is empty.
        """
        device = next(self.module.parameters()).device
        images, rig = self.prepare(frame)
        try:
            if isinstance(self.module, Lmop):
                logits = self.module(images.to(device), rig.to(device), *self._prior(prior, device))
            elif prior is not None:
                raise ConfigError("this network has no memory", got="a prior", fix="load_network(..., memory=True)")
            else:
                logits = self.module(images.to(device), rig.to(device))
        except (
            MemoryError,
            RuntimeError,
        ) as error:  # torch's own, of a GPU, is a RuntimeError; of a CPU it has no type
            full = isinstance(error, (MemoryError, torch.OutOfMemoryError)) or "can't allocate memory" in str(error)
            if not full:
                raise
            raise ModelError(f"{self.name} does not fit into the memory of {device}", got=str(error).partition("\n")[0],
                             fix="choose a smaller network or device='cpu'") from error  # fmt: skip
        found = logits[0].float().cpu().numpy()
        if not np.isfinite(found).all():
            raise ModelError(f"{self.name} gives no numbers for frame {frame.index}", expected="finite logits",
                             fix="look at the weights, and at K and poses of the cameras")  # fmt: skip
        return found

    def prepare(self, frame: Frame) -> tuple[Float[Tensor, "1 n 3 h w"], Rig]:
        """Return normalised images and their rig, as `predict` feeds them."""
        views = fit_views(frame, self.config)
        return normalise(views.images[None]), views.rig()

    def _prior(self, prior: Prior | None, device: torch.device) -> tuple[Tensor, Tensor]:
        shape = (*self.config.shape, self.config.classes)
        if prior is None:
            return torch.zeros(1, *shape, device=device), torch.zeros(1, *shape[:3], dtype=torch.bool, device=device)
        if prior.logits.shape != shape:
            raise ShapeError("prior does not fit the network", expected=shape, got=prior.logits.shape,
                             fix="read it with the network's spec, from a map of the same classes")  # fmt: skip
        logits = torch.from_numpy(np.ascontiguousarray(prior.logits, dtype=np.float32))[None]
        return logits.to(device), torch.from_numpy(np.ascontiguousarray(prior.known, dtype=bool))[None].to(device)


@dataclass(frozen=True, eq=False)
class FittedViews:
    """Views of a frame as a network takes them, before their colours are normalised."""

    images: UInt8[np.ndarray, "n h w 3"]
    K: Float32[np.ndarray, "n 3 3"]
    """Of the original images."""
    T_ego_cam: Float32[np.ndarray, "n 4 4"]
    T_net_image: Float32[np.ndarray, "n 3 3"]
    """Pixel of the original image to pixel here."""

    def rig(self) -> Rig:
        """Return a batch of one rig."""
        K, T, move = (torch.from_numpy(a)[None] for a in (self.K, self.T_ego_cam, self.T_net_image))
        return Rig(K=K, T_ego_cam=T, T_net_image=move, T_bev_ego=torch.eye(3)[None])


def fit_views(frame: Frame, config: FlashOccConfig) -> FittedViews:
    """Order, scale and crop the views of a frame to a network's input.

    Raises:
        DataError: There are none, or one is distorted.
    """
    if not frame.views:
        raise DataError(f"frame {frame.index} has no views", expected="one image a camera")
    order = {camera: k for k, camera in enumerate(CAMERA_ORDER)}
    views = sorted(frame.views, key=lambda view: order.get(view.name, len(order)))
    key = frame.T_world_ego
    if config.public_quirks:
        key = frame.poses.get("cam_front_left_ego", key)
    for view in views:
        if view.camera.lens != "pinhole":
            raise DataError(f"view {view.name!r} is distorted", expected="a pinhole camera", fix="undistort it first")
    fitted = [fit_image(view.image, config.image_size) for view in views]
    T_ego_cam = [invert(key) @ view.camera.T_world_cam for view in views]
    return FittedViews(
        np.stack([image for image, _ in fitted]), _stack([view.camera.K for view in views]), _stack(T_ego_cam),
        _stack([move for _, move in fitted]),
    )  # fmt: skip


def normalise(images: UInt8[np.ndarray, "b n h w 3"]) -> Float[Tensor, "b n 3 h w"]:
    """Return RGB images about the mean, in standard deviations (ImageNet's)."""
    planes = (images.astype(np.float32) - np.array(_MEAN, np.float32)) / np.array(_STD, np.float32)
    return torch.from_numpy(planes).permute(0, 1, 4, 2, 3).contiguous()


def fit_image(
    image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]
) -> tuple[UInt8[np.ndarray, "h2 w2 3"], Float[np.ndarray, "3 3"]]:
    """Scale an image to cover (height, width), keep its bottom and its middle; return it and the pixels' motion."""
    import cv2

    height, width = image.shape[:2]
    scale = max(size[0] / height, size[1] / width)
    scaled = (max(size[1], round(width * scale)), max(size[0], round(height * scale)))
    left, top = (scaled[0] - size[1]) // 2, scaled[1] - size[0]
    small = cv2.resize(image, scaled, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR_EXACT)
    sx, sy = scaled[0] / width, scaled[1] / height
    move = np.array([[sx, 0.0, (sx - 1) / 2 - left], [0.0, sy, (sy - 1) / 2 - top], [0.0, 0.0, 1.0]])
    return np.ascontiguousarray(small[top : top + size[0], left : left + size[1]]), move


def _stack(matrices: Sequence[np.ndarray]) -> Float32[np.ndarray, "n a b"]:
    return np.stack(matrices).astype(np.float32)
