"""Things of a whole city: the objects of many maps in one Lance dataset, found by words, place, state and time.

Not needed below some dozens of maps: `find` asks one map and understands far more. Needs the extra `scale`.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Float32, Float64

from openvocab_occ.arrays import ArrayLike
from openvocab_occ.errors import (
    AlreadyExistsError,
    ConfigError,
    EncoderMismatchError,
    MapError,
    MissingExtraError,
    NotFoundError,
    QueryError,
)
from openvocab_occ.geometry import as_pose, transform
from openvocab_occ.io.files import PathLike
from openvocab_occ.objects import EncoderInfo, SceneMap, SceneObject
from openvocab_occ.query.words import match_labels, singular
from openvocab_occ.segmentation.encoder import PixelEncoder

EXACT_ROWS = 1_000_000
"""Objects from which `index` makes an inverted file; below, reading all of them takes about a second and errs never."""
_PROBES, _REFINE = 40, 10  # of an IVF: 20 probes lost a tenth behind a filter, without refinement more than half
_META = b"openvocab_occ.city_index"
_FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class Where:
    """What a hit must fulfil besides the words; nothing by default."""

    region: Float[np.ndarray, "2 3"] | None = None
    """Lower and upper corner of a box in the city's frame, metres, that the object's centre lies in."""
    states: Sequence[str] = ()
    """Such as parked and moving; any of them."""
    since: float | None = None
    """Unix seconds: last seen at or after."""
    until: float | None = None
    """Unix seconds: first seen at or before."""
    maps: Sequence[str] = ()
    """Names of maps; any of them."""

    def sql(self) -> str:
        """Return it as a filter; empty for none."""
        parts: list[str] = []
        if self.region is not None:
            region = np.asarray(self.region, dtype=np.float64)
            if region.shape != (2, 3) or not np.isfinite(region).all() or (region[0] > region[1]).any():
                raise ConfigError("region is not a box", expected="lower and upper corner, metres", got=region.tolist())
            for axis, low, high in zip("xyz", *region.tolist(), strict=True):
                parts.append(f"{axis} >= {low!r} AND {axis} <= {high!r}")
        for column, names in (("state", self.states), ("map", self.maps)):
            if isinstance(names, str):
                raise ConfigError(f"{column} is one name", expected="a sequence of names", got=repr(names))
            if names:
                parts.append(f"{column} IN ({', '.join(map(_quoted, names))})")
        if self.since is not None:
            parts.append(f"last_seen >= {float(self.since)!r}")
        if self.until is not None:
            parts.append(f"first_seen <= {float(self.until)!r}")
        return " AND ".join(parts)


@dataclass(frozen=True, eq=False)
class CityHit:
    """An object of one of the maps."""

    map: str
    id: int
    label: str
    state: str
    score: float
    """Cosine, or the probability of the labels meant; not calibrated."""
    center: Float64[np.ndarray, " 3"]
    """In the city's frame, metres."""
    first_seen: float
    last_seen: float


class CityIndex:
    """One dataset. Many may search; one at a time should add."""

    def __init__(self, path: Path, dataset: Any, info: EncoderInfo) -> None:
        """Use `create` or `open`."""
        self.path = path
        self.encoder = info
        self._dataset = dataset

    @staticmethod
    def create(path: PathLike, encoder: EncoderInfo) -> "CityIndex":
        """Make an empty index of maps of one encoder (`SceneMap.encoder`).

        Raises:
            AlreadyExistsError: Something is there.
            MissingExtraError: Lance is not installed.
        """
        lance, folder = _lance(), Path(path)
        if folder.exists():
            raise AlreadyExistsError(f"{folder} exists", fix="open it, or choose a new path")
        about = {"format": _FORMAT, "name": encoder.name, "contract": encoder.contract, "dim": encoder.dim,
                 "labels": list(encoder.labels), "fingerprint": encoder.fingerprint}  # fmt: skip
        schema = _schema(encoder.dim).with_metadata({_META: json.dumps(about).encode()})
        return CityIndex(folder, lance.write_dataset(schema.empty_table(), str(folder)), encoder)

    @staticmethod
    def open(path: PathLike) -> "CityIndex":
        """Open an index.

        Raises:
            NotFoundError: There is none.
            MapError: It is another dataset, or of a later format.
        """
        lance, folder = _lance(), Path(path)
        if not folder.is_dir():
            raise NotFoundError("no city index there", expected=str(folder), fix="CityIndex.create makes one")
        try:
            dataset = lance.dataset(str(folder))
            about = json.loads((dataset.schema.metadata or {})[_META])
            info = EncoderInfo(name=about["name"], contract=about["contract"], dim=int(about["dim"]),
                               labels=tuple(about["labels"]), fingerprint=about["fingerprint"])  # fmt: skip
        except (KeyError, ValueError, OSError) as error:
            raise MapError(f"{folder} is not a city index", got=error) from error
        if about["format"] != _FORMAT:
            raise MapError(f"{folder} has a format this version cannot read", expected=_FORMAT, got=about["format"])
        return CityIndex(folder, dataset, info)

    def __len__(self) -> int:
        return int(self._dataset.count_rows())

    def add(
        self, name: str, scene: SceneMap | PathLike, *, T_city_map: ArrayLike | None = None, start: float = 0.0
    ) -> int:
        """Put in the objects of a map, in place of what was there of that name; return how many.

        Args:
            name: Of the map, for hits to name it.
            scene: The map or its folder.
            T_city_map: Its place in the city's frame; the same frame by default.
            start: Unix seconds at which its clock reads 0.

        Raises:
            EncoderMismatchError: The map is of another encoder.
        """
        if not name:
            raise ConfigError("the map has no name", expected="a word that hits name it by", got=repr(name))
        opened = scene if isinstance(scene, SceneMap) else SceneMap.open(scene)
        if opened.encoder.fingerprint != self.encoder.fingerprint:
            raise EncoderMismatchError(
                f"map {name!r} is of another encoder", expected=self.encoder.name, got=opened.encoder.name,
                fix="make an index for each encoder",
            )  # fmt: skip
        T = np.eye(4) if T_city_map is None else as_pose(T_city_map, "T_city_map")
        objects = [thing for thing in opened.objects if np.any(thing.embedding)]
        table = _table(name, objects, T, start, self.encoder.dim)
        merge = self._dataset.merge_insert("key").when_matched_update_all().when_not_matched_insert_all()
        merge.when_not_matched_by_source_delete(f"map = {_quoted(name)}").execute(table)  # in one commit
        self._reload()
        return len(objects)

    def append(self, table: pa.Table) -> None:
        """Put in rows as they are, of maps that are not in yet; for many maps at once."""
        self._dataset = _lance().write_dataset(table.cast(_schema(self.encoder.dim)), str(self.path), mode="append")

    def index(self, *, exact_rows: int = EXACT_ROWS) -> bool:
        """Make searches quick after many maps were added; tell whether an inverted file was made.

        Below `exact_rows` only ranges of place and time are indexed, and searches stay exact. Rows added later are
        found without being indexed.
        """
        self._dataset.optimize.compact_files()
        if not len(self):
            return False
        for column in ("x", "y", "first_seen", "last_seen"):
            self._dataset.create_scalar_index(column, "ZONEMAP", replace=True)
        inverted = len(self) >= exact_rows
        if inverted:
            dim = self.encoder.dim
            parts = next((dim // width for width in (8, 4, 2) if dim % width == 0), None)
            options = {"num_sub_vectors": parts} if parts else {}
            self._dataset.create_index(
                "embedding", "IVF_PQ" if parts else "IVF_FLAT", metric=self._metric, replace=True,
                num_partitions=max(1, round(len(self) ** 0.5 / 4)), **options,
            )  # fmt: skip
        self._reload()
        return inverted

    def search(
        self,
        query: str | Float32[np.ndarray, " c"],
        encoder: PixelEncoder | None = None,
        *,
        where: Where | None = None,
        limit: int = 20,
        exact: bool = False,
    ) -> list[CityHit]:
        """Return the objects that fit a noun, or are near a vector, best first.

        Args:
            query: A noun as in `find` without attributes and relations; or a vector of the maps' features.
            encoder: The maps' own, for a noun in maps of a `dense` encoder.
            where: Place, state and time; applied before the nearest are taken, so that `limit` hits come if they exist.
            limit: Most hits.
            exact: Read all rows also where there is an inverted file.

        Raises:
            QueryError: No word of the noun is known, or the vector does not fit.
            EncoderMismatchError: The encoder is another one.
        """
        if limit < 1:
            raise ConfigError("limit is not usable", expected="at least 1", got=limit)
        vector = self._noun(query, encoder) if isinstance(query, str) else np.asarray(query, dtype=np.float32)
        if vector.shape != (self.encoder.dim,) or not np.isfinite(vector).all() or not vector.any():
            raise QueryError(
                "vector does not fit", expected=f"{self.encoder.dim} finite numbers, not all 0", got=vector.shape
            )
        nearest = {"column": "embedding", "q": vector, "k": limit, "metric": self._metric, "use_index": not exact,
                   "nprobes": _PROBES, "refine_factor": _REFINE}  # fmt: skip
        if not self._inverted:
            nearest = {k: v for k, v in nearest.items() if k not in ("nprobes", "refine_factor")} | {"use_index": False}
        sql = (where or Where()).sql() or None
        found = self._dataset.to_table(nearest=nearest, filter=sql, prefilter=True)
        features = np.array(found["embedding"].combine_chunks().flatten(), dtype=np.float32).reshape(-1, len(vector))
        scores = features @ vector
        rows = found.drop_columns(["embedding"]).to_pylist()
        hits = [
            CityHit(row["map"], row["id"], row["label"], row["state"], float(score),
                    np.array([row["x"], row["y"], row["z"]]), row["first_seen"], row["last_seen"])
            for row, score in zip(rows, scores, strict=True)
        ]  # fmt: skip
        return sorted(hits, key=lambda hit: (-hit.score, hit.map, hit.id))

    @property
    def _metric(self) -> str:
        return "dot" if self.encoder.contract == "logits" else "cosine"

    @property
    def _inverted(self) -> bool:
        return any("embedding" in index["fields"] for index in self._dataset.list_indices())

    def _noun(self, text: str, encoder: PixelEncoder | None) -> Float32[np.ndarray, " c"]:
        if encoder is not None and encoder.fingerprint != self.encoder.fingerprint:
            raise EncoderMismatchError(
                "the encoder is not the one that made these maps", expected=self.encoder.name, got=encoder.name
            )
        if self.encoder.contract == "logits":
            channels = match_labels(text, self.encoder.labels).channels
            if not channels.any():
                raise QueryError("no word is known", expected=f"of {', '.join(self.encoder.labels)}", got=repr(text))
            return channels.astype(np.float32)
        if encoder is None or encoder.text is None:
            raise ConfigError(
                "these maps need their text encoder to understand words", expected=self.encoder.name, got="none"
            )
        vector = np.asarray(encoder.text.encode([singular(text)])[0], dtype=np.float32)
        return vector / max(float(np.linalg.norm(vector)), 1e-12)

    def _reload(self) -> None:
        self._dataset = _lance().dataset(str(self.path))


def _schema(dim: int) -> pa.Schema:
    return pa.schema([
        pa.field("key", pa.string(), nullable=False), ("map", pa.string()), ("id", pa.int64()), ("label", pa.string()),
        ("state", pa.string()), ("x", pa.float64()), ("y", pa.float64()), ("z", pa.float64()),
        ("first_seen", pa.float64()), ("last_seen", pa.float64()), ("embedding", pa.list_(pa.float32(), dim)),
    ])  # fmt: skip


def _table(name: str, objects: Sequence[SceneObject], T: np.ndarray, start: float, dim: int) -> pa.Table:
    centers = transform(T, np.array([thing.center for thing in objects], dtype=np.float64).reshape(-1, 3))
    features = np.array([thing.embedding for thing in objects], dtype=np.float32).reshape(-1, dim)
    return pa.table(
        [
            [f"{name}/{thing.id}" for thing in objects], [name] * len(objects), [thing.id for thing in objects],
            [thing.label for thing in objects], [thing.state for thing in objects], *centers.T,
            [thing.first_seen + start for thing in objects], [thing.last_seen + start for thing in objects],
            pa.FixedSizeListArray.from_arrays(pa.array(features.ravel()), dim),
        ],
        schema=_schema(dim),
    )  # fmt: skip


def _quoted(text: str) -> str:
    return "'" + str(text).replace("'", "''") + "'"


def _lance() -> Any:
    try:
        import lance  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingExtraError("the city index needs Lance", fix="pip install 'openvocab_occ[scale]'") from error
    return lance
