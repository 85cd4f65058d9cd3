"""Train a baseline: AdamW, warm-up, moving average of the weights, resumable to the bit."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from openvocab_occ.errors import ConfigError, DataError, ModelError
from openvocab_occ.io.files import PathLike
from openvocab_occ.networks.dhd import Dhd
from openvocab_occ.networks.flashocc import FlashOcc
from openvocab_occ.networks.lift_splat import Rig
from openvocab_occ.networks.losses import geometric_scal, height_loss, masked_cross_entropy, semantic_scal
from openvocab_occ.networks.predictor import OccupancyNetwork, normalise
from openvocab_occ.training.drives import Drive
from openvocab_occ.training.heights import height_bins
from openvocab_occ.training.journal import RunJournal, load_checkpoint, save_checkpoint

Advance = Callable[[int, int], None]
LAST, FINAL = "last.pt", "weights.pt"


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How a network is trained."""

    steps: int = 1500
    batch: int = 4
    rate: float = 2e-3
    decay: float = 1e-2
    """Weight decay of AdamW."""
    warm_up: int = 50
    """Steps in which the rate grows linearly."""
    schedule: Literal["cosine", "constant"] = "cosine"
    """After the warm-up; the published networks keep it constant."""
    clip: float = 5.0
    """Largest norm of the gradient."""
    ema: float = 0.99
    """Of the weights that are kept; shorter at the beginning. 0 keeps the last ones."""
    loss: Literal["flashocc", "dhd"] = "flashocc"
    """Masked cross entropy, or 10 of it, 0.2 of each scene-class affinity, and with a Dhd 0.1 of its height's loss."""
    amp: bool = True
    """Work in bfloat16 where that loses little."""
    flip: bool = True
    """Mirror half of the batches in x and half in y (the ground's augmentation; never with memory)."""
    seed: int = 0
    save_every: int = 100

    def __post_init__(self) -> None:
        if min(self.steps, self.batch, self.save_every) < 1 or self.rate <= 0 or not 0 <= self.ema < 1:
            raise ConfigError(
                "training cannot be done", expected="steps, batch and rate above 0, 0 <= ema < 1", got=self
            )


def train_baseline(
    network: OccupancyNetwork,
    drives: Sequence[Drive],
    folder: PathLike,
    config: TrainConfig | None = None,
    *,
    progress: Advance | None = None,
) -> Path:
    """Train all weights of a baseline on drives; return the file of its weights.

    Stopped, the same call goes on from `last.pt` and ends with the same weights. Each step's samples follow from the
    seed and the step alone.

    Raises:
        DataError: There are no drives, or the loss is no number.
        ModelError: A checkpoint is damaged or of another run, or the memory does not suffice.
    """
    config = config or TrainConfig()
    module = network.module
    if not isinstance(module, FlashOcc):
        raise ConfigError("a memory is trained around a trained baseline", fix="use training.memory.train_memory")
    frames = [(drive, f) for drive in drives for f in range(len(drive))]
    if not frames:
        raise DataError("there is nothing to train on", expected="drives with frames")
    weights = class_weights(drives, network.config.classes)
    optimiser = torch.optim.AdamW(module.parameters(), lr=config.rate, weight_decay=config.decay)
    run = Run(Path(folder), module, optimiser, {"network": network.name, **asdict(config)})
    device = next(module.parameters()).device
    module.train().to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    for step in range(run.step, config.steps):
        rng = np.random.default_rng([config.seed, step])
        chosen = [frames[i] for i in rng.choice(len(frames), config.batch, replace=len(frames) < config.batch)]
        flips = rng.random(2) < 0.5 if config.flip else np.zeros(2, np.bool_)
        images, rig, labels, mask = batch_of(chosen, flips)
        with told_of_memory(network.name, device), torch.autocast(device.type, torch.bfloat16, enabled=config.amp):
            height: Tensor | float = 0.0
            if isinstance(module, Dhd) and config.loss == "dhd":
                latent, told = module.latent_and_height(images.to(device), rig.to(device))
                logits = module.occ_head(latent).float()
                bins = np.stack([height_bins(d, f, network.config, (told.shape[3], told.shape[4])) for d, f in chosen])
                height = 0.1 * height_loss(told, torch.from_numpy(bins).to(device))
            else:
                logits = module(images.to(device), rig.to(device)).float()
            loss = height + loss_of(logits, labels.to(device), mask.to(device), config.loss, weights.to(device))
            run.learn(loss, rate_at(step, config), config.clip, config.ema)
        if run.step % config.save_every == 0 or run.step == config.steps:
            run.save()
        if progress is not None:
            progress(run.step, config.steps)
    return run.finish(cameras=int(drives[0].images.shape[1]))


class Run:
    """State of a training: module, optimiser, moving average, step; in a folder."""

    def __init__(
        self, folder: Path, module: nn.Module, optimiser: torch.optim.Optimizer, settings: dict[str, Any]
    ) -> None:
        self.folder, self.module, self.optimiser = folder, module, optimiser
        self.settings = {key: value for key, value in settings.items() if key not in ("steps", "save_every")}
        self.settings["steps"] = settings.get("steps")
        self.step = 0
        self.average = {n: v.detach().clone() for n, v in module.state_dict().items()}
        last = folder / LAST
        if last.exists():
            state = load_checkpoint(last)
            if state["settings"] != self.settings:
                raise ModelError(f"{last} is of another run", expected=self.settings, got=state["settings"],
                                 fix="choose a new folder, or remove it")  # fmt: skip
            module.load_state_dict(state["module"])
            optimiser.load_state_dict(state["optimiser"])
            self.average, self.step = state["average"], state["step"]
        self.journal = RunJournal(folder, resume_from=self.step)

    def learn(self, loss: Float[Tensor, ""], rate: float, clip: float, ema: float) -> None:
        """Take one step down the gradient."""
        value = float(loss.detach())
        if not math.isfinite(value):
            raise DataError(f"the loss is no number at step {self.step}", expected="a finite loss", got=value,
                            fix="look at the images and labels, or lower the rate")  # fmt: skip
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        learned = [p for p in self.module.parameters() if p.grad is not None]
        norm = float(nn.utils.clip_grad_norm_(learned, clip))
        self.optimiser.step()
        self.step += 1
        keep = min(ema, self.step / (self.step + 9))
        with torch.no_grad():
            for name, now in self.module.state_dict().items():
                if now.is_floating_point() and keep > 0:
                    self.average[name].lerp_(now.to(self.average[name].device), 1 - keep)
                else:
                    self.average[name].copy_(now)
        self.journal.add(self.step - 1, loss=round(value, 5), rate=rate, gradient=round(norm, 4))

    def save(self) -> None:
        """Keep all that is needed to go on."""
        save_checkpoint(self.folder / LAST, {
            "settings": self.settings, "module": self.module.state_dict(), "optimiser": self.optimiser.state_dict(),
            "average": self.average, "step": self.step,
        })  # fmt: skip

    def finish(self, **facts: int) -> Path:
        """Take over the moving average, and write it as weights that `load_network` reads."""
        self.module.load_state_dict(self.average)
        self.module.eval()
        self.journal.close()
        path = self.folder / FINAL
        save_checkpoint(path, {"state_dict": self.average, "settings": self.settings, "step": self.step, **facts})
        return path


def batch_of(
    frames: Sequence[tuple[Drive, int]], flips: Bool[np.ndarray, " 2"] | None = None
) -> tuple[Float[Tensor, "b n 3 h w"], Rig, UInt8[Tensor, "b x y z"], Bool[Tensor, "b x y z"]]:
    """Return images, rig, labels and camera masks of frames, mirrored in x or y as asked."""
    images = normalise(np.stack([drive.images[f] for drive, f in frames]))
    K, T, move = (torch.from_numpy(np.stack([d.rigs[k][f] for d, f in frames])) for k in range(3))
    labels = np.stack([drive.labels[f] for drive, f in frames])
    mask = np.stack([drive.mask[f] for drive, f in frames])
    signs = torch.ones(3)
    for axis in range(2):
        if flips is not None and flips[axis]:
            signs[axis] = -1
            labels, mask = np.flip(labels, axis + 1), np.flip(mask, axis + 1)
    rig = Rig(K=K, T_ego_cam=T, T_net_image=move, T_bev_ego=torch.diag(signs).expand(len(frames), 3, 3))
    return images, rig, torch.from_numpy(labels.copy()), torch.from_numpy(mask.copy())


def loss_of(
    logits: Float[Tensor, "b x y z classes"],
    labels: UInt8[Tensor, "b x y z"],
    mask: Bool[Tensor, "b x y z"],
    kind: Literal["flashocc", "dhd"],
    weights: Float[Tensor, " classes"],
) -> Float[Tensor, ""]:
    """Return the loss of a baseline's logits; a Dhd's height has its own."""
    entropy = masked_cross_entropy(logits, labels.long(), mask, weights=weights)
    if kind == "flashocc":
        return entropy
    target = labels.long()
    return 10 * entropy + 0.2 * semantic_scal(logits, target, mask) + 0.2 * geometric_scal(logits, target, mask)


def class_weights(drives: Sequence[Drive], classes: int) -> Float[Tensor, " classes"]:
    """Return (share of a class among what cameras see, relative to the most frequent) to the power -0.2.

    Gentle: without weights a small network gives rare classes up, with inverse ones it paints them everywhere.
    """
    counts = np.zeros(classes, np.int64)
    for drive in drives:
        for f in range(0, len(drive), 4):
            counts += np.bincount(drive.labels[f][drive.mask[f]], minlength=classes)
    share = counts / max(int(counts.max()), 1)
    weights = np.where(counts > 0, np.clip(share, 1e-5, 1) ** -0.2, 1.0)
    return torch.from_numpy(weights.astype(np.float32))


def rate_at(step: int, config: TrainConfig) -> float:
    """Return the learning rate of a step."""
    grown = min(1.0, (step + 1) / max(config.warm_up, 1))
    if config.schedule == "constant":
        return config.rate * grown
    done = max(0.0, (step - config.warm_up) / max(config.steps - config.warm_up, 1))
    return config.rate * grown * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * done)))


@contextmanager
def told_of_memory(name: str, device: torch.device) -> Iterator[None]:
    """Turn running out of memory into an error that says what to do."""
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError) as error:
        raise ModelError(f"training {name} does not fit into the memory of {device}", got=str(error).splitlines()[:1],
                         fix="a smaller batch or network") from error  # fmt: skip
    except RuntimeError as error:
        if "can't allocate memory" not in str(error):
            raise
        raise ModelError(f"training {name} does not fit into the memory of {device}", got=str(error).splitlines()[0],
                         fix="a smaller batch or network") from error  # fmt: skip
