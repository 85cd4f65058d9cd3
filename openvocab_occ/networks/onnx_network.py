"""Occupancy networks as ONNX: ours written, ours and foreign ones run."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor, nn

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.errors import ConfigError, DataError, ModelError, ShapeError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.io.files import PathLike, existing, written_file
from openvocab_occ.networks.flashocc import FlashOccConfig
from openvocab_occ.networks.fusion import CurrentPriorFusion
from openvocab_occ.networks.head import OccHead
from openvocab_occ.networks.lift_splat import Rig
from openvocab_occ.networks.lmop import Lmop, bev_of
from openvocab_occ.networks.predictor import OccupancyNetwork, Prior, fit_views, normalise

_KEY = "openvocab_occ"
_VIEWS = ("images", "K", "T_ego_cam", "T_net_image")
_MEMORY = ("prior", "known")


class _Plain(nn.Module):
    """A network whose inputs are tensors."""

    def __init__(self, network: OccupancyNetwork) -> None:
        super().__init__()
        self.module = network.module

    def forward(self, images: Tensor, K: Tensor, T_ego_cam: Tensor, T_net_image: Tensor, *memory: Tensor) -> Tensor:
        rig = Rig(K=K, T_ego_cam=T_ego_cam, T_net_image=T_net_image, T_bev_ego=torch.eye(3)[None])
        if isinstance(self.module, Lmop):
            return self.module.refine(self.module.baseline.latent(images, rig), *memory)
        return self.module(images, rig)


def export_onnx(network: OccupancyNetwork, path: PathLike, *, cameras: int = 6) -> Path:
    """Write a network as one ONNX file (opset 18) for a batch of one.

    Inputs are what `OccupancyNetwork.prepare` makes, `images`, `K`, `T_ego_cam` and `T_net_image`, and with memory
    `prior` and `known`; the output is `logits`. The grid stands in the metadata. Standard operators only.
    """
    config = network.config
    height, width = config.image_size
    # three tensors of their own: inputs that are one tensor would become one input
    eyes = [torch.eye(n).expand(1, cameras, n, n).clone() for n in (3, 4, 3)]
    inputs: list[Tensor] = [torch.randn(1, cameras, 3, height, width), *eyes]
    names = [*_VIEWS]
    if isinstance(network.module, Lmop):
        inputs += [torch.zeros(1, *config.shape, config.classes), torch.ones(1, *config.shape, dtype=torch.bool)]
        names += [*_MEMORY]
    if any(p.device.type != "cpu" for p in network.module.parameters()):
        raise ConfigError("export is done on the CPU", fix="load_network(..., device='cpu')")
    program = torch.onnx.export(
        _Plain(network).eval(), tuple(inputs), input_names=names, output_names=["logits"], dynamo=True, verbose=False
    )
    if program is None:
        raise ModelError(f"{network.name} could not be exported", fix="install onnxscript")
    model = program.model_proto
    entry = model.metadata_props.add()
    entry.key = _KEY
    entry.value = json.dumps({
        "network": network.name, "image_size": [height, width], "lower": list(config.lower), "cell": config.cell,
        "shape": list(config.shape), "classes": config.classes,
    })  # fmt: skip
    with written_file(path) as scratch:
        scratch.write_bytes(model.SerializeToString())
    return Path(path)


class OnnxNetwork:
    """An ONNX file in the place of an `OccupancyNetwork`: frames in, logits out."""

    def __init__(self, path: PathLike, config: FlashOccConfig | None = None) -> None:
        """Open a file of `export_onnx`, or with `config` a foreign one with the same inputs and output.

        Raises:
            ModelError: It is no model, has other inputs, or does not say its grid.
        """
        import onnxruntime

        self.path = existing(path, "model")
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4
        try:
            self._session = onnxruntime.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise ModelError(f"{self.path.name} is not an ONNX model", got=str(error).splitlines()[0][:160]) from error
        self.name = self.path.stem
        inputs = {node.name for node in self._session.get_inputs()}
        if "images" not in inputs or not inputs <= {*_VIEWS, *_MEMORY}:
            raise ModelError(f"{self.path.name} has other inputs", expected=", ".join((*_VIEWS, *_MEMORY)),
                             got=", ".join(sorted(inputs)), fix="rename them, or write files of logits")  # fmt: skip
        self._inputs = inputs
        self.memory = "prior" in inputs
        self.config = config or self._config()

    @property
    def spec(self) -> GridSpec:
        """The grid of its logits, in the ego frame."""
        return GridSpec(self.config.lower, self.config.cell, self.config.shape)

    def predict(self, frame: Frame, prior: Prior | None = None) -> Float32[np.ndarray, "x y z classes"]:
        """Return logits of every voxel; as `OccupancyNetwork.predict`."""
        if prior is not None and not self.memory:
            raise ConfigError("this network has no memory", got="a prior", fix="export one that has")
        views = fit_views(frame, self.config)
        shape = (*self.config.shape, self.config.classes)
        feed: dict[str, Any] = {
            "images": normalise(views.images[None]).numpy(), "K": views.K[None], "T_ego_cam": views.T_ego_cam[None],
            "T_net_image": views.T_net_image[None],
        }  # fmt: skip
        if self.memory:
            logits = np.zeros(shape, np.float32) if prior is None else prior.logits
            if logits.shape != shape:
                raise ShapeError("prior does not fit the network", expected=shape, got=logits.shape,
                                 fix="read it with the network's spec, from a map of the same classes")  # fmt: skip
            feed["prior"] = logits[None]
            feed["known"] = np.zeros((1, *shape[:3]), np.bool_) if prior is None else prior.known[None]
        try:
            found = self._session.run(None, {name: value for name, value in feed.items() if name in self._inputs})[0]
        except Exception as error:
            raise DataError(f"{self.path.name} cannot take frame {frame.index}", got=str(error).splitlines()[0][:200],
                            fix="give as many views as it was exported for") from error  # fmt: skip
        out = np.asarray(found, np.float32)
        if out.shape != (1, *shape):
            raise ShapeError(f"{self.path.name} gives no logits of its grid", expected=(1, *shape), got=out.shape)
        if not np.isfinite(out).all():
            raise ModelError(f"{self.path.name} gives no numbers for frame {frame.index}", expected="finite logits",
                             fix="look at the model, and at K and poses of the cameras")  # fmt: skip
        return out[0]

    def _config(self) -> FlashOccConfig:
        told = self._session.get_modelmeta().custom_metadata_map.get(_KEY)
        if told is None:
            raise ModelError(f"{self.path.name} does not say its grid", expected="metadata of export_onnx",
                             fix="pass config=FlashOccConfig(lower=..., cell=..., shape=...)")  # fmt: skip
        facts = json.loads(told)
        return FlashOccConfig(
            image_size=tuple(facts["image_size"]), lower=tuple(facts["lower"]), cell=facts["cell"],
            shape=tuple(facts["shape"]), classes=facts["classes"],
        )  # fmt: skip


class LogitMemory(nn.Module):
    """Memory around a model of which only the logits are known: an ONNX file, or files of predictions.

    The logits take the place of the latent feature. What memory has to say is added to them, and nothing where it knows
    nothing: with an empty prior the foreign model's own logits come out, bit for bit.
    """

    def __init__(self, config: FlashOccConfig, *, width: int = 48) -> None:
        super().__init__()
        self.config = config
        self.stem, self.align = (self._reader(config, width) for _ in range(2))
        self.fusion = CurrentPriorFusion(width, "cp")
        self.correction = OccHead(width, heights=config.shape[2], classes=config.classes)
        last = self.correction.predicter[-1]
        for parameter in last.parameters():
            nn.init.zeros_(parameter)  # begins as the foreign model

    def forward(
        self, logits: Float[Tensor, "b x y z classes"], prior: Float[Tensor, "b x2 y2 z2 classes2"],
        known: Bool[Tensor, "b x2 y2 z2"],
    ) -> Float[Tensor, "b x y z classes"]:  # fmt: skip
        """Return refined logits."""
        if prior.shape != logits.shape:
            raise ShapeError("prior does not fit the logits", expected=tuple(logits.shape), got=tuple(prior.shape),
                             fix="read it with the grid and classes of the logits")  # fmt: skip
        centred = logits - logits.mean(dim=-1, keepdim=True)
        fused = self.fusion(self.stem(bev_of(centred)), self.align(bev_of(prior)))
        return torch.where(known.any(dim=3)[..., None, None], logits + self.correction(fused), logits)

    @staticmethod
    def _reader(config: FlashOccConfig, width: int) -> nn.Sequential:
        return nn.Sequential(
            nn.Conv2d(config.shape[2] * config.classes, width, 1), nn.ReLU(), nn.Conv2d(width, width, 3, padding=1)
        )
