"""PCD 0.7 of the Point Cloud Library: binary out; binary and ASCII in."""

from pathlib import Path

import numpy as np

from openvocab_occ.errors import DataError
from openvocab_occ.export.formats.cloud import Cloud
from openvocab_occ.export.formats.ply import cloud_of
from openvocab_occ.io.files import PathLike, existing, written_file


def write_pcd(cloud: Cloud, path: PathLike) -> Path:
    """Write x, y, z as floats (what its readers expect; off by 0.06 mm a kilometre away), rgb packed, then the columns.

    Eight-byte columns become floats too, times included: those lose more.
    """
    columns = {axis: cloud.points[:, i].astype("<f4") for i, axis in enumerate("xyz")}
    if cloud.colors is not None:
        red, green, blue = cloud.colors.astype(np.uint32).T
        columns["rgb"] = ((red << 16) | (green << 8) | blue).astype("<u4").view("<f4")
    for name, column in cloud.columns.items():
        columns[name] = column.astype("<f4") if column.dtype.itemsize > 4 else column
    table = np.empty(len(cloud.points), dtype=[(name, "<" + c.dtype.str[1:]) for name, c in columns.items()])
    for name, column in columns.items():
        table[name] = column
    kinds = [np.dtype(c.dtype) for c in columns.values()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", "FIELDS " + " ".join(columns),
        "SIZE " + " ".join(str(kind.itemsize) for kind in kinds),
        "TYPE " + " ".join(kind.kind.upper() for kind in kinds), "COUNT " + " ".join("1" for _ in kinds),
        f"WIDTH {len(table)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(table)}", "DATA binary", "",
    ]  # fmt: skip
    with written_file(path) as scratch:
        scratch.write_bytes("\n".join(header).encode() + table.tobytes())
    return Path(path)


def read_pcd(path: PathLike) -> Cloud:
    """Read the points of a PCD file; compressed ones raise DataError."""
    file = existing(path, "PCD file")
    content = file.read_bytes()
    said: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in said:
        line, found, _ = content[at : at + 4096].partition(b"\n")
        if not found:
            raise DataError(f"{file} is not a PCD file", expected="a header that ends with DATA")
        at += len(line) + 1
        words = line.decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            said[words[0]] = words[1:]
    form = said["DATA"][0] if said["DATA"] else ""
    if form not in ("ascii", "binary"):
        raise DataError(f"{file} is stored in a way that is not read", expected="DATA ascii or binary", got=form)
    try:
        names, count = said["FIELDS"], int(said["POINTS"][0])
        repeats = [int(n) for n in said.get("COUNT", ["1"] * len(names))]
        kinds = [f"<{t.lower()}{s}" for t, s in zip(said["TYPE"], said["SIZE"], strict=True)]
        dtype = np.dtype([(n, k, (r,)) for n, k, r in zip(names, kinds, repeats, strict=True)])
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise DataError(f"header of {file} contradicts itself", got=error) from error
    if form == "binary":
        if len(content) - at < count * dtype.itemsize:
            raise DataError(
                f"{file} is cut short", expected=f"{count} points of {dtype.itemsize} bytes", got=len(content) - at
            )
        table = np.frombuffer(content, dtype=dtype, count=count, offset=at)
        columns = {name: table[name][:, 0].copy() for name, r in zip(names, repeats, strict=True) if r == 1}
    else:
        values = np.array(content[at:].split(), dtype=np.float64)
        if values.size < count * sum(repeats):
            raise DataError(f"{file} is cut short", expected=f"{count} points", got=values.size // max(sum(repeats), 1))
        values = values[: count * sum(repeats)].reshape(count, -1)
        first = np.cumsum([0, *repeats])
        columns = {name: values[:, first[i]].astype(kinds[i]) for i, name in enumerate(names) if repeats[i] == 1}
    packed = columns.pop("rgb", columns.pop("rgba", None))
    if packed is not None:
        bits = packed.view("<u4") if packed.dtype.itemsize == 4 else packed.astype(np.uint32)
        columns |= {"red": bits >> 16 & 255, "green": bits >> 8 & 255, "blue": bits & 255}
    return cloud_of(columns, file)
