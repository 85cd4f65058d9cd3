"""OctoMap's binary tree, `.bt`: occupied and free leaves, no colours."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from openvocab_occ.errors import DataError
from openvocab_occ.export.formats._octomap_kernels import DEPTH, read_tree, write_tree
from openvocab_occ.io.files import PathLike, existing, written_file
from openvocab_occ.mapping import VoxelMap

_CENTER = 1 << (DEPTH - 1)  # key of the cell above 0
_FREE, _OCCUPIED = 1, 2  # two bits a child, the lower first: "10" in the stream is occupied, "01" free
_FIRST = b"# Octomap OcTree binary file"


@dataclass(frozen=True, eq=False)
class Octree:
    """Leaves of an OctoMap."""

    resolution: float
    """Edge of the smallest cell, metres."""
    corner: Int32[np.ndarray, "n 3"]
    """Lowest cell of each leaf: cell i covers [i, i + 1) resolution."""
    size: Int32[np.ndarray, " n"]
    """Cells along an edge of each leaf."""
    occupied: Bool[np.ndarray, " n"]
    """Else free."""
    num_nodes: int
    """Inner nodes and leaves."""

    @property
    def centers(self) -> Float64[np.ndarray, "n 3"]:
        """Centres of the leaves, metres."""
        return (self.corner + self.size[:, None] / 2) * self.resolution


def read_bt(path: PathLike) -> Octree:
    """Read a tree; a file that is none, or is cut short, raises DataError."""
    file = existing(path, "OctoMap file")
    content = file.read_bytes()
    head, mark, body = content.partition(b"\ndata\n")
    if not content.startswith(_FIRST) or not mark:
        raise DataError(f"{file} is not an OctoMap binary tree", expected=_FIRST.decode(), got=content[:40])
    said = dict(re.findall(r"^(id|size|res) (\S+)", head.decode("ascii", "replace"), re.MULTILINE))
    try:
        size, resolution = int(said["size"]), float(said["res"])
    except (KeyError, ValueError) as error:
        raise DataError(f"header of {file} is incomplete", expected="id, size, res", got=said) from error
    if said.get("id") != "OcTree" or not resolution > 0 or size < 0:
        raise DataError(f"{file} holds another kind of tree", expected="id OcTree and res above 0", got=said)
    leaves, counts = np.empty((max(size, 1), 5), dtype=np.int32), np.zeros(3, dtype=np.int64)
    if size and not read_tree(np.frombuffer(body, dtype=np.uint8), leaves, counts):
        raise DataError(f"{file} is cut short or damaged", expected=f"{size} nodes", got=f"{len(body)} bytes")
    if counts[1] != size * (size > 0):
        raise DataError(f"{file} is damaged", expected=f"{size} nodes", got=int(counts[1]))
    leaves = leaves[: counts[0]]
    return Octree(
        resolution,
        leaves[:, :3] - np.int32(_CENTER),
        np.left_shift(1, DEPTH - leaves[:, 3]).astype(np.int32),
        leaves[:, 4] == _OCCUPIED,
        size,
    )


def write_bt(voxels: VoxelMap, path: PathLike) -> Path:
    """Write the voxels as occupied, and cells that cameras looked through and that hold none as free.

    The lattice is OctoMap's own, so nothing is shifted. Voxels further than 32,768 cells from the origin raise.
    """
    keys = voxels.keys
    free = _free_keys(voxels)
    free = free[voxels.index(free) < 0]
    cells = np.concatenate([keys, free]).astype(np.int64) + _CENTER
    if len(cells) and (cells.min() < 0 or cells.max() >= 2 * _CENTER):
        raise DataError(
            "map is too large for an OctoMap", expected=f"within {_CENTER * voxels.voxel_size:g} m of the origin",
            got=f"{np.abs(keys).max() * voxels.voxel_size:g} m", fix="crop it",
        )  # fmt: skip
    codes = _morton(cells)
    order = np.argsort(codes)
    states = np.repeat([_OCCUPIED, _FREE], [len(keys), len(free)])[order]
    stream = np.empty(2 * DEPTH * max(len(codes), 1) + 2, dtype=np.uint8)
    nodes, used = write_tree(codes[order], states, stream) if len(codes) else (0, 0)
    header = (
        f"{_FIRST.decode()}\n# made by openvocab_occ\nid OcTree\nsize {nodes}\nres {voxels.voxel_size:.10g}\ndata\n"
    )
    with written_file(path) as scratch:
        scratch.write_bytes(header.encode() + stream[:used].tobytes())
    return Path(path)


def _free_keys(voxels: VoxelMap) -> Int32[np.ndarray, "n 3"]:
    """Return the keys of all voxels of free cells."""
    blocks, counts = voxels.free.blocks
    block, inner = np.nonzero(counts)
    cells = blocks[block] * 8 + np.stack(np.unravel_index(inner, (8, 8, 8)), axis=1)
    fine = np.array(list(np.ndindex(*(voxels.free.factor,) * 3)))
    return (cells[:, None] * voxels.free.factor + fine).reshape(-1, 3).astype(np.int32)


def _morton(cells: Int64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Interleave the bits of 16-bit cells, x lowest."""
    code = np.zeros(len(cells), dtype=np.int64)
    for bit in range(DEPTH):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return code
