"""Public checkpoints of FlashOcc, DHD and BEVDet, loaded without running any code of theirs."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from openvocab_occ.errors import ModelError, UnsafeFileError
from openvocab_occ.io.files import PathLike, existing

IGNORED = ("pts_bbox_head.",)
"""Parts of BEVDet's checkpoints that an occupancy network does not have."""


@dataclass(frozen=True)
class LoadReport:
    """What of a checkpoint met the network."""

    loaded: tuple[str, ...]
    missing: tuple[str, ...]
    """Names of the network that the checkpoint does not have; they keep their values."""
    unexpected: tuple[str, ...]
    """Names of the checkpoint that the network does not have."""
    misshapen: tuple[str, ...]
    """Names of both whose shapes differ, with the shapes."""

    @property
    def complete(self) -> bool:
        """Whether every name met its fellow."""
        return not (self.missing or self.unexpected or self.misshapen)

    def summary(self) -> str:
        """Say it in one line."""
        odd = {"missing": self.missing, "unexpected": self.unexpected, "of another shape": self.misshapen}
        parts = [
            f"{len(names)} {what} ({', '.join(names[:3])}{', ...' if len(names) > 3 else ''})"
            for what, names in odd.items()
            if names
        ]
        return f"{len(self.loaded)} loaded" + "".join(f", {part}" for part in parts)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Tensors by name, and what else a file of ours says."""

    state: dict[str, Tensor]
    cameras: int | None = None
    """Views that it was trained with."""


def load_public_checkpoint(network: nn.Module, path: PathLike) -> LoadReport:
    """Fill a network from a file with `state_dict` or plain tensors; report every name that does not match.

    mmcv's files, and those of its EMA hook, are read. Tensors only: nothing is unpickled that could run.

    Raises:
        UnsafeFileError: The file holds more than tensors and plain containers.
        ModelError: It cannot be read, or nothing in it fits.
    """
    return fill(network, read_checkpoint(path).state)


def read_checkpoint(path: PathLike) -> Checkpoint:
    """Read the tensors of a checkpoint by their plain names; errors as of `load_public_checkpoint`."""
    file = existing(path, "checkpoint")
    try:
        content: Any = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:
        text = str(error)
        if "Weights only load failed" in text or "Unsupported global" in text:
            raise UnsafeFileError(
                f"{file.name} holds more than tensors", got=text.splitlines()[0][:200],
                fix="open it where you trust it and save its state_dict alone",
            ) from error  # fmt: skip
        raise ModelError(f"{file.name} is not a checkpoint", expected="a file of torch.save", got=text[:200]) from error
    state = content.get("state_dict", content) if isinstance(content, dict) else content
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise ModelError(f"{file.name} has no state dict", expected="names and tensors", got=type(state).__name__)
    found = {_plain(name): value for name, value in state.items() if not _plain(name).startswith(IGNORED)}
    cameras = content.get("cameras") if isinstance(content, dict) else None
    return Checkpoint(found, cameras if isinstance(cameras, int) else None)


def fill(network: nn.Module, found: dict[str, Tensor]) -> LoadReport:
    """Copy tensors into a network by name, and report; nothing is copied where nothing fits."""
    own = network.state_dict()
    fits = {name: value for name, value in found.items() if name in own and own[name].shape == value.shape}
    wrong = [n for n in found if n in own and n not in fits]
    counters = {n for n in own if n.endswith("num_batches_tracked")}  # older files lack them, and they do not matter
    report = LoadReport(
        loaded=tuple(fits),
        missing=tuple(n for n in own if n not in found and n not in counters),
        unexpected=tuple(n for n in found if n not in own),
        misshapen=tuple(f"{n} {tuple(found[n].shape)} for {tuple(own[n].shape)}" for n in wrong),
    )
    if not fits:
        raise ModelError(
            "nothing in the checkpoint fits the network",
            expected=f"names such as {next(iter(own))}",
            got=", ".join(list(found)[:3]) or "no tensors",
            fix="choose the network it was saved from",
        )
    network.load_state_dict({**own, **fits})
    return report


def _plain(name: str) -> str:
    return name.removeprefix("module.").removeprefix("ema_")
