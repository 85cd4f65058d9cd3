"""The whole examination: read some frames, run every check, estimate what a map will cost, draw what was seen."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from openvocab_occ.datasets.frame import Frame, FrameSequence
from openvocab_occ.depth.render import render_depth
from openvocab_occ.errors import OpenVocabOccError
from openvocab_occ.io.files import PathLike
from openvocab_occ.mapping import cover_grid, rows_from_depth, rows_from_grid
from openvocab_occ.pipeline.build import DEFAULT_VOXEL_SIZE, MAX_DEPTH, grid_of
from openvocab_occ.pipeline.doctor.cameras import check_intrinsics, check_rig
from openvocab_occ.pipeline.doctor.files import check_files, check_timestamps
from openvocab_occ.pipeline.doctor.finding import Finding, Level, worst
from openvocab_occ.pipeline.doctor.grids import check_grids
from openvocab_occ.pipeline.doctor.images import check_images
from openvocab_occ.pipeline.doctor.lidar import check_lidar
from openvocab_occ.pipeline.doctor.poses import check_depth, check_motion, check_sweeps
from openvocab_occ.pipeline.doctor.sample import Sample, take_sample

_CHECKS: Sequence[Callable[[Sample], list[Finding]]] = (
    check_timestamps, check_intrinsics, check_rig, check_lidar, check_depth, check_sweeps, check_images, check_grids,
)  # fmt: skip
DEFAULT_FRAMES = 8
"""Frames that are read; four pairs of neighbours."""
DENSE_DIM, LABEL_DIM = 768, 20
"""Numbers a voxel holds with dense features of a large model, and with scores of labels."""
_ESTIMATE_WIDTH = 400  # pixels; at 40 m they are still denser than voxels of 0.4 m
_VOXEL_BYTES = 32  # key, weights, colour and times of a voxel beside its features


@dataclass(frozen=True)
class Estimate:
    """What a map of the whole drive will cost, from the frames that were read."""

    frames: int
    images: int
    voxels: int
    voxel_size: float
    megabytes_labels: float
    """Of a map of label scores (20 numbers a voxel)."""
    megabytes_dense: float
    """Of a map of dense features (768 numbers a voxel)."""
    read_seconds: float
    """To read and to find what each pixel sees; the 2D model comes on top, once an image."""


@dataclass(frozen=True)
class Diagnosis:
    """What the doctor found."""

    name: str
    source: str
    findings: Sequence[Finding]
    estimate: Estimate | None
    sample: Sample
    """The frames that were looked at."""

    @property
    def level(self) -> Level:
        """The worst of the findings."""
        return worst(self.findings)

    @property
    def clean(self) -> bool:
        """True when nothing is likely wrong: no warning and no error."""
        return self.level in ("ok", "note")

    def to_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        estimate = None
        if self.estimate is not None:
            estimate = {name: getattr(self.estimate, name) for name in Estimate.__dataclass_fields__}
        return {
            "name": self.name,
            "source": self.source,
            "frames": self.sample.total,
            "level": self.level,
            "clean": self.clean,
            "findings": [finding.to_dict() for finding in self.findings],
            "estimate": estimate,
        }

    def pictures(self) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
        """Draw what was measured over the images, and the drive from above; by file name."""
        from openvocab_occ.pipeline.doctor.pictures import draw

        return draw(self.sample)

    def write_report(self, folder: PathLike) -> None:
        """Write `index.html` and its pictures."""
        from openvocab_occ.pipeline.doctor.report import write

        write(self, folder)


def examine(
    sequence: FrameSequence, *, frames: int = DEFAULT_FRAMES, progress: Callable[[int, int], object] | None = None
) -> Diagnosis:
    """Look at a drive and say what is wrong with it. Nothing is raised for bad data: that is what findings are for.

    Args:
        sequence: The drive.
        frames: How many frames are read, in pairs of neighbours.
        progress: Called with the number of frames read and their total.
    """
    started = time.perf_counter()
    sample = take_sample(sequence, max(frames, 2), progress)
    read = time.perf_counter() - started
    findings = check_files(sequence, sample)
    if sample.frames:
        findings += check_motion(sample, sequence.source)
        for check in _CHECKS:
            findings += check(sample)
        findings += _geometry(sample)
    estimate = _estimate(sample, read)
    return Diagnosis(sequence.name, sequence.source, findings, estimate, sample)


def _geometry(sample: Sample) -> list[Finding]:
    """A map needs depth: measured, or from a grid, or from a LiDAR."""
    for frame in sample.frames:
        if not frame.views:
            continue
        if (
            all(view.depth is not None for view in frame.views)
            or frame.occupancy is not None
            or frame.points is not None
        ):
            return []
        return [
            Finding(
                "note",
                "geometry",
                "frames say nothing of where things are",
                "a map needs grids, LiDAR or depth",
                "pass --occupancy PATTERN with the predictions of an occupancy network",
            )
        ]
    return [Finding("warning", "files", "frames have no images", "a map is made of images")]


def _estimate(sample: Sample, read: float) -> Estimate | None:
    """Count the voxels of one pair of neighbours, and carry on: each frame adds what the second one added."""
    frames = [frame for frame in sample.frames if frame.views]
    if not frames:
        return None
    first, second = next(iter(sample.pairs), (frames[0], None))
    started = time.perf_counter()
    try:
        one, size = _voxels(first, None)
        spent = time.perf_counter() - started
        new = len(_voxels(second, size)[0] - one) if second is not None and second.views else 0
    except OpenVocabOccError:
        return None  # a finding says why
    count = len(one) + new * (sample.total - 1)
    each = read / max(len(sample.frames), 1) + spent
    return Estimate(
        sample.total,
        sample.total * len(first.views),
        count,
        size,
        round(count * (_VOXEL_BYTES + 4 * LABEL_DIM) / 1e6, 1),
        round(count * (_VOXEL_BYTES + 4 * DENSE_DIM) / 1e6, 1),
        round(each * sample.total, 1),
    )


def _voxels(frame: Frame, size: float | None) -> tuple[set[bytes], float]:
    """Return the map voxels that a frame sees, and their edge."""
    grid = None if all(view.depth is not None for view in frame.views) else grid_of(frame)
    size = size or (DEFAULT_VOXEL_SIZE if grid is None else float(grid.spec.size[0]))
    found: set[bytes] = set()
    for view in frame.views:
        if view.depth is not None:
            keys = rows_from_depth(view.depth, view.camera, size, max_depth=MAX_DEPTH)[1]
        else:
            assert grid is not None
            width = min(view.camera.width, _ESTIMATE_WIDTH)
            camera = view.camera.resized(width, max(1, round(view.camera.height * width / view.camera.width)))
            flat = rows_from_grid(render_depth(grid, camera, max_depth=MAX_DEPTH), grid)[1]
            keys = cover_grid(flat, grid, size).keys
        found.update(key.tobytes() for key in keys)
    return found, size
