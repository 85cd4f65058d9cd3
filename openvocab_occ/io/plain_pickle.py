"""Reading pickles that hold plain data, and nothing else.

A pickle is a program: it names functions and calls them. Here every name but those that numbers, containers and numpy
arrays are made of is refused, and even those are stand-ins of ours that check what they are given.
"""

import pickle
import re
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np

from openvocab_occ.errors import DataError, UnsafeFileError
from openvocab_occ.io.files import PathLike, existing

_PLAIN_DTYPE = re.compile(r"(\|?b1|[iufc][1248]|c16|[SU][1-9]\d*)")
_FIX = "open it only where you trust its maker, and save it as JSON"
_BROKEN = (
    pickle.UnpicklingError, EOFError, AttributeError, LookupError, TypeError, ValueError, ArithmeticError, MemoryError,
    RecursionError, ImportError,
)  # fmt: skip


def read_plain_pickle(path: PathLike) -> Any:
    """Read a pickle of numbers, strings, containers and numpy arrays of numbers or strings.

    OrderedDict comes back as dict.

    Raises:
        UnsafeFileError: The file names anything else; nothing of it has been called.
        DataError: The file is no pickle, or damaged.
    """
    file = existing(path, "pickle file")
    try:
        return _PlainUnpickler(BytesIO(file.read_bytes())).load()
    except UnsafeFileError as error:
        raise UnsafeFileError(f"{file.name}: {error.what}", expected=error.expected, got=error.got, fix=_FIX) from None
    except _BROKEN as error:
        raise DataError(f"{file.name} cannot be read", expected="a pickle of plain data", got=error) from error


class _DType:
    """What a file says a dtype is, believed only when it is one of numbers, booleans or strings."""

    __slots__ = ("dtype",)

    def __init__(self, spec: object, *_align_and_copy: object) -> None:
        if not isinstance(spec, str) or not _PLAIN_DTYPE.fullmatch(spec):
            raise UnsafeFileError("the file holds an array of objects", expected="numbers or strings", got=spec)
        self.dtype = np.dtype(spec)

    def __setstate__(self, state: tuple[object, ...]) -> None:
        _version, order, *structure = state
        if order not in ("<", ">", "|", "=") or structure[:3] != [None, None, None]:
            raise UnsafeFileError("the file holds a structured dtype", expected="numbers or strings", got=state)
        self.dtype = self.dtype.newbyteorder(order)  # pyright: ignore[reportArgumentType]


class _Array(np.ndarray):
    """An ndarray that is filled from bytes only."""

    __slots__ = ()

    def __setstate__(self, state: tuple[Any, ...]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        version, shape, dtype, fortran, raw = state
        if not isinstance(dtype, _DType) or not isinstance(raw, bytes):
            raise UnsafeFileError("the file holds an array of objects", expected="raw bytes", got=type(raw).__name__)
        super().__setstate__((version, shape, dtype.dtype, fortran, raw))


def _reconstruct(kind: object, _shape: object, _code: object) -> np.ndarray:
    if not isinstance(kind, _Global) or kind.make is not _no_call:
        raise UnsafeFileError("the file holds an array of another class", expected="numpy.ndarray", got=kind)
    return _Array((0,))


def _scalar(kind: object, raw: object) -> np.generic:
    if not isinstance(kind, _DType) or not isinstance(raw, bytes):
        raise UnsafeFileError("the file holds a scalar of objects", expected="raw bytes", got=type(raw).__name__)
    (value,) = np.frombuffer(raw, kind.dtype)
    return value


def _frombuffer(raw: object, kind: object, shape: Any, order: Any, *_axes: None) -> np.ndarray:
    if not isinstance(kind, _DType) or not isinstance(raw, bytes | bytearray):
        raise UnsafeFileError("the file holds an array of objects", expected="raw bytes", got=type(raw).__name__)
    return np.frombuffer(raw, kind.dtype).reshape(shape, order=order)


def _encode(text: str, codec: str) -> bytes:
    if codec not in ("latin1", "latin-1"):
        raise UnsafeFileError("the file calls a codec", expected="latin1", got=codec)
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """Old protocols call bytes() for b""; any argument is a TypeError, bytes(10**12) among them."""
    return b""


def _no_call(*_: object) -> None:
    raise UnsafeFileError("the file calls numpy.ndarray itself", expected="only its name")


class _Global:
    """A stand-in for a name: it may be called, and nothing can be set on it (a pickle could otherwise)."""

    __slots__ = ("make",)

    def __init__(self, make: Callable[..., Any]) -> None:
        self.make = make

    def __call__(self, *arguments: object) -> object:
        return self.make(*arguments)

    def __setstate__(self, state: object) -> None:
        raise UnsafeFileError("the file changes a function", expected="plain data", got=state)


_CORE = ("numpy.core.multiarray", "numpy._core.multiarray")
_ADMITTED: dict[tuple[str, str], Callable[..., Any]] = {
    **{(module, "_reconstruct"): _reconstruct for module in _CORE},
    **{(module, "scalar"): _scalar for module in _CORE},
    **{(module, "_frombuffer"): _frombuffer for module in ("numpy.core.numeric", "numpy._core.numeric")},
    ("numpy", "ndarray"): _no_call,
    ("numpy", "dtype"): _DType,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): dict,
    **{(module, "bytes"): _no_bytes for module in ("builtins", "__builtin__")},
    **{(module, kind.__name__): kind for module in ("builtins", "__builtin__") for kind in (set, frozenset, complex)},
}


class _PlainUnpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str, /) -> _Global:
        make = _ADMITTED.get((module_name, global_name))
        if make is None:
            raise UnsafeFileError(
                "the pickle asks for code to run",
                expected="plain containers and numpy arrays",
                got=f"the name {module_name}.{global_name}",
            )
        return _Global(make)
