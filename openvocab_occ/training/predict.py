"""A network along a drive, with the global map: read, predict, write; files in the benchmark's submission format."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, UInt8

from openvocab_occ.datasets.frame import Frame, FrameSequence
from openvocab_occ.errors import ConfigError, GridError
from openvocab_occ.geometry import Camera
from openvocab_occ.io.files import PathLike, written_file
from openvocab_occ.memory import TileMap
from openvocab_occ.memory.filters import remove_dynamic
from openvocab_occ.networks.onnx_network import OnnxNetwork
from openvocab_occ.networks.predictor import OccupancyNetwork
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_SPEC, OccupancyGrid, visibility_mask
from openvocab_occ.training.samples import check_images, spread

Advance = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True)
class MapUse:
    """How a drive uses the global map."""

    log: str
    """Name of the drive in the map."""
    agent: str = "car-1"
    prior_from: Literal["all", "other_logs"] = "other_logs"
    """Whose writes are read: everyone's, or those of other drives (long-term memory proper)."""
    dynamic: Literal["retained", "v1", "v2"] = "retained"
    write: bool = True


def open_map(path: PathLike, network: OccupancyNetwork | OnnxNetwork) -> TileMap:
    """Open the map of a network's lattice, or create it.

    Raises:
        ConfigError: It has other classes or voxels.
    """
    spec = network.spec
    if not Path(path).exists():
        z = float(spec.origin[2])
        return TileMap.create(path, OCC3D_CLASSES, heights=spec.shape[2], cell=float(spec.size[2]), z0=z)
    city = TileMap.open(path)
    check_map(city, network)
    return city


def check_map(city: TileMap, network: OccupancyNetwork | OnnxNetwork) -> None:
    """Refuse a map whose priors would mean something else to a network.

    Raises:
        ConfigError: It has other classes or voxels.
    """
    schema, cell = city.schema, float(network.spec.size[2])
    if schema.class_names != OCC3D_CLASSES:
        raise ConfigError("the map has other classes than the network", expected=", ".join(OCC3D_CLASSES),
                          got=", ".join(schema.class_names), fix="use a map of Occ3D's classes")  # fmt: skip
    if abs(schema.cell - cell) > 1e-6:
        raise ConfigError("the map has voxels of another size than the network", expected=f"{cell:g} m",
                          got=f"{schema.cell:g} m", fix="use a map that a network of this size wrote")  # fmt: skip


def predictions(
    network: OccupancyNetwork | OnnxNetwork,
    sequence: FrameSequence,
    city: TileMap | None = None,
    use: MapUse | None = None,
    *,
    cameras: int | None = None,
) -> Iterator[tuple[Frame, Float32[np.ndarray, "x y z classes"]]]:
    """Yield each frame with the logits of a network, which reads the map before it writes what the cameras saw of them.

    Args:
        network: With memory if a map is to be read; a baseline, or a foreign ONNX model, only writes.
        sequence: The drive.
        city: The global map.
        use: How; needed with a map.
        cameras: Views that the network was trained with; a frame with fewer is refused.

    Raises:
        ConfigError: The map does not fit the network, or `use` is missing.
        DataError: A frame lacks cameras.
    """
    if city is not None and use is None:
        raise ConfigError("a map needs the name of the drive", expected="use=MapUse(log=...)")
    if city is not None:
        check_map(city, network)
    spec = network.spec
    for frame in sequence:
        check_images(frame, network.config, cameras=cameras)
        prior = None
        if city is not None and use is not None and network.memory:
            gone = (use.log,) if use.prior_from == "other_logs" and use.log in city.logs() else ()
            prior = city.read(frame.T_world_ego, spec, exclude_logs=gone)
        logits = network.predict(frame, prior)
        if city is not None and use is not None and use.write:
            labels = logits.argmax(axis=-1).astype(np.uint8)
            grid = OccupancyGrid(labels, spec, frame.T_world_ego)
            mask = visibility_mask(grid, _small([view.camera for view in frame.views]), mode="pixel")
            kept = logits
            if use.dynamic != "retained":
                kept = remove_dynamic(
                    logits, mask, OCC3D_CLASSES, version=1 if use.dynamic == "v1" else 2, seed=frame.index
                )
            city.write(kept, mask, frame.T_world_ego, spec, stamp=frame.timestamp, agent=use.agent, log=use.log)
        yield frame, logits


def write_predictions(
    network: OccupancyNetwork | OnnxNetwork,
    sequence: FrameSequence,
    out: PathLike,
    city: TileMap | None = None,
    use: MapUse | None = None,
    *,
    cameras: int | None = None,
    progress: Advance | None = None,
) -> list[Path]:
    """Write `TOKEN.npz` for each frame: (200, 200, 16) uint8 under `arr_0`, Occ3D's submission format.

    The readers' `occupancy="OUT/{token}.npz"` reads them back. Coarser networks' voxels are repeated.
    """
    found: list[Path] = []
    for frame, logits in predictions(network, sequence, city, use, cameras=cameras):
        path = Path(out) / f"{frame.token or f'{frame.index:06d}'}.npz"
        with written_file(path) as scratch, scratch.open("wb") as stream:
            np.savez_compressed(stream, occ3d_labels(logits, network))
        found.append(path)
        if progress is not None:
            progress(len(found), len(sequence))
    return found


def occupancy_of(
    network: OccupancyNetwork | OnnxNetwork, city: TileMap | None = None
) -> Callable[[Frame], OccupancyGrid]:
    """Return what gives a frame the grid that files of `write_predictions` would, reading a map but not writing it."""
    if city is not None:
        check_map(city, network)

    def predict(frame: Frame) -> OccupancyGrid:
        prior = city.read(frame.T_world_ego, network.spec) if city is not None and network.memory else None
        return OccupancyGrid(occ3d_labels(network.predict(frame, prior), network), OCC3D_SPEC, frame.T_world_ego)

    return predict


def occ3d_labels(
    logits: Float32[np.ndarray, "x y z classes"], network: OccupancyNetwork | OnnxNetwork
) -> UInt8[np.ndarray, "200 200 16"]:
    """Return the likeliest classes on Occ3D's lattice; free where the network's grid does not reach.

    Raises:
        GridError: The network's voxels are no multiple of Occ3D's.
    """
    spec = network.spec
    factor = round(float(spec.size[0] / OCC3D_SPEC.size[0]))
    if factor < 1 or not np.allclose(spec.size, factor * OCC3D_SPEC.size):
        raise GridError("the network's grid is not Occ3D's", expected=OCC3D_SPEC, got=spec)
    fine = spread(logits.argmax(axis=-1).astype(np.uint8), factor)
    first = np.round((np.asarray(spec.origin) - np.asarray(OCC3D_SPEC.origin)) / OCC3D_SPEC.size).astype(int)
    out = np.full(OCC3D_SPEC.shape, OCC3D_CLASSES.index("free"), np.uint8)
    x, y, z = (slice(int(a), int(a) + n) for a, n in zip(first, fine.shape, strict=True))
    out[x, y, z] = fine
    return out


def _small(cameras: list[Camera]) -> list[Camera]:
    """Scale cameras down: a ray for each of 800 columns finds every voxel of 0.4 m at 40 m."""
    return [c if c.width <= 800 else c.resized(800, round(c.height * 800 / c.width)) for c in cameras]
