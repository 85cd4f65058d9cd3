"""Files that are missing or cut off, and the times of frames."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from openvocab_occ.datasets.frame import FrameSequence
from openvocab_occ.io.images import is_cut_off
from openvocab_occ.pipeline.doctor.finding import Finding
from openvocab_occ.pipeline.doctor.sample import Sample

_NAMED = 3  # files that a message names
_MAX_SPEED = 70.0  # m/s, 250 km/h
_END = 64 * 1024  # bytes at the end of an image that are looked at


def check_files(sequence: FrameSequence, sample: Sample) -> list[Finding]:
    """Look for the files of all frames, without reading them; and say which frames could not be read."""
    if not len(sequence):
        return [Finding("error", "files", "the drive has no frames", "nothing can be mapped", "check path and scene")]
    missing: list[Path] = []
    empty: list[Path] = []
    count = 0
    for index in range(len(sequence)):
        for file in sequence.files(index):
            count += 1
            if not file.exists():
                missing.append(file)
            elif file.is_file() and file.stat().st_size == 0:
                empty.append(file)
    found = []
    for files, word in ((missing, "missing"), (empty, "empty")):
        if files:
            names = ", ".join(str(file) for file in files[:_NAMED])
            found.append(
                Finding(
                    "error",
                    "files",
                    f"{len(files)} of {count} files are {word}: {names}",
                    f"the frames that name them cannot be read ({_folders(files)})",
                    "copy them again, or leave those frames out",
                )
            )
    cut = [f for frame in sample.frames[:2] for f in sequence.files(frame.index) if _is_cut_off(f)]
    found += [Finding("error", "files", f"image {file.name} is cut off", advice="copy it again") for file in cut]
    by_message = Counter(str(error) for _, error in sample.failures)
    for message, times in list(by_message.items())[:_NAMED]:
        first = next(index for index, error in sample.failures if str(error) == message)
        more = f" and {times - 1} more" if times > 1 else ""
        found.append(Finding("error", "frames", f"frame {first}{more} cannot be read", message))
    if not found:
        told = f"all {count} files are there" if count else "all frames looked at can be read"
        found.append(Finding("ok", "files", f"{told} ({len(sequence)} frames)"))
    return found


def _is_cut_off(file: Path) -> bool:
    return file.suffix.lower() in (".jpg", ".jpeg", ".png") and file.is_file() and is_cut_off(file.read_bytes())


def _folders(files: Sequence[Path]) -> str:
    counts = Counter(file.parent.name for file in files)
    return ", ".join(f"{count} in {name}" for name, count in counts.most_common(4))


def check_timestamps(sample: Sample) -> list[Finding]:
    """Times must rise, and be seconds."""
    times = np.array([frame.timestamp for frame in sample.frames])
    if len(times) < 2:
        return []
    steps = np.array([b.timestamp - a.timestamp for a, b in sample.pairs])
    if not np.isfinite(times).all():
        return [Finding("error", "timestamps", "some times are not numbers", advice="drop those frames")]
    if (np.diff(times) < 0).any():
        return [
            Finding(
                "error",
                "timestamps",
                f"times go back {int((np.diff(times) < 0).sum())} times",
                "frames are taken in this order; motion and `parked` are told from it",
                "sort the frames by time",
            )
        ]
    if len(steps) and (steps == 0).any():
        return [
            Finding(
                "warning",
                "timestamps",
                f"{int((steps == 0).sum())} of {len(steps)} neighbours have the same time",
                "speeds cannot be told",
                "give each frame its time",
            )
        ]
    moved = np.array([np.linalg.norm(b.T_world_ego[:3, 3] - a.T_world_ego[:3, 3]) for a, b in sample.pairs])
    step = float(np.median(steps)) if len(steps) else 0.0
    if step > 1000 and float(np.median(moved)) < step / 100:
        unit = "nanoseconds" if step > 1e7 else "microseconds" if step > 1e4 else "milliseconds"
        return [
            Finding(
                "warning",
                "timestamps",
                f"frames are {step:g} apart: these look like {unit}",
                "times are in seconds",
                "divide them",
            )
        ]
    if step > 0 and steps.max() > 5 * step:
        return [Finding("note", "timestamps", f"a gap of {steps.max():.1f} s, where {step:.2g} s is usual")]
    return [Finding("ok", "timestamps", f"times rise, by {step:.3g} s a frame")]
