"""Several values put into a store together, each whole and durable or not there at all."""

import os
from collections.abc import Collection
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from openvocab_occ.io.files import fsync
from openvocab_occ.memory.refusals import refused, translated

SCRATCH = ".__lock"
"""Ending of a file that is not done yet: TensorStore's own, which it leaves out of its lists of keys as we do."""
_AT_ONCE = 8  # a file system commits what several threads sync at the same time in one go


@runtime_checkable
class Batch(Protocol):
    """Values on their way."""

    def put(self, key: str, value: bytes, version: bytes | None = None) -> None:
        """Begin to write a value, from any thread; with `version` only if that is what is stored."""
        ...

    def commit(self) -> list[str]:
        """Make all of it seen, durably; return the keys of those that somebody else was faster with."""
        ...


class FolderBatch:
    """Files, written and synced side by side while more are put, then renamed. Needs the locks of their keys."""

    def __init__(self, folder: Path, name: str) -> None:
        self._folder, self._name = folder, name
        self._pool = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="commit")
        self._begun: dict[Path, Future[None]] = {}

    def put(self, key: str, value: bytes, version: bytes | None = None) -> None:
        """Begin to write; `version` holds because the key is locked."""
        self._begun[self._folder / key] = self._pool.submit(_write, self._folder / f"{key}{SCRATCH}", value)

    def commit(self) -> list[str]:
        """Rename the files once all are on the disk, and sync each folder once."""
        with refused(self._name):
            for written in self._begun.values():
                written.result()
            for path in self._begun:
                path.with_name(path.name + SCRATCH).replace(path)
            for folder in {path.parent for path in self._begun}:
                fsync(folder)
        self._begun.clear()
        return []

    def close(self) -> None:
        """Remove what was not committed."""
        self._pool.shutdown()
        for path in self._begun:
            path.with_name(path.name + SCRATCH).unlink(missing_ok=True)


class BucketBatch:
    """Objects, each written only if its version is still the one that was read."""

    def __init__(self, kv: Any, name: str) -> None:
        self._kv, self._name = kv, name
        self._values: dict[str, tuple[bytes, bytes | None]] = {}

    def put(self, key: str, value: bytes, version: bytes | None = None) -> None:
        """Keep it for `commit`."""
        self._values[key] = value, version

    def commit(self) -> list[str]:
        """Write all side by side."""
        with translated(self._name):
            futures = {k: self._kv.write(k, value, if_equal=version) for k, (value, version) in self._values.items()}
            done = {key: future.result().generation for key, future in futures.items()}
        return [key for key, generation in done.items() if not generation]


def make_folders(folder: Path, keys: Collection[str]) -> None:
    """Make the folders of keys, durably."""
    for parent in {(folder / key).parent for key in keys}:
        new = [path for path in (parent, *parent.parents) if not path.exists()]
        parent.mkdir(parents=True, exist_ok=True)
        for path in reversed(new):
            fsync(path.parent)


def _write(path: Path, value: bytes) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
    try:
        rest = memoryview(value)
        while rest:
            rest = rest[os.write(descriptor, rest) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
