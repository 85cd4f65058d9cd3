"""What a file system, or TensorStore, says no with, as errors of ours."""

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager

from openvocab_occ.errors import MapError, OpenVocabOccError, StorageError

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


@contextmanager
def refused(what: str) -> Iterator[None]:
    """Turn the operating system's refusal into an error of ours."""
    try:
        yield
    except (PermissionError, OSError) as error:
        if isinstance(error, OpenVocabOccError):
            raise
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        closed = error.errno in (errno.EACCES, errno.EPERM, errno.EROFS)
        why = "the disk is full" if full else "it is read-only" if closed else "the system refuses"
        fix = "make room, then write again" if full else "check its permissions" if closed else "check the disk"
        raise StorageError(f"{what} cannot be written: {why}", got=error.strerror, fix=fix) from error


@contextmanager
def translated(what: str) -> Iterator[None]:
    """Turn an error of TensorStore into one of ours."""
    try:
        yield
    except OpenVocabOccError:
        raise
    except (ValueError, OSError) as error:
        text = str(error)
        brief = re.sub(r" \[tensorstore_spec.*|\[source locations.*", "", text, flags=re.DOTALL)[:300]
        if any(sign in text for sign in _FULL):
            fix = "make room, then write again; what was stored before is intact"
            raise StorageError(f"{what} cannot be written: the disk is full", got=brief, fix=fix) from error
        if any(sign in text for sign in _READ_ONLY):
            fix = "check its permissions"
            raise StorageError(f"{what} cannot be written: it is read-only", got=brief, fix=fix) from error
        if any(sign in text for sign in _DAMAGED):
            fix = "openvocab-occ memory verify lists what is damaged, memory verify --repair makes it anew"
            raise MapError(f"{what} is damaged", expected="a whole chunk", got=brief, fix=fix) from error
        raise StorageError(f"{what} cannot be used", got=brief) from error
