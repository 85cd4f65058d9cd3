"""The voxel map: sparse, aligned with the world, without bounds; what all frames said about each voxel, added up."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt8

from openvocab_occ.arrays import check_finite, check_shape
from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.mapping.keys import pack, packable, unpack
from openvocab_occ.mapping.lift import Lifted
from openvocab_occ.segmentation.encoder import Contract

NO_LABEL = 255
"""Label of a voxel that no occupancy grid named."""
_RECORD = np.dtype(
    [
        ("weight", np.float32),
        ("color_sum", np.float32, 3),
        ("color_weight", np.float32),
        ("count", np.int32),
        ("first_seen", np.float64),
        ("last_seen", np.float64),
        ("label", np.uint8),
        ("label_time", np.float64),
        ("label_pixels", np.int32),
    ]
)
COLUMNS = ("weight", "agreement", "colors", "color_weight", "count", "first_seen", "last_seen", "labels", "label_time",
           "label_pixels")  # fmt: skip
"""Arrays that with keys and features make up a map; see `VoxelMap.columns`."""


class VoxelMap:
    """Voxels that were seen, sorted by key; grows by `integrate` and `merge`.

    Key (i, j, k) covers [i s, (i + 1) s) and so on in the world, s the voxel size in metres. Arrays come in the order
    of the keys and may not be written to. A position in them holds until the map grows.
    """

    def __init__(self, voxel_size: float, dim: int, *, contract: Contract = "dense") -> None:
        if not (np.isfinite(voxel_size) and voxel_size > 0):
            raise ConfigError("voxel size is not usable", expected="a length above 0 m", got=voxel_size)
        if dim < 1:
            raise ConfigError("feature length is not usable", expected="at least 1", got=dim)
        if contract not in ("dense", "logits"):
            raise ConfigError("contract is not known", expected="dense or logits", got=contract)
        self.voxel_size = float(voxel_size)
        self.dim = int(dim)
        self.contract: Contract = contract
        self._packed = np.empty(0, dtype=np.int64)  # sorted
        self._row = np.empty(0, dtype=np.int64)  # where each of them is stored, in order of arrival
        self._records = np.empty(0, dtype=_RECORD)
        self._sums = np.empty((0, self.dim), dtype=np.float32)
        self._cache: dict[str, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._packed)

    def __repr__(self) -> str:
        return f"VoxelMap({len(self)} voxels of {self.voxel_size} m, {self.dim} {self.contract} channels)"

    @property
    def keys(self) -> Int32[np.ndarray, "n 3"]:
        """Lattice indices, sorted by x, then y, then z."""
        return self._cached("keys", lambda: unpack(self._packed))

    @property
    def centers(self) -> Float64[np.ndarray, "n 3"]:
        """Centres in the world, metres."""
        return self._cached("centers", lambda: (self.keys + 0.5) * self.voxel_size)

    @property
    def features(self) -> Float32[np.ndarray, "n c"]:
        """Mean over pixels: unit vectors of a `dense` map, a distribution over the labels of a `logits` map.

        Zero where nothing remains to normalise.
        """

        def compute() -> np.ndarray:
            norm = self._norm()[:, None]
            return np.divide(
                self._sums[self._row], norm, out=np.zeros((len(self), self.dim), np.float32), where=norm > 0
            )

        return self._cached("features", compute)

    @property
    def agreement(self) -> Float32[np.ndarray, " n"]:
        """How far the pixels of a voxel agree: length of their mean feature, 1 when all are the same.

        For a `logits` map the mean mass of the distributions, which is 1.
        """
        return self._cached("agreement", lambda: (self._norm() / self.weight).astype(np.float32))

    @property
    def weight(self) -> Float32[np.ndarray, " n"]:
        """Pixels that saw the voxel, over all frames."""
        return self._column("weight")

    @property
    def colors(self) -> UInt8[np.ndarray, "n 3"]:
        """Mean RGB; black where no image gave one."""

        def compute() -> np.ndarray:
            mean = self._column("color_sum") / np.maximum(self._column("color_weight"), 1e-9)[:, None]
            return np.clip(np.rint(mean), 0, 255).astype(np.uint8)

        return self._cached("colors", compute)

    @property
    def count(self) -> Int32[np.ndarray, " n"]:
        """Frames that saw the voxel."""
        return self._column("count")

    @property
    def first_seen(self) -> Float64[np.ndarray, " n"]:
        """Time of the first frame that saw the voxel, seconds."""
        return self._column("first_seen")

    @property
    def last_seen(self) -> Float64[np.ndarray, " n"]:
        """Time of the last frame that saw the voxel, seconds."""
        return self._column("last_seen")

    @property
    def labels(self) -> UInt8[np.ndarray, " n"]:
        """Occupancy class by the latest frame that named one; 255 where none did.

        Of several grid voxels at that time the one with the most pixels names it, then the smallest class.
        """
        return self._column("label")

    def index(self, keys: Int32[np.ndarray, "m 3"]) -> Int64[np.ndarray, " m"]:
        """Return the position of each key, -1 where the map has no such voxel."""
        if not len(self):
            return np.full(len(keys), -1, dtype=np.int64)
        packed = pack(keys)
        at = np.minimum(np.searchsorted(self._packed, packed), len(self) - 1)
        return np.where((self._packed[at] == packed) & packable(keys), at, -1)

    def integrate(
        self,
        keys: Int32[np.ndarray, "m 3"],
        lifted: Lifted,
        *,
        time: float,
        labels: UInt8[np.ndarray, " m"] | None = None,
    ) -> None:
        """Add what one frame saw. Rows that share a key add up; rows without pixels add nothing.

        Everything is checked before anything changes. Frames may come in any order.
        """
        check_shape(keys, (len(lifted.sums), 3), "voxel keys")
        check_shape(lifted.sums, (None, self.dim), "lifted features")
        check_finite(lifted.sums, "lifted features")
        if not np.isfinite(time):
            raise DataError("time of a frame is not finite", expected="seconds", got=time)
        if not packable(keys).all():
            raise DataError("voxel keys are too large", expected="within 2^23 along x and y, 2^15 along z")
        records = np.zeros(len(keys), dtype=_RECORD)
        records["weight"] = lifted.weight
        records["count"] = 1
        records["first_seen"] = records["last_seen"] = time
        if lifted.color_sum is not None:
            records["color_sum"], records["color_weight"] = lifted.color_sum, lifted.weight
        records["label"], records["label_time"] = NO_LABEL, -np.inf
        if labels is not None:
            check_shape(labels, (len(keys),), "occupancy labels of rows")
            named = labels != NO_LABEL
            records["label"] = labels
            records["label_time"][named] = time
            records["label_pixels"][named] = lifted.pixels[named]
        seen = lifted.weight > 0
        packed, records, sums = pack(keys[seen]), records[seen], lifted.sums[seen]
        if not len(packed):
            return
        order = np.lexsort((records["label"], -records["label_pixels"], packed))  # the first of a key names the label
        packed, starts = np.unique(packed[order], return_index=True)
        merged = records[order][starts]
        for name in ("weight", "color_sum", "color_weight"):
            merged[name] = np.add.reduceat(records[name][order], starts, axis=0)
        self._add(packed, merged, np.add.reduceat(sums[order], starts, axis=0))

    def merge(self, other: "VoxelMap") -> None:
        """Add another map of the same kind to this one, as if its frames had been integrated here."""
        if (self.voxel_size, self.dim, self.contract) != (other.voxel_size, other.dim, other.contract):
            raise ConfigError("maps of different kinds cannot be merged", expected=repr(self), got=repr(other))
        self._add(other._packed, other._records[other._row], other._sums[other._row])

    def copy(self) -> "VoxelMap":
        """Return a map of its own that no longer grows with this one."""
        twin = VoxelMap(self.voxel_size, self.dim, contract=self.contract)
        twin.merge(self)
        return twin

    def columns(self) -> dict[str, np.ndarray]:
        """Return the arrays named in COLUMNS; with keys and features they restore the map by `from_columns`."""
        derived = {"agreement": self.agreement, "colors": self.colors, "labels": self.labels}
        return {name: derived[name] if name in derived else self._column(name) for name in COLUMNS}

    @classmethod
    def from_columns(
        cls,
        voxel_size: float,
        keys: Int32[np.ndarray, "n 3"],
        features: Float32[np.ndarray, "n c"],
        columns: Mapping[str, np.ndarray],
        *,
        contract: Contract,
    ) -> "VoxelMap":
        """Build a map from arrays; keys need not be sorted but must differ, features are normalised again."""
        voxels = cls(voxel_size, features.shape[1], contract=contract)
        check_shape(keys, (len(features), 3), "voxel keys")
        check_finite(features, "voxel features")
        records = np.zeros(len(keys), dtype=_RECORD)
        for name in COLUMNS:
            check_shape(columns[name], (len(keys), 3) if name == "colors" else (len(keys),), f"column {name}")
        for name in ("weight", "color_weight", "count", "first_seen", "last_seen", "label_time", "label_pixels"):
            records[name] = columns[name]
        records["label"] = columns["labels"]
        records["color_sum"] = columns["colors"] * columns["color_weight"][:, None]
        packed, order = np.unique(pack(keys), return_index=True)
        if len(packed) != len(keys) or not packable(keys).all():
            raise DataError("voxel keys repeat or are too large", got=f"{len(keys)} keys, {len(packed)} different")
        norm = features.sum(axis=1) if contract == "logits" else np.linalg.norm(features, axis=1)
        sums = features * (columns["agreement"] * columns["weight"] / np.where(norm > 0, norm, 1))[:, None]
        voxels._add(packed, records[order], sums[order].astype(np.float32))
        return voxels

    def _norm(self) -> Float32[np.ndarray, " n"]:
        sums = self._sums[self._row]
        return sums.sum(axis=1) if self.contract == "logits" else np.linalg.norm(sums, axis=1)

    def _column(self, name: str) -> Any:
        return self._cached("record " + name, lambda: self._records[name][self._row])

    def _cached(self, name: str, compute: Callable[[], np.ndarray]) -> Any:
        if name not in self._cache:
            array = compute()
            array.flags.writeable = False
            self._cache[name] = array
        return self._cache[name]

    def _add(self, packed: np.ndarray, records: np.ndarray, sums: np.ndarray) -> None:
        """Add rows with different, sorted keys."""
        at = np.searchsorted(self._packed, packed)
        known = np.zeros(len(packed), dtype=bool)
        inner = at < len(self)
        known[inner] = self._packed[at[inner]] == packed[inner]
        rows, old, new = self._row[at[known]], self._records[self._row[at[known]]], records[known]
        self._sums[rows] += sums[known]
        self._records[rows] = _combined(old, new)
        start, fresh = len(self), int((~known).sum())
        self._reserve(start + fresh)
        self._sums[start : start + fresh] = sums[~known]
        self._records[start : start + fresh] = records[~known]
        self._packed = np.insert(self._packed, at[~known], packed[~known])
        self._row = np.insert(self._row, at[~known], np.arange(start, start + fresh))
        self._cache.clear()

    def _reserve(self, rows: int) -> None:
        """Make room, doubling, so that a long drive copies each voxel a few times only."""
        if rows <= len(self._records):
            return
        room = max(rows, 2 * len(self._records)) if len(self) else rows
        records, sums = np.zeros(room, dtype=_RECORD), np.zeros((room, self.dim), dtype=np.float32)
        records[: len(self)], sums[: len(self)] = self._records[: len(self)], self._sums[: len(self)]
        self._records, self._sums = records, sums


def _combined(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Combine records of the same voxels; commutative and associative, so that no order of frames is special."""
    result = a.copy()
    for name in ("weight", "color_sum", "color_weight", "count"):
        result[name] += b[name]
    result["first_seen"] = np.minimum(a["first_seen"], b["first_seen"])
    result["last_seen"] = np.maximum(a["last_seen"], b["last_seen"])
    names = ["label", "label_time", "label_pixels"]
    later = (b["label_time"] > a["label_time"]) | (
        (b["label_time"] == a["label_time"])
        & ((b["label_pixels"] > a["label_pixels"])
           | ((b["label_pixels"] == a["label_pixels"]) & (b["label"] < a["label"])))
    )  # fmt: skip
    for name in names:
        result[name] = np.where(later, b[name], a[name])
    return result
