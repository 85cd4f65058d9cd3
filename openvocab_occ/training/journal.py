"""What a run leaves behind: lines of JSON, TensorBoard where it is installed, and checkpoints."""

import json
import time
from pathlib import Path
from typing import Any

import torch

from openvocab_occ.errors import ModelError
from openvocab_occ.io.files import PathLike, written_file


class RunJournal:
    """`log.jsonl` of a folder, and `tensorboard/` beside it."""

    def __init__(self, folder: PathLike, *, resume_from: int = 0) -> None:
        """Lines of steps from `resume_from` on are dropped: they will be run again."""
        self.path = Path(folder) / "log.jsonl"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        kept = [line for line in self._lines() if line.get("step", 0) < resume_from]
        with written_file(self.path) as scratch:
            scratch.write_text("".join(json.dumps(line) + "\n" for line in kept))
        try:
            from torch.utils.tensorboard.writer import SummaryWriter
        except ImportError:
            self._board = None
        else:
            self._board = SummaryWriter(str(Path(folder) / "tensorboard"), purge_step=resume_from)
        self._started = time.perf_counter()

    def add(self, step: int, **values: float) -> None:
        """Write what was measured at a step."""
        line = {"step": step, **values, "seconds": round(time.perf_counter() - self._started, 3)}
        with self.path.open("a") as stream:
            stream.write(json.dumps(line) + "\n")
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(name, value, step)

    def close(self) -> None:
        """Let go of files."""
        if self._board is not None:
            self._board.close()

    def _lines(self) -> list[dict[str, Any]]:
        if not self.path.exists():
            return []
        lines: list[dict[str, Any]] = []
        for text in self.path.read_text().splitlines():
            try:
                lines.append(json.loads(text))
            except ValueError:  # the last line of a killed run
                break
        return lines


def save_checkpoint(path: PathLike, content: dict[str, Any]) -> None:
    """Write tensors and plain values, whole or not at all."""
    with written_file(path) as scratch:
        torch.save(content, scratch)


def load_checkpoint(path: PathLike) -> dict[str, Any]:
    """Read what `save_checkpoint` wrote; nothing is unpickled that could run.

    Raises:
        ModelError: It is damaged.
    """
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise ModelError(f"checkpoint {Path(path).name} is damaged", got=str(error).splitlines()[0][:160],
                         fix="remove it, and training starts anew") from error  # fmt: skip
