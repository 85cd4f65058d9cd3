"""Where a map's bytes lie: a folder, or a bucket. Small values, and the one place that knows TensorStore's errors."""

import json
import os
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote
from zlib import crc32

import tensorstore as ts

from openvocab_occ.errors import ConfigError, MapError, StorageError
from openvocab_occ.io.files import PathLike
from openvocab_occ.memory.commit import SCRATCH, Batch, BucketBatch, FolderBatch, make_folders
from openvocab_occ.memory.refusals import refused, translated

try:
    import fcntl
except ImportError:  # Windows: one process may write
    fcntl = None

Location = PathLike | Mapping[str, Any]
"""A folder, `s3://bucket/prefix`, `gs://...`, or a TensorStore kvstore spec."""

_LOCKS = ".locks"
_NUM_LOCKS = 64  # files; tiles that share one wait for each other in vain, rarely


class Store:
    """A flat space of keys at a location."""

    def __init__(self, location: Location, *, create: bool) -> None:
        self.spec, self.name, self.folder = _spec(location)
        if self.folder is not None and create:
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise StorageError(f"{self.name} cannot be made", got=error.strerror, fix="check the path") from error
        self.context = ts.Context({"cache_pool": {"total_bytes_limit": 0}})
        with translated(self.name):
            self.kv = cast(Any, ts.KvStore.open(self.spec, context=self.context).result())

    def read(self, key: str) -> bytes | None:
        """Return a value, or None if there is none."""
        with translated(f"{self.name}/{key}"):
            found = self.kv.read(key).result()
        return found.value if found.state == "value" else None

    def write(self, key: str, value: bytes) -> None:
        """Write a value, whole and durable, or raise and leave what was there."""
        with self.batch([key]) as batch:
            batch.put(key, value)
            batch.commit()

    @contextmanager
    def batch(self, keys: Collection[str]) -> Iterator[Batch]:
        """Let values of some of `keys` be read, put and committed; in a folder other processes wait for that long.

        A killed process's locks open by themselves, and what it left half written is written over.
        """
        if self.folder is None or fcntl is None:
            yield BucketBatch(self.kv, self.name)
            return
        with ExitStack() as held:
            with refused(self.name):
                make_folders(self.folder, [f"{_LOCKS}/any", *keys])
                for lock in sorted({_lock(key) for key in keys}):  # in order: no two wait in a ring
                    descriptor = os.open(self.folder / _LOCKS / lock, os.O_RDWR | os.O_CREAT, 0o666)
                    held.callback(os.close, descriptor)
                    fcntl.flock(descriptor, fcntl.LOCK_EX)
            batch = FolderBatch(self.folder, self.name)
            held.callback(batch.close)
            yield batch

    def delete(self, prefix: str) -> None:
        """Remove every key that begins with `prefix`."""
        with translated(f"{self.name}/{prefix}"):
            self.kv.delete_range(ts.KvStore.KeyRange(prefix, prefix + "\x7f")).result()

    def list(self, prefix: str) -> list[str]:
        """Return the keys that begin with `prefix`, sorted; those that a writer is still busy with are left out."""
        with translated(f"{self.name}/{prefix}"):
            keys = self.kv.list(ts.KvStore.KeyRange(prefix, prefix + "\x7f")).result()
        return sorted(key.decode() for key in keys if not key.endswith(SCRATCH.encode()))

    def read_json(self, key: str) -> dict[str, Any] | None:
        """Return a JSON object, or None if there is none."""
        raw = self.read(key)
        if raw is None:
            return None
        try:
            value = json.loads(raw)
        except ValueError as error:
            raise MapError(f"{self.name}/{key} is damaged", expected="JSON", got=error) from error
        if not isinstance(value, dict):
            raise MapError(f"{self.name}/{key} is damaged", expected="a JSON object", got=type(value).__name__)
        return value

    def write_json(self, key: str, value: Mapping[str, Any]) -> None:
        """Write a JSON object."""
        self.write(key, json.dumps(value, indent=1, ensure_ascii=False).encode())

    def under(self, prefix: str) -> dict[str, Any]:
        """Return the kvstore spec of what lies below `prefix`."""
        return {**self.spec, "path": f"{self.spec.get('path', '')}{prefix}"}


def safe_name(name: str, what: str) -> str:
    """Return a name as a part of a key, from which `unsafe_name` gets it back."""
    if not isinstance(name, str) or not name.strip() or len(name) > 128:
        raise ConfigError(f"{what} is not a name", expected="1 to 128 characters", got=repr(name))
    return quote(name, safe="").replace(".", "%2E")


def agent_number(name: str) -> int:
    """Return the number an agent has in the records: 32 bits of its name's hash, never 0; the same in every map."""
    return int.from_bytes(sha256(name.encode()).digest()[:4], "little") or 1


def _lock(key: str) -> str:
    """Return the file that is locked for a key; the journal has its own, as it is written while tiles are locked."""
    return f"{key.partition('/')[0]}-{crc32(key.encode()) % _NUM_LOCKS:02x}"


def _spec(location: Location) -> tuple[dict[str, Any], str, Path | None]:
    """Return the kvstore spec, a name for people, and the folder if it is one."""
    if isinstance(location, Mapping):
        spec = {**location}
        spec["path"] = str(spec.get("path", "")).rstrip("/") + "/" if spec.get("path") else ""
        return spec, f"{spec.get('driver')}:{spec.get('bucket', '')}/{spec['path']}".rstrip("/"), None
    text = str(location)
    scheme = re.match(r"(s3|gs)://([^/]+)/?(.*)", text)
    if scheme:
        driver = {"s3": "s3", "gs": "gcs"}[scheme[1]]
        path = scheme[3].rstrip("/") + "/" if scheme[3] else ""
        return {"driver": driver, "bucket": scheme[2], "path": path}, text, None
    if "://" in text:
        raise ConfigError("location is not known", expected="a folder, s3://... or gs://...", got=text)
    folder = Path(text).expanduser().absolute()
    return {"driver": "file", "path": f"{folder}/"}, str(location), folder
