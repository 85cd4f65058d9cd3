"""LAS and LAZ 1.4, point format 7, by laspy."""

from pathlib import Path
from typing import Any

import numpy as np

from openvocab_occ.errors import DataError, MissingExtraError
from openvocab_occ.export.formats.cloud import Cloud
from openvocab_occ.io.files import PathLike, existing, written_file

_RESOLUTION = 0.001  # metres; what coordinates are rounded to
_STANDARD = {"label": "classification"}


def _laspy() -> Any:
    try:
        import laspy
    except ImportError as error:
        raise MissingExtraError(
            "LAS files need laspy", got="not installed", fix="pip install 'openvocab_occ[las]'"
        ) from error
    return laspy


def write_las(cloud: Cloud, path: PathLike) -> Path:
    """Write points to the millimetre, 16-bit colours, the occupancy class as classification, columns as extra bytes.

    A `.laz` path is compressed.
    """
    laspy = _laspy()
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, _RESOLUTION)
    header.offsets = np.floor(cloud.points.min(axis=0)) if len(cloud.points) else np.zeros(3)
    extra = {name: column for name, column in cloud.columns.items() if name not in _STANDARD}
    header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=column.dtype) for name, column in extra.items()])
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    if cloud.colors is not None:
        las.red, las.green, las.blue = cloud.colors.astype(np.uint16).T * np.uint16(257)
    for name, field in _STANDARD.items():
        if name in cloud.columns:
            las[field] = cloud.columns[name]
    for name, column in extra.items():
        las[name] = column
    with written_file(path) as scratch:
        las.write(str(scratch))
    return Path(path)


def read_las(path: PathLike) -> Cloud:
    """Read points, colours, classes and extra bytes."""
    laspy = _laspy()
    file = existing(path, "LAS file")
    try:
        las = laspy.read(str(file))
    except (laspy.errors.LaspyException, ValueError, OSError) as error:
        raise DataError(f"{file} cannot be read", expected="LAS or LAZ", got=error) from error
    names = set(las.point_format.dimension_names)
    colors = None
    if {"red", "green", "blue"} <= names:
        wide = np.stack([np.asarray(las[name]) for name in ("red", "green", "blue")], axis=1)
        colors = (wide >> 8 if wide.max(initial=0) > 255 else wide).astype(np.uint8)  # some writers store 8 bits
    columns = {"label": np.asarray(las["classification"]).astype(np.uint8)}
    columns |= {name: np.asarray(las[name]) for name in las.point_format.extra_dimension_names}
    return Cloud(np.asarray(las.xyz, dtype=np.float64), colors, columns)
