"""Drives to learn from, by the name of their source."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from openvocab_occ.datasets.frame import Frame, FrameSequence
from openvocab_occ.errors import ConfigError
from openvocab_occ.io.files import PathLike
from openvocab_occ.networks.flashocc import FlashOccConfig
from openvocab_occ.occupancy import read_occ3d_masks
from openvocab_occ.training.drives import Advance, Drive, DriveInfo, write_drive
from openvocab_occ.training.samples import CameraMasks, network_spec

_CONDITIONS = ("night", "rain")  # words of nuScenes' descriptions; the first that is found counts


def drives_of(
    sequences: Sequence[Callable[[], FrameSequence]],
    config: FlashOccConfig,
    folder: PathLike,
    *,
    masks: str | None = None,
    progress: Advance | None = None,
) -> list[Drive]:
    """Make samples of drives in a folder, where they are not there yet; stopped, it goes on where it was.

    Args:
        sequences: Each opens a drive.
        config: Of the network that learns from them.
        folder: Where they are kept.
        masks: Files with a camera mask, such as `gts/{scene}/{token}/labels.npz`; by default masks are computed.
        progress: Told of drives.
    """
    found: list[Drive] = []
    for done, load in enumerate(sequences):
        sequence = load()
        info = describe(sequence)
        path = Path(folder) / f"{info.name}.npz"
        if not path.exists():
            write_drive(path, sequence, info, config, masks=None if masks is None else published(masks, sequence.name))
        found.append(Drive(path, network_spec(config)))
        if progress is not None:
            progress(done + 1, len(sequences))
    return found


def describe(sequence: FrameSequence) -> DriveInfo:
    """Return what a source says of a drive; a drive of unknown place is a place, and a log, of its own."""
    info = sequence.info
    text = info.get("description", "").lower()
    return DriveInfo(
        name=sequence.name.replace("/", "-"), place=info.get("location", sequence.name),
        log=info.get("log", sequence.name), scene=sequence.name,
        condition=next((word for word in _CONDITIONS if word in text), "clear") if text else "",
        synthetic=sequence.synthetic,
    )  # fmt: skip


def published(pattern: str, scene: str) -> CameraMasks:
    """Return what reads a frame's published camera mask."""
    try:
        pattern.format(scene=scene, token="", index=0)
    except (KeyError, IndexError, ValueError) as error:
        raise ConfigError(
            "pattern of masks cannot be read", expected="{scene}, {token} and {index}", got=pattern
        ) from error

    def read(frame: Frame) -> Bool[np.ndarray, "x y z"]:
        return read_occ3d_masks(pattern.format(scene=scene, token=frame.token, index=frame.index)).camera

    return read
