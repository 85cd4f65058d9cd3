"""Arrays of numbers from `.npy` and `.npz`; nothing is unpickled."""

import zipfile
import zlib
from typing import Any

import numpy as np

from openvocab_occ.errors import DataError, UnsafeFileError
from openvocab_occ.io.files import PathLike, existing


def read_arrays(path: PathLike, what: str) -> dict[str, np.ndarray]:
    """Return the arrays of an `.npz` by name; that of an `.npy` is named "".

    Raises:
        NotFoundError: There is no such file.
        UnsafeFileError: It holds pickled objects.
        DataError: It is damaged or of another kind.
    """
    file = existing(path, what)
    try:
        with file.open("rb") as stream:
            content: Any = np.load(stream, allow_pickle=False)
            if isinstance(content, np.ndarray):
                return {"": content}
            return {key: content[key] for key in content.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        if "allow_pickle" in str(error):
            raise UnsafeFileError(
                f"{file.name} holds pickled objects", expected="arrays of numbers", fix="save it again from numbers"
            ) from error
        raise DataError(f"{file.name} cannot be read", expected="an .npz or .npy of numbers", got=error) from error
