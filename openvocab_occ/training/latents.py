"""Latent features of a frozen baseline, computed once and kept in files: most of the cost of training a memory."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from openvocab_occ.io.files import PathLike, written_file
from openvocab_occ.networks.flashocc import FlashOcc
from openvocab_occ.training.drives import Drive
from openvocab_occ.training.loop import batch_of

Advance = Callable[[int, int], None]


class Latents:
    """bfloat16 features by drive, mapped from files rather than read."""

    def __init__(self, found: Mapping[str, np.ndarray]) -> None:
        self._found = found

    def of(self, frames: Sequence[tuple[Drive, int]]) -> Float[Tensor, "b c y x"]:
        """Return the features of frames, channels last."""
        rows = np.stack([self._found[drive.info.name][f] for drive, f in frames])
        return torch.from_numpy(rows).view(torch.bfloat16).permute(0, 3, 1, 2)


def cache_latents(
    baseline: FlashOcc, drives: Sequence[Drive], folder: PathLike, *, batch: int = 8, progress: Advance | None = None
) -> Latents:
    """Run a baseline over drives, where that has not been done with these very weights."""
    home = Path(folder) / fingerprint(baseline)
    home.mkdir(parents=True, exist_ok=True)
    baseline.eval()
    device = next(baseline.parameters()).device
    found: dict[str, np.ndarray] = {}
    for done, drive in enumerate(drives):
        path = home / f"{drive.info.name}.npy"
        if not path.exists():
            rows: list[np.ndarray] = []
            for start in range(0, len(drive), batch):
                frames = [(drive, f) for f in range(start, min(start + batch, len(drive)))]
                images, rig, _, _ = batch_of(frames)
                with torch.no_grad(), torch.autocast(device.type, torch.bfloat16):
                    latent = baseline.latent(images.to(device), rig.to(device))
                flat = latent.permute(0, 2, 3, 1).to(torch.bfloat16).contiguous().cpu()
                rows.append(flat.view(torch.uint16).numpy())
            with written_file(path) as scratch, scratch.open("wb") as stream:
                np.save(stream, np.concatenate(rows))
        found[drive.info.name] = np.load(path, mmap_mode="r")
        if progress is not None:
            progress(done + 1, len(drives))
    return Latents(found)


def fingerprint(module: torch.nn.Module) -> str:
    """Return 16 hex digits that tell weights apart."""
    digest = hashlib.sha256()
    for name, value in module.state_dict().items():
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().float().numpy().tobytes())
    return digest.hexdigest()[:16]
