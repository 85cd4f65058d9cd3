"""The Parquet files of a `.ovmap`, held open: a map that is replaced or removed stays whole for those who read it."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from openvocab_occ.errors import MapError

FILES = (
    "voxels.parquet", "features.parquet", "space.parquet", "objects.parquet", "dynamic.parquet", "frames.parquet",
)  # fmt: skip
HASHED_AT_ONCE = 1 << 24
"""Bytes up to which a file is hashed when the map is opened (0.01 s); larger ones are by `verify_map` and, page by
page, when they are read."""


class MapFiles:
    """Open files of a map's folder; closed when nothing refers to them any more."""

    def __init__(self, folder: Path) -> None:
        """Open all; raises MapError where one is missing."""
        self.folder = folder
        try:
            self._open = {name: pa.OSFile(str(folder / name)) for name in FILES}
        except FileNotFoundError:
            name = next((name for name in FILES if not (folder / name).is_file()), "all files")
            raise MapError(
                f"map {folder} is incomplete", expected=name, got="no such file", fix="copy the whole folder"
            ) from None
        except OSError as error:
            raise MapError(f"map {folder} cannot be read", got=error) from error

    def __str__(self) -> str:
        return str(self.folder)

    def parquet(self, name: str) -> pq.ParquetFile:
        """Return a reader of a file that checks its pages."""
        try:
            return pq.ParquetFile(self._open[name], page_checksum_verification=True)
        except (pa.ArrowException, OSError) as error:
            raise MapError(f"{self.folder / name} cannot be read", expected="Parquet", got=error) from error

    def table(self, name: str, columns: list[str] | None = None, groups: list[int] | None = None) -> pa.Table:
        """Read columns of a file, checking each page; all row groups, or some."""
        with self.parquet(name) as file:
            try:
                return file.read(columns) if groups is None else file.read_row_groups(groups, columns)
            except (pa.ArrowException, OSError) as error:
                raise MapError(f"{self.folder / name} cannot be read", expected="Parquet", got=error) from error

    def names(self, name: str) -> list[str]:
        """Return the columns of a file."""
        with self.parquet(name) as file:
            return file.schema_arrow.names

    def check(self, manifest: Mapping[str, Any], *, hash_all: bool = False) -> None:
        """Check that the files are those that the manifest speaks of."""
        for name, file in self._open.items():
            self._check(name, file, manifest, hash_all)

    def _check(self, name: str, file: pa.OSFile, manifest: Mapping[str, Any], hash_all: bool) -> None:
        path = self.folder / name
        try:
            said, size, rows = (
                manifest["files"][name]["sha256"],
                manifest["files"][name]["bytes"],
                manifest["counts"][name.removesuffix(".parquet")],
            )
        except (KeyError, TypeError) as error:
            raise MapError(
                f"the manifest of map {self.folder} says nothing of {name}", got=f"missing {error}"
            ) from error
        have = file.size()
        if (hash_all or have <= HASHED_AT_ONCE or have != size) and (digest := _sha256(file)) != said:
            raise MapError(
                f"{path} is damaged or was edited",
                expected=f"sha256 {str(said)[:12]}...",
                got=f"{digest[:12]}..., {have} bytes",
                fix="copy it again, or rebuild the map",
            )
        with self.parquet(name) as reader:
            found = reader.metadata.num_rows
        if found != rows:
            raise MapError(f"{path} has another number of rows than its manifest says", expected=rows, got=found)


def _sha256(file: pa.OSFile) -> str:
    file.seek(0)
    return hashlib.file_digest(file, "sha256").hexdigest()  # pyright: ignore[reportArgumentType]
