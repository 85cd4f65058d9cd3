"""Every write as it came, one object each, never changed: what maps are rebuilt from.

An object's name holds its stamp and the hash of its content: the same write twice is one object, a damaged one is found
out, and no writer waits for another. `journal/AGENT/STAMP-HASH`.
"""

import json
import struct
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256

import numpy as np
import pyarrow as pa
from jaxtyping import Float, UInt8

from openvocab_occ.errors import MapError, OpenVocabOccError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.memory.schema import MapSchema
from openvocab_occ.memory.store import Store, safe_name

_MAGIC = b"OVOJ\x02\x00\x00\x00"
_FOLDER = "journal/"


@dataclass(frozen=True, eq=False)
class Entry:
    """One write."""

    T_world_ego: Float[np.ndarray, "4 4"]
    spec: GridSpec
    flat: np.ndarray
    """int64[n]: flat C-order indices of the visible voxels, ascending."""
    codes: UInt8[np.ndarray, "n payload"]
    """Their logits as the map stores them."""
    stamp: int
    """Milliseconds since 1970 plus 1, as in the records."""
    agent: str
    log: str
    policy: str

    def rows(self) -> np.ndarray:
        """int32[x, y, z]: row of `codes` for each voxel of the grid, -1 where nothing was visible."""
        rows = np.full(self.spec.num_voxels, -1, dtype=np.int32)
        rows[self.flat] = np.arange(len(self.flat), dtype=np.int32)
        return rows.reshape(self.spec.shape)


@dataclass(frozen=True, order=True)
class EntryName:
    """Name of an object; in order of stamp, then agent."""

    stamp: int
    agent_key: str
    digest: str

    @property
    def key(self) -> str:
        """Where it lies in the store."""
        return f"{_FOLDER}{self.agent_key}/{self.stamp:016d}-{self.digest}"


def append(store: Store, entries: Sequence[Entry]) -> None:
    """Write entries, side by side; durable on return. Empty ones are left out."""
    packed = [_packed(entry) for entry in entries if len(entry.flat)]
    if packed:
        with store.batch([name.key for name, _ in packed]) as batch:
            for name, content in packed:
                batch.put(name.key, content)
            batch.commit()


def _packed(entry: Entry) -> tuple[EntryName, bytes]:
    """Return an entry's name and content."""
    header = {
        "agent": entry.agent, "log": entry.log, "stamp": entry.stamp, "policy": entry.policy,
        "T_world_ego": entry.T_world_ego.tolist(), "origin": entry.spec.origin, "voxel_size": entry.spec.voxel_size,
        "shape": entry.spec.shape, "voxels": len(entry.flat), "payload": int(entry.codes.shape[1]),
    }  # fmt: skip
    mask = np.zeros(entry.spec.num_voxels, dtype=np.bool_)
    mask[entry.flat] = True
    raw = np.concatenate([np.packbits(mask), entry.codes.reshape(-1)])
    text = json.dumps(header).encode()
    body = pa.Codec("zstd", compression_level=1).compress(raw, asbytes=True)
    content = b"".join((_MAGIC, struct.pack("<II", len(text), len(raw)), text, body))
    return EntryName(entry.stamp, safe_name(entry.agent, "agent"), sha256(content).hexdigest()[:32]), content


def names(store: Store, *, without: Collection[str] = (), until: int | None = None) -> list[EntryName]:
    """Return the entries of all agents but some, up to a stamp, in the order in which they are folded."""
    left_out = {safe_name(agent, "agent") for agent in without}
    found: list[EntryName] = []
    for key in store.list(_FOLDER):
        agent, _, file = key.removeprefix(_FOLDER).partition("/")
        stamp, _, digest = file.partition("-")
        if agent not in left_out and stamp.isdigit() and (until is None or int(stamp) <= until):
            found.append(EntryName(int(stamp), agent, digest))
    return sorted(found)


def load(store: Store, name: EntryName, schema: MapSchema) -> Entry:
    """Read an entry.

    Raises:
        MapError: It is damaged: its content does not fit its name.
    """
    content = store.read(name.key)
    try:
        if content is None or sha256(content).hexdigest()[:32] != name.digest or not content.startswith(_MAGIC):
            raise ValueError("its checksum is wrong")
        text_size, raw_size = struct.unpack_from("<II", content, len(_MAGIC))
        start = len(_MAGIC) + 8
        head = json.loads(content[start : start + text_size])
        raw = np.frombuffer(
            pa.Codec("zstd").decompress(content[start + text_size :], decompressed_size=raw_size), dtype=np.uint8
        )
        spec = GridSpec(tuple(head["origin"]), _size(head["voxel_size"]), tuple(head["shape"]))
        bits = -(-spec.num_voxels // 8)
        flat = np.flatnonzero(np.unpackbits(raw[:bits], count=spec.num_voxels))
        codes = raw[bits:].reshape(len(flat), schema.payload)
        return Entry(
            np.asarray(head["T_world_ego"], dtype=np.float64), spec, flat, codes,
            int(head["stamp"]), str(head["agent"]), str(head["log"]), str(head["policy"]),
        )  # fmt: skip
    except (ValueError, KeyError, TypeError, struct.error, pa.ArrowException) as error:
        if isinstance(error, OpenVocabOccError) and not isinstance(error, ValueError):
            raise
        fix = "remove it; what it wrote is still in the tiles until they are rebuilt"
        raise MapError(f"journal entry {name.key} is damaged", got=error, fix=fix) from error


def entries(store: Store, schema: MapSchema, wanted: Collection[EntryName]) -> Iterator[Entry]:
    """Read entries one after the other."""
    for name in wanted:
        yield load(store, name, schema)


def _size(value: object) -> float | tuple[float, float, float]:
    return tuple(float(v) for v in value) if isinstance(value, list) else float(value)  # pyright: ignore
