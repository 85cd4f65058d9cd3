"""The voxel map: sparse, aligned with the world, without bounds; what all frames said about each voxel, added up."""

from collections.abc import Callable, Mapping
from typing import Any, get_args

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, Int64, UInt8, UInt16

from openvocab_occ.arrays import check_finite, check_shape
from openvocab_occ.errors import ConfigError, DataError, ShapeError
from openvocab_occ.mapping.cover import Cover, cover_keys, cover_moved
from openvocab_occ.mapping.free_space import FreeSpace
from openvocab_occ.mapping.key_table import KeyTable
from openvocab_occ.mapping.keys import pack, packable, unpack
from openvocab_occ.mapping.lift import Lifted
from openvocab_occ.mapping.records import NO_LABEL, FeatureSums, Records, records_from, records_of, reduced
from openvocab_occ.segmentation.encoder import Contract

HIT_LOG_ODDS, FREE_LOG_ODDS = 0.85, -0.4
"""What one frame that sees a voxel, or through it, adds to the log-odds of its being occupied: OctoMap's values
(Hornung et al. 2013). Not clamped as there, so that the order of frames does not matter."""
COLUMNS = ("weight", "agreement", "colors", "color_weight", "normals", "count", "first_seen", "last_seen", "labels",
           "label_time", "label_pixels", "view_frame", "view", "view_box", "view_score")  # fmt: skip
"""Arrays that with keys and features make up a map; see `VoxelMap.columns`."""
OPTIONAL = ("normals", "view_frame", "view", "view_box", "view_score", "label_counts")
"""Those that `VoxelMap.from_columns` can do without."""


class VoxelMap:
    """Voxels that were seen, sorted by key; grows by `integrate` and `merge`.

    Key (i, j, k) covers [i s, (i + 1) s) and so on in the world, s the voxel size in metres. Arrays come in the order
    of the keys and may not be written to. A position in them holds until the map grows.
    """

    def __init__(
        self, voxel_size: float, dim: int, *, contract: Contract = "dense", num_classes: int = 0,
        device: str | None = None,
    ) -> None:  # fmt: skip
        """Begin with an empty map; `num_classes` of an occupancy grid are counted in `label_counts`, where above 0.

        With a `device` such as `cuda` torch keeps and adds up the features there; all else stays where it is.
        """
        if not (np.isfinite(voxel_size) and voxel_size > 0):
            raise ConfigError("voxel size is not usable", expected="a length above 0 m", got=voxel_size)
        if dim < 1:
            raise ConfigError("feature length is not usable", expected="at least 1", got=dim)
        if contract not in get_args(Contract):
            raise ConfigError("contract is not known", expected=" or ".join(get_args(Contract)), got=contract)
        if not 0 <= num_classes <= NO_LABEL:
            raise ConfigError("number of classes is not usable", expected=f"0..{NO_LABEL}", got=num_classes)
        self.voxel_size = float(voxel_size)
        self.dim = int(dim)
        self.contract: Contract = contract
        self.num_classes = int(num_classes)
        self._free: FreeSpace | Callable[[], FreeSpace] = FreeSpace(self.voxel_size)
        self._table = KeyTable()  # rows in order of arrival
        self._records = Records(self.num_classes)
        self._sums = FeatureSums(self.dim) if device is None else _sums_on(device, self.dim)
        self._cache: dict[str, np.ndarray] = {}
        self._load: Callable[[str], np.ndarray] | None = None  # where columns come from until the map grows
        self._stored = 0  # how many voxels that holds

    def __len__(self) -> int:
        return self._stored if self._load else len(self._table)

    def __repr__(self) -> str:
        return f"VoxelMap({len(self)} voxels of {self.voxel_size} m, {self.dim} {self.contract} channels)"

    @property
    def keys(self) -> Int32[np.ndarray, "n 3"]:
        """Lattice indices, sorted by x, then y, then z."""
        return self._cached("keys", lambda: unpack(self._packed), always=True)

    @property
    def free(self) -> FreeSpace:
        """Where cameras looked through; `integrate` does not touch it."""
        if not isinstance(self._free, FreeSpace):
            self._free = self._free()
        return self._free

    @free.setter
    def free(self, space: FreeSpace) -> None:
        self._free = space

    @property
    def centers(self) -> Float64[np.ndarray, "n 3"]:
        """Centres in the world, metres."""
        return self._cached("centers", lambda: (self.keys + 0.5) * self.voxel_size, always=True)

    @property
    def features(self) -> Float32[np.ndarray, "n c"]:
        """Mean over pixels: unit vectors of a `dense` map, a distribution over the labels of a `logits` map.

        Zero where nothing remains to normalise.
        """

        def compute() -> np.ndarray:
            sums = self._sums.rows(self._order)
            norm = self._norm(sums)[:, None]
            return np.divide(sums, norm, out=sums, where=norm > 0)

        return self._cached("features", compute)

    @property
    def agreement(self) -> Float32[np.ndarray, " n"]:
        """How far the pixels of a voxel agree: length of their mean feature, 1 when all are the same.

        For a `logits` map the mean mass of the distributions, which is 1.
        """

        def compute() -> np.ndarray:
            norm = np.concatenate([self._norm(part) for part in self._sums.parts(self._order)] or [np.zeros(0)])
            return (norm / self.weight).astype(np.float32)

        return self._cached("agreement", compute)

    @property
    def weight(self) -> Float32[np.ndarray, " n"]:
        """Weights of the pixels that saw the voxel, over all frames."""
        return self._column("weight")

    @property
    def colors(self) -> UInt8[np.ndarray, "n 3"]:
        """Mean RGB; black where no image gave one."""

        def compute() -> np.ndarray:
            mean = self._column("color_sum") / np.maximum(self._column("color_weight"), 1e-9)[:, None]
            return np.clip(np.rint(mean), 0, 255).astype(np.uint8)

        return self._cached("colors", compute)

    @property
    def normals(self) -> Float32[np.ndarray, "n 3"]:
        """Mean of the unit normals that pixels saw, in the world: its length tells how well they agree; 0 for none."""
        return self._cached("normals", lambda: (self._column("normal_sum") / self.weight[:, None]).astype(np.float32))

    @property
    def count(self) -> Int32[np.ndarray, " n"]:
        """Frames that saw the voxel."""
        return self._column("count")

    @property
    def free_count(self) -> UInt8[np.ndarray, " n"]:
        """Frames that saw through the voxel."""
        return self._cached("free_count", lambda: self.free.count(self.keys), always=True)

    @property
    def log_odds(self) -> Float64[np.ndarray, " n"]:
        """Evidence that the voxel is occupied, from the frames that saw it and those that saw through it."""
        return HIT_LOG_ODDS * self.count + FREE_LOG_ODDS * self.free_count.astype(np.float64)

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
        return self._cached("labels", lambda: self._column("label"))

    @property
    def label_counts(self) -> UInt16[np.ndarray, "n k"]:
        """How many frames named each class of the occupancy; no columns where the map counts none."""
        return self._cached("label_counts", lambda: self._records.histogram[self._order])

    def best_views(self, positions: Int[np.ndarray, " m"]) -> tuple[np.ndarray, ...]:
        """Return frame (-1 for none), number of the view in it, pixel box and score of the best view of voxels."""
        return tuple(self._column(name)[positions] for name in ("view_frame", "view", "view_box", "view_score"))

    def index(self, keys: Int32[np.ndarray, "m 3"]) -> Int64[np.ndarray, " m"]:
        """Return the position of each key, -1 where the map has no such voxel."""
        if not len(self):
            return np.full(len(keys), -1, dtype=np.int64)
        packed = pack(keys)
        at = np.minimum(np.searchsorted(self._packed, packed), len(self) - 1)
        return np.where((self._packed[at] == packed) & packable(keys), at, -1)

    def centers_at(self, positions: Int[np.ndarray, " m"]) -> Float64[np.ndarray, "m 3"]:
        """Return the centres of the voxels at some positions, metres in the world."""
        return (unpack(self._packed[positions]) + 0.5) * self.voxel_size

    def integrate(
        self,
        keys: Int32[np.ndarray, "m 3"] | Cover,
        lifted: Lifted,
        *,
        time: float,
        labels: UInt8[np.ndarray, " m"] | None = None,
        frame: int = -1,
    ) -> None:
        """Add what one frame saw, in time that grows with the rows and not with the map.

        Everything is checked before anything changes. Frames may come in any order.

        Args:
            keys: Of the rows; rows that share a key add up. Or a `Cover`, which may spread a row over several keys.
            lifted: The rows; those without weight add nothing.
            time: Of the frame, seconds.
            labels: Occupancy class of each row; 255 for none.
            frame: Number by which best views name this frame.
        """
        cover = keys if isinstance(keys, Cover) else cover_keys(keys)
        rows = len(lifted.sums)
        if not isinstance(keys, Cover):
            check_shape(keys, (rows, 3), "voxel keys")
        elif len(cover.row) and not 0 <= int(cover.row.min()) <= int(cover.row.max()) < rows:
            raise ShapeError("cover names rows that are not there", expected=f"0..{rows - 1}", got=cover.row.max())
        check_shape(lifted.sums, (None, self.dim), "lifted features")
        check_finite(lifted.sums, "lifted features")
        if not np.isfinite(time):
            raise DataError("time of a frame is not finite", expected="seconds", got=time)
        if not packable(cover.keys).all():
            raise DataError("voxel keys are too large", expected="within 2^23 along x and y, 2^15 along z")
        if labels is not None:
            check_shape(labels, (rows,), "occupancy labels of rows")
            named = labels[labels != NO_LABEL]
            if self.num_classes and len(named) and int(named.max()) >= self.num_classes:
                raise DataError(
                    "occupancy labels are no classes", expected=f"0..{self.num_classes - 1} or 255", got=named.max()
                )
        self._own()
        cover = cover.only(lifted.weight > 0)
        before = len(self._table)
        at = self._table.insert(pack(cover.keys))
        self._sums.reserve(len(self._table))
        self._sums.add(at, cover.row, cover.share, lifted.sums)
        records = records_of(lifted, cover, time=time, labels=labels, frame=frame)
        at, records = reduced(at, records)
        self._records.add(at, records, before)
        self._cache.clear()

    def merge(self, other: "VoxelMap") -> None:
        """Add another map of the same kind to this one, as if its frames had been integrated here."""
        if (self.voxel_size, self.dim, self.contract) != (other.voxel_size, other.dim, other.contract):
            raise ConfigError("maps of different kinds cannot be merged", expected=repr(self), got=repr(other))
        if len(self) and len(other) and self.num_classes != other.num_classes:
            raise ConfigError(
                "maps of different occupancy classes cannot be merged", expected=self.num_classes, got=other.num_classes
            )
        other._own()
        self._own()
        if not len(self):
            self.num_classes, self._records = other.num_classes, Records(other.num_classes)
        before = len(self._table)
        at = self._table.insert(other._table.keys)
        self._sums.reserve(len(self._table))
        self._sums.add_all(at, other._sums)
        self._records.add(at, other._records.values[: len(at)], before, other._records.histogram[: len(at)])
        self.free.merge(other.free)
        self._cache.clear()

    def copy(self) -> "VoxelMap":
        """Return a map of its own that no longer grows with this one."""
        twin = VoxelMap(self.voxel_size, self.dim, contract=self.contract, num_classes=self.num_classes)
        twin.merge(self)
        return twin

    def subset(self, chosen: Bool[np.ndarray, " n"]) -> "VoxelMap":
        """Return a map of the chosen voxels; what was seen through is kept whole."""
        check_shape(chosen, (len(self),), "choice of voxels")
        columns = {name: column[chosen] for name, column in self.columns().items()}
        voxels = VoxelMap.from_columns(
            self.voxel_size, self.keys[chosen], self.features[chosen], columns, contract=self.contract
        )
        voxels.free = self.free.copy()
        return voxels

    def moved(self, T_new_old: Float[np.ndarray, "4 4"], *, first_frame: int = 0) -> "VoxelMap":
        """Return the map after a rigid motion of the world, on the lattice of the new one.

        Frames that best views name are counted from `first_frame` on. Free space is moved cell by cell, and where
        rounding leaves a gap is not known to be free.
        """
        cover = cover_moved(self.keys, self.voxel_size, T_new_old)
        records = records_from(self.columns(), len(self))[cover.row]
        for name in ("weight", "color_weight"):
            records[name] *= cover.share
        for name in ("color_sum", "normal_sum"):
            records[name] *= cover.share[:, None]
        records["normal_sum"] = records["normal_sum"] @ T_new_old[:3, :3].T
        records["view_frame"] += np.where(records["view_frame"] >= 0, first_frame, 0).astype(np.int32)
        voxels = VoxelMap(self.voxel_size, self.dim, contract=self.contract, num_classes=self.num_classes)
        at = voxels._table.insert(pack(cover.keys))
        voxels._sums.reserve(len(voxels._table))
        scale = (self.agreement * self.weight)[cover.row] * cover.share
        voxels._sums.add(at, cover.row, scale, self.features)
        counts = self.label_counts[cover.row] if self.num_classes else None
        _, first = np.unique(at, return_index=True)
        voxels._records.add(*reduced(at, records), 0, None if counts is None else counts[first])
        voxels.free = self.free.moved(T_new_old)
        return voxels

    def columns(self) -> dict[str, np.ndarray]:
        """Return the arrays named in COLUMNS, and `label_counts` where the map counts classes.

        With keys and features they restore the map by `from_columns`, but for the free space.
        """
        own = ("agreement", "colors", "normals", "labels")
        columns = {name: getattr(self, name) if name in own else self._column(name) for name in COLUMNS}
        return columns | ({"label_counts": self.label_counts} if self.num_classes else {})

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
        counts = columns.get("label_counts")
        num_classes = 0 if counts is None else counts.shape[1]
        voxels = cls(voxel_size, features.shape[1], contract=contract, num_classes=num_classes)
        check_shape(keys, (len(features), 3), "voxel keys")
        check_finite(features, "voxel features")
        widths = {"colors": 3, "normals": 3, "view_box": 4}
        for name in COLUMNS:
            if name in columns or name not in OPTIONAL:
                shape = (len(keys), widths[name]) if name in widths else (len(keys),)
                check_shape(columns[name], shape, f"column {name}")
        packed = pack(keys)
        if len(np.unique(packed)) != len(keys) or not packable(keys).all():
            raise DataError("voxel keys repeat or are too large", got=f"{len(keys)} keys")
        voxels._table.insert(packed)
        voxels._records.add(np.arange(len(keys)), records_from(columns, len(keys)), 0, counts)
        norm = features.sum(axis=1) if contract == "logits" else np.linalg.norm(features, axis=1)
        scale = columns["agreement"] * columns["weight"] / np.where(norm > 0, norm, 1)
        voxels._sums.reserve(len(keys))
        rows = np.arange(len(keys), dtype=np.int32)
        voxels._sums.add(rows, rows, scale.astype(np.float32), np.ascontiguousarray(features))
        return voxels

    @classmethod
    def stored(
        cls,
        voxel_size: float,
        dim: int,
        count: int,
        load: Callable[[str], np.ndarray],
        *,
        free: Callable[[], FreeSpace],
        contract: Contract,
        num_classes: int = 0,
    ) -> "VoxelMap":
        """Return a map of `count` voxels that are read when they are asked for, and so is what was seen through.

        `load("packed")` gives the packed keys, sorted, and `load` of another name that column.
        """
        voxels = cls(voxel_size, dim, contract=contract, num_classes=num_classes)
        voxels._stored, voxels._load, voxels._free = count, load, free
        return voxels

    @property
    def _packed(self) -> Int64[np.ndarray, " n"]:
        return self._cached("packed", lambda: np.sort(self._table.keys))

    @property
    def _order(self) -> Int64[np.ndarray, " n"]:
        return self._cached("order", lambda: np.argsort(self._table.keys), always=True)

    def _own(self) -> None:
        """Read what is still in the file, and let go of it."""
        if self._load is None:
            return
        twin = VoxelMap.from_columns(self.voxel_size, self.keys, self.features, self.columns(), contract=self.contract)
        self._table, self._records, self._sums = twin._table, twin._records, twin._sums
        self._load = None

    def _norm(self, sums: Float32[np.ndarray, "m c"]) -> Float32[np.ndarray, " m"]:
        return sums.sum(axis=1) if self.contract == "logits" else np.linalg.norm(sums, axis=1)

    def _column(self, name: str) -> Any:
        return self._cached(name, lambda: self._records.values[name][self._order])

    def _cached(self, name: str, compute: Callable[[], np.ndarray], *, always: bool = False) -> Any:
        """Return an array that cannot be written to: read from the file, or computed (`always`: also then)."""
        if name not in self._cache:
            array = compute() if self._load is None or always else self._load(name)
            array.flags.writeable = False
            self._cache[name] = array
        return self._cache[name]


def _sums_on(device: str, dim: int) -> FeatureSums:
    from openvocab_occ.mapping.records_torch import TorchFeatureSums

    return TorchFeatureSums(dim, device)
