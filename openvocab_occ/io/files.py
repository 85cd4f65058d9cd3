"""Files: friendly errors when missing, outputs that are whole or not there at all."""

import ctypes
import difflib
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from openvocab_occ.errors import AlreadyExistsError, ConfigError, NotFoundError

PathLike = str | os.PathLike[str]
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # of Linux


def existing(path: PathLike, what: str) -> Path:
    """Return `path`, or raise NotFoundError naming `what` was looked for and what lies beside it."""
    found = Path(path).expanduser()
    if found.exists():
        return found
    parent = found.parent
    if not parent.is_dir():
        raise NotFoundError(f"{what} not found", expected=str(found), got=f"no folder {parent}", fix="check the path")
    names = sorted(p.name for p in parent.iterdir())
    near = difflib.get_close_matches(found.name, names, n=3) or names[:3]
    raise NotFoundError(
        f"{what} not found",
        expected=str(found),
        got=f"{len(names)} others there, such as {', '.join(near)}" if names else "an empty folder",
        fix="check the path",
    )


def sha256(path: PathLike) -> str:
    """Return the hex digest of a file's content."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def fsync(path: Path) -> None:
    """Make a file's content, or a folder's list of names, survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def output_folder(path: PathLike, *, marker: str) -> Path:
    """Return a path that `written_folder` may write, its parent made, or raise; worth asking before long work.

    An existing folder is replaced only if it holds a file called `marker`, so that no other folder is ever lost.
    """
    target = Path(path).expanduser()
    if target.exists() and not (target / marker).is_file():
        raise AlreadyExistsError(
            f"{target} exists and is not ours to replace",
            expected=f"a folder with {marker}, or none",
            fix="choose another output path",
        )
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=target.parent).close()
    except OSError as error:
        raise ConfigError(
            f"{target} cannot be written", got=error.strerror, fix="choose another output path"
        ) from error
    return target


def _exchange(a: Path, b: Path) -> bool:
    """Swap two names in one step where Linux and the file system can, so that a crash finds one or the other."""
    if not sys.platform.startswith("linux"):
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "renameat2"):
        return False
    return libc.renameat2(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE) == 0


@contextmanager
def written_folder(path: PathLike, *, marker: str) -> Generator[Path, None, None]:
    """Yield a temporary sibling of `path` to write into; on success it takes the place of `path`, else it is removed.

    What may be replaced is told by `output_folder`.
    """
    target = output_folder(path, marker=marker)
    scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        scratch.chmod(0o755)
        yield scratch
        for child in scratch.rglob("*"):
            fsync(child)
        fsync(scratch)
        if target.exists() and _exchange(scratch, target):
            pass  # the old folder is now at `scratch`, and goes below
        elif target.exists():
            # two renames: a crash between them leaves the old folder beside the name, whole
            old = Path(tempfile.mkdtemp(prefix=f".{target.name}.old.", dir=target.parent))
            target.rename(old / target.name)
            scratch.rename(target)
            shutil.rmtree(old, ignore_errors=True)
        else:
            scratch.rename(target)
        fsync(target.parent)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def written_file(path: PathLike) -> Generator[Path, None, None]:
    """Yield a temporary sibling to write; on success it takes the place of `path` in one step, else it is removed."""
    target = Path(path).expanduser()
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=target.suffix, dir=target.parent)
    os.close(handle)
    scratch = Path(name)
    try:
        yield scratch
        fsync(scratch)
        scratch.chmod(0o644)
        scratch.replace(target)
        fsync(target.parent)
    finally:
        scratch.unlink(missing_ok=True)
