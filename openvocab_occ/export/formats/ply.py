"""PLY: points as little-endian binary; reads binary and ASCII of either byte order, vertices only."""

from pathlib import Path

import numpy as np

from openvocab_occ.errors import DataError
from openvocab_occ.export.formats.cloud import Cloud
from openvocab_occ.io.files import PathLike, existing, written_file

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
_AXES, _RGB = ("x", "y", "z"), ("red", "green", "blue")


def write_ply(cloud: Cloud, path: PathLike) -> Path:
    """Write points as doubles (a kilometre away a float is off by 0.06 mm), colours as uchar, then the columns."""
    columns = {axis: cloud.points[:, i].astype("<f8") for i, axis in enumerate(_AXES)}
    if cloud.colors is not None:
        columns |= {name: cloud.colors[:, i] for i, name in enumerate(_RGB)}
    columns |= {name: np.ascontiguousarray(column) for name, column in cloud.columns.items()}
    for name, column in columns.items():
        if column.dtype.str[1:] not in _NAMES:
            raise DataError(f"PLY has no type for column {name}", expected=", ".join(_NAMES), got=column.dtype)
    table = np.empty(len(cloud.points), dtype=[(name, "<" + c.dtype.str[1:]) for name, c in columns.items()])
    for name, column in columns.items():
        table[name] = column
    header = ["ply", "format binary_little_endian 1.0", "comment made by openvocab_occ", f"element vertex {len(table)}"]
    header += [f"property {_NAMES[c.dtype.str[1:]]} {name}" for name, c in columns.items()] + ["end_header", ""]
    with written_file(path) as scratch:
        scratch.write_bytes("\n".join(header).encode() + table.tobytes())
    return Path(path)


def read_ply(path: PathLike) -> Cloud:
    """Read the vertices of a PLY file; other elements are passed over, lists at vertices raise DataError."""
    file = existing(path, "PLY file")
    content = file.read_bytes()
    if not content.startswith(b"ply"):
        raise DataError(f"{file} is not a PLY file", expected="first line 'ply'", got=content[:8])
    head, mark, body = content.partition(b"end_header")
    words = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    form = next((line[1] for line in words if line[:1] == ["format"]), "")
    if not mark or form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise DataError(f"header of {file} cannot be read", expected="a PLY header with its format", got=form or "none")
    body = body.split(b"\n", 1)[1] if b"\n" in body else b""
    elements = [line[1:3] for line in words if line[:1] == ["element"]]
    if not elements or elements[0][0] != "vertex":
        raise DataError(f"{file} does not begin with vertices", got=[name for name, *_ in elements])
    count, end = int(elements[0][1]), "<" if form == "binary_little_endian" else ">"
    fields, inside = [], False
    for line in words:
        if line[:1] == ["element"]:
            inside = line[1] == "vertex"
        elif line[:1] == ["property"] and inside:
            if line[1] == "list" or line[1] not in _TYPES:
                raise DataError(f"vertices of {file} have a property of another kind", got=" ".join(line))
            fields.append((line[2], end + _TYPES[line[1]]))
    dtype = np.dtype(fields)
    if form == "ascii":
        lines = body.decode("ascii", "replace").splitlines()[:count]
        if len(lines) < count:
            raise DataError(f"{file} is cut short", expected=f"{count} vertices", got=len(lines))
        table = np.array([tuple(map(float, line.split()[: len(fields)])) for line in lines]).reshape(count, -1)
        columns = {name: table[:, i].astype(kind) for i, (name, kind) in enumerate(fields)}
    else:
        if len(body) < count * dtype.itemsize:
            raise DataError(f"{file} is cut short", expected=f"{count * dtype.itemsize} bytes", got=len(body))
        table = np.frombuffer(body, dtype=dtype, count=count)
        columns = {name: table[name].astype(kind[1:]) for name, kind in fields}
    return cloud_of(columns, file)


def cloud_of(columns: dict[str, np.ndarray], file: Path) -> Cloud:
    """Take points and colours out of the columns of a file."""
    if not all(axis in columns for axis in _AXES):
        raise DataError(f"{file} has no points", expected="x, y, z", got=", ".join(columns))
    points = np.stack([columns.pop(axis).astype(np.float64) for axis in _AXES], axis=1)
    colors = None
    if all(name in columns for name in _RGB):
        colors = np.stack([columns.pop(name).astype(np.uint8) for name in _RGB], axis=1)
    return Cloud(points, colors, columns)
