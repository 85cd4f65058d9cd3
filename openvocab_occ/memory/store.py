"""Where a map's bytes lie: a folder, or a bucket. Small values, and the one place that knows TensorStore's errors."""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

import tensorstore as ts

from openvocab_occ.errors import ConfigError, DataError, MapError, NotFoundError, StorageError
from openvocab_occ.io.files import PathLike

Location = PathLike | Mapping[str, Any]
"""A folder, `s3://bucket/prefix`, `gs://...`, or a TensorStore kvstore spec."""

_FULL = ("os_error_code='27'", "os_error_code='28'", "os_error_code='122'", "No space left", "RESOURCE_EXHAUSTED")
_READ_ONLY = ("os_error_code='13'", "os_error_code='30'", "os_error_code='1'", "PERMISSION_DENIED", "AccessDenied")
_DAMAGED = (
    "DATA_LOSS",
    "Truncated",
    "Error decoding",
    "CRC",
    "checksum",
    "corrupt",
    "INVALID_ARGUMENT",
    "FAILED_PRECONDITION",
)


class Conflict(Exception):
    """Another writer was faster; read again and try again. Never leaves this package."""


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
        with translated(f"{self.name}/{key}"):
            self.kv.write(key, value).result()

    def delete(self, prefix: str) -> None:
        """Remove every key that begins with `prefix`."""
        with translated(f"{self.name}/{prefix}"):
            self.kv.delete_range(ts.KvStore.KeyRange(prefix, prefix + "\x7f")).result()

    def list(self, prefix: str) -> list[str]:
        """Return the keys that begin with `prefix`, sorted; those that a writer is still busy with are left out."""
        with translated(f"{self.name}/{prefix}"):
            keys = self.kv.list(ts.KvStore.KeyRange(prefix, prefix + "\x7f")).result()
        return sorted(key.decode() for key in keys if not key.endswith(b".__lock"))

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


@contextmanager
def translated(what: str) -> Iterator[None]:
    """Turn an error of TensorStore into one of ours."""
    try:
        yield
    except (DataError, StorageError, NotFoundError, Conflict):
        raise
    except (ValueError, OSError) as error:
        text = str(error)
        if text.startswith("ABORTED"):
            raise Conflict(text) from error
        brief = re.sub(r" \[tensorstore_spec.*|\[source locations.*", "", text, flags=re.DOTALL)[:300]
        if any(sign in text for sign in _FULL):
            fix = "make room, then write again; what was stored before is intact"
            raise StorageError(f"{what} cannot be written: the disk is full", got=brief, fix=fix) from error
        if any(sign in text for sign in _READ_ONLY):
            fix = "check its permissions"
            raise StorageError(f"{what} cannot be written: it is read-only", got=brief, fix=fix) from error
        if any(sign in text for sign in _DAMAGED):
            fix = "openvocab-occ memory verify lists what is damaged, memory rebuild --repair makes it anew"
            raise MapError(f"{what} is damaged", expected="a whole chunk", got=brief, fix=fix) from error
        raise StorageError(f"{what} cannot be used", got=brief) from error


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
