"""The spine: frames become a map."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from openvocab_occ._version import __version__
from openvocab_occ.arrays import check_finite, check_shape
from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.depth.render import render_depth
from openvocab_occ.errors import ConfigError, DataError, ModelError
from openvocab_occ.geometry import GridSpec, invert, pose, transform
from openvocab_occ.mapping import (
    NO_LABEL,
    Cover,
    DynamicLayer,
    PixelWeights,
    Segments,
    Sight,
    VoxelMap,
    cover_grid,
    cover_keys,
    join,
    lift,
    rows_from_depth,
    rows_from_grid,
)
from openvocab_occ.mapping.keys import pack
from openvocab_occ.mapping.layers import MOVABLE, layer_of, moving, standing
from openvocab_occ.objects import EncoderInfo, KeyFrame, NamedCamera, Provenance, SceneMap
from openvocab_occ.objects.builder import ObjectBuilder, ObjectConfig
from openvocab_occ.objects.frame_voxels import gather
from openvocab_occ.objects.sightings import with_sightings
from openvocab_occ.occupancy import OCC3D_SPEC, OccupancyGrid
from openvocab_occ.occupancy.lidar import grid_from_lidar
from openvocab_occ.segmentation.encoder import FeatureMap, MaskMap, PixelEncoder

GridFrom = Literal["auto", "occupancy", "lidar"]
"""Where a frame's grid comes from: its own occupancy, its LiDAR points, or (auto) the first of the two it has."""
DEFAULT_VOXEL_SIZE = 0.1  # metres, where no grid gives one
MAX_DEPTH = 60.0
LIDAR_SPEC = GridSpec((0.0, 0.0, 0.0), OCC3D_SPEC.voxel_size, OCC3D_SPEC.shape)
"""Grid carved from LiDAR returns; its corner is put on the map's lattice, its axes are the world's."""
MIN_LIDAR_RANGE = 2.2  # metres; nearer returns are of the car under the LiDAR (nuScenes: its bonnet, up to 2.05 m)


def build_map(
    sequence: FrameSequence | Sequence[Frame],
    encoder: PixelEncoder,
    *,
    voxel_size: float | None = None,
    max_depth: float = MAX_DEPTH,
    weights: PixelWeights | None = None,
    progress: Callable[[int, int], object] | None = None,
    provenance: Provenance | None = None,
) -> SceneMap:
    """Build a map from all frames of a sequence.

    `progress` is called with the number of frames done and their total. See `MapBuilder` for the other arguments.
    """
    if not len(sequence):
        raise DataError("sequence has no frames", expected="at least 1", got=0, fix="check the path and the slice")
    if provenance is None and isinstance(sequence, FrameSequence):
        provenance = Provenance(source=sequence.source, name=sequence.name, synthetic=sequence.synthetic)
    builder = MapBuilder(encoder, voxel_size=voxel_size, max_depth=max_depth, weights=weights, provenance=provenance)
    for done, frame in enumerate(sequence, start=1):
        builder.integrate(frame)
        if progress is not None:
            progress(done, len(sequence))
    return builder.snapshot()


@dataclass(frozen=True, eq=False)
class _Seen:
    """What the pixels of one view see."""

    rows: Int32[np.ndarray, "h w"]
    cover: Cover
    labels: UInt8[np.ndarray, " m"]
    """Occupancy class of each row."""
    depth: Float32[np.ndarray, "h w"]


def _stacked(seen: Sequence[_Seen]) -> tuple[Cover, UInt8[np.ndarray, " m"]]:
    """Put the rows of several views below one another, as `join` does."""
    first = np.cumsum([0, *(len(one.labels) for one in seen)])
    cover = Cover(
        np.concatenate([one.cover.row + np.int32(n) for one, n in zip(seen, first, strict=False)]),
        np.concatenate([one.cover.keys for one in seen]),
        np.concatenate([one.cover.share for one in seen]),
    )
    return cover, np.concatenate([one.labels for one in seen])


class MapBuilder:
    """Grows a map frame by frame."""

    def __init__(
        self,
        encoder: PixelEncoder,
        *,
        voxel_size: float | None = None,
        max_depth: float = MAX_DEPTH,
        grid_from: GridFrom = "auto",
        weights: PixelWeights | None = None,
        objects: ObjectConfig | None = None,
        provenance: Provenance | None = None,
        device: str | None = None,
    ) -> None:
        """Begin with an empty map.

        Args:
            encoder: Makes the features of all frames.
            voxel_size: Metres; None takes the first grid's, or 0.1 where depth was measured instead.
            max_depth: Pixels that see nothing within this z-depth, metres, add nothing.
            grid_from: Where the grid of a frame comes from. Views with measured depth need none.
            weights: How much each pixel counts; None for the usual ones.
            objects: How voxels become objects; None for the usual way.
            provenance: What the map's file says about its source; options, date and version are filled in.
            device: Where torch lifts and adds up features, such as `cuda`; None for the kernels on the CPU.
        """
        if not (np.isfinite(max_depth) and max_depth > 0):
            raise ConfigError("max_depth is not usable", expected="a distance above 0 m", got=max_depth)
        if grid_from not in get_args(GridFrom):
            raise ConfigError("grid_from is not known", expected=" or ".join(get_args(GridFrom)), got=grid_from)
        if encoder.contract == "logits" and len(encoder.labels) != encoder.dim:
            raise ModelError(
                f"encoder {encoder.name} does not name its channels", expected=encoder.dim, got=len(encoder.labels)
            )
        if voxel_size is not None:
            VoxelMap(voxel_size, encoder.dim, contract=encoder.contract)  # raises now rather than at the first frame
        self._encoder = encoder
        self._voxel_size = voxel_size
        self._max_depth = float(max_depth)
        self._grid_from: GridFrom = grid_from
        self._provenance = provenance or Provenance()
        self._weights = weights or PixelWeights()
        self._device = device
        self._voxels: VoxelMap | None = None
        self._movable: VoxelMap | None = None  # voxels of classes that can move, until it is known whether they did
        self._layers: list[DynamicLayer] = []
        self._objects: ObjectBuilder | None = None
        self._object_config = objects
        self._class_names: tuple[str, ...] = ()
        self._frames: list[KeyFrame] = []

    def integrate(self, frame: Frame) -> None:
        """Add one frame; frames may come in any order, each once. When it raises, the map is as it was before."""
        if not frame.views:
            raise DataError(f"frame {frame.index} has no views", expected="at least one image with its camera")
        if any(frame.index == known.index for known in self._frames):
            raise DataError(
                f"frame {frame.index} is in the map already",
                expected="each frame once",
                fix="give frames different indices",
            )
        # occupancy: the frame's own grid, or one from its LiDAR points
        grid = self._grid(frame) if any(view.depth is None for view in frame.views) else None
        voxel_size = self._size(grid)
        # depth: which voxel each pixel sees (Eq. 5-9)
        seen = [self._see(view, grid, voxel_size) for view in frame.views]
        # features: cells of the images, or masks with a vector each, added up over the pixels of each voxel
        cells = self._encode(frame)
        lifted = join([
            lift(one.rows, len(one.labels), features, image=view.image,
                 sight=Sight(view.camera, one.depth, self._weights), view=number, device=self._device)
            for number, (view, one, features) in enumerate(zip(frame.views, seen, cells, strict=True))
        ])  # fmt: skip
        check_finite(lifted.sums, f"features of frame {frame.index}")
        # voxels: added to what earlier frames saw
        names = self._class_names or (grid.class_names if grid is not None else ())
        voxels, movable = self._voxels, self._movable
        if voxels is None or movable is None:
            size, dim, contract = voxel_size, self._encoder.dim, self._encoder.contract
            voxels, movable = (
                VoxelMap(size, dim, contract=contract, num_classes=len(names), device=self._device) for _ in range(2)
            )
        self._look_through(voxels, frame, seen, grid)
        cover, labels = _stacked(seen)
        moves = np.isin(np.arange(256), [names.index(name) for name in MOVABLE if name in names])[labels]
        voxels.integrate(cover.only(~moves), lifted, time=frame.timestamp, labels=labels, frame=frame.index)
        if moves.any():
            apart = cover.only(moves)
            movable.integrate(apart, lifted, time=frame.timestamp, labels=labels, frame=frame.index)
            self._layers.append(layer_of(apart, lifted, frame=frame.index, time=frame.timestamp))
        self._voxels, self._movable, self._class_names = voxels, movable, names
        # objects: segments of this frame, followed over frames
        if self._objects is None:
            self._objects = ObjectBuilder(
                voxel_size, names=names, labels=tuple(self._encoder.labels), config=self._object_config
            )
        views = [(view.name, one.rows, len(one.labels)) for view, one in zip(frame.views, seen, strict=True)]
        self._objects.observe(gather(views, cover, labels, lifted, frame=frame, voxel_size=voxel_size,
                                     contract=self._encoder.contract, grid=grid,
                                     sights=[(one.depth, f if isinstance(f, FeatureMap) else None)
                                             for one, f in zip(seen, cells, strict=True)]))  # fmt: skip
        cameras = tuple(NamedCamera.of(view.camera, view.name) for view in frame.views)
        self._frames.append(KeyFrame(frame.index, frame.timestamp, frame.T_world_ego, cameras))

    @property
    def voxel_size(self) -> float:
        """Metres; DEFAULT_VOXEL_SIZE before the first frame where none was asked for."""
        return self._size(None)

    @property
    def objects(self) -> ObjectBuilder | None:
        """What follows the things of the drive; None before the first frame."""
        return self._objects

    def snapshot(self) -> SceneMap:
        """Return the map of all frames so far; it does not change when more follow.

        Voxels that more frames saw through than saw are left out, and so is what moved: that is in `SceneMap.dynamic`.
        """
        if self._voxels is None or self._movable is None:
            raise DataError("there is no map yet", expected="at least 1 frame", got=0, fix="integrate a frame first")
        encoder = EncoderInfo.of(self._encoder)
        voxels, dynamic = self._settled(self._voxels, self._movable)
        assert self._objects is not None, "integrate makes it with the first frame"
        tree = self._objects.tree(voxels, [frame.T_world_ego for frame in self._frames])
        objects = with_sightings(tree, voxels, self._frames)
        options = {"voxel_size": voxels.voxel_size, "max_depth": self._max_depth, "grid_from": self._grid_from,
                   "weights": asdict(self._weights)}  # fmt: skip
        provenance = replace(
            self._provenance,
            options={**options, **self._provenance.options},
            date=datetime.now(UTC).isoformat(timespec="seconds"),
            version=__version__,
        )
        return SceneMap(voxels, objects, encoder, tuple(self._frames), provenance, self._class_names, dynamic)

    def _settled(self, voxels: VoxelMap, movable: VoxelMap) -> tuple[VoxelMap, tuple[DynamicLayer, ...]]:
        """Return the still map, and the layers of what moved."""
        voxels = voxels.copy()
        moved = moving(self._layers, movable, voxels.free)
        still = standing(self._layers, moved)
        if len(still):
            voxels.merge(movable.subset(np.isin(pack(movable.keys), still)))
        there = voxels.log_odds >= 0
        if not there.all():
            voxels = voxels.subset(there)
        layers = (layer.only(m) for layer, m in zip(self._layers, moved, strict=True))
        return voxels, tuple(layer for layer in layers if len(layer.keys))

    def _look_through(
        self, voxels: VoxelMap, frame: Frame, seen: Sequence["_Seen"], grid: OccupancyGrid | None
    ) -> None:
        """Record where the views of a frame saw nothing."""
        measured = [(v.camera, one.depth) for v, one in zip(frame.views, seen, strict=True) if v.depth is not None]
        rendered = [(v.camera, one.depth) for v, one in zip(frame.views, seen, strict=True) if v.depth is None]
        voxels.free.integrate(measured, max_depth=self._max_depth)
        voxels.free.integrate(rendered, grid=grid, max_depth=self._max_depth)

    def _grid(self, frame: Frame) -> OccupancyGrid:
        grid = grid_of(frame, self._grid_from)
        if self._class_names and grid.class_names != self._class_names:
            raise DataError(
                f"grid of frame {frame.index} has other classes than those before",
                expected=", ".join(self._class_names),
                got=", ".join(grid.class_names),
            )
        return grid

    def _size(self, grid: OccupancyGrid | None) -> float:
        if self._voxels is not None:
            return self._voxels.voxel_size
        if self._voxel_size is not None:
            return float(self._voxel_size)
        if grid is None:
            return DEFAULT_VOXEL_SIZE
        if np.ptp(grid.spec.size) > 0:
            raise ConfigError("the grid's voxels are not cubes", got=grid.spec.voxel_size, fix="pass voxel_size")
        return float(grid.spec.size[0])

    def _see(self, view: View, grid: OccupancyGrid | None, voxel_size: float) -> "_Seen":
        """Find what each pixel of a view sees."""
        if view.depth is not None:
            rows, keys = rows_from_depth(view.depth, view.camera, voxel_size, max_depth=self._max_depth)
            return _Seen(rows, cover_keys(keys), np.full(len(keys), NO_LABEL, dtype=np.uint8), view.depth)
        assert grid is not None, "integrate makes a grid when a view has no depth"
        image = render_depth(grid, view.camera, max_depth=self._max_depth)
        rows, flat = rows_from_grid(image, grid)
        return _Seen(rows, cover_grid(flat, grid, voxel_size), grid.labels.reshape(-1)[flat], image.depth)

    def _encode(self, frame: Frame) -> list[FeatureMap] | list[Segments]:
        """Return the cells of each view, or its masks where the encoder puts out such."""
        encoder, images = self._encoder, [view.image for view in frame.views]
        masked = getattr(encoder, "has_masks", False)
        found: list[FeatureMap] | list[MaskMap] = encoder.encode_masks(images) if masked else encoder.encode(images)  # pyright: ignore[reportAttributeAccessIssue, reportUnknownMemberType]
        if len(found) != len(images):
            raise ModelError(f"encoder {encoder.name} lost images", expected=f"{len(images)} outputs", got=len(found))
        cells: list[FeatureMap] = []
        segments: list[Segments] = []
        for one, image in zip(found, images, strict=True):
            if isinstance(one, MaskMap):
                check_shape(one.embeddings, (None, encoder.dim), f"vectors of encoder {encoder.name}")
                segments.append(Segments.of(one, *image.shape[:2]))
            else:
                check_shape(one.cells, (None, None, encoder.dim), f"output of encoder {encoder.name}")
                cells.append(one)
        return segments or cells


def grid_of(frame: Frame, grid_from: GridFrom = "auto") -> OccupancyGrid:
    """Return the frame's grid: its own, or one of Occ3D's size around the ego, carved from its LiDAR returns."""
    if frame.occupancy is not None and grid_from != "lidar":
        return frame.occupancy
    if frame.points is None or grid_from == "occupancy":
        have = {"occupancy": frame.occupancy, "LiDAR points": frame.points}
        wanted = {"auto": "occupancy, LiDAR points", "lidar": "LiDAR points", "occupancy": "occupancy"}[grid_from]
        raise DataError(
            f"frame {frame.index} does not say where things are",
            expected=f"{wanted} or measured depth in every view",
            got=", ".join(name for name, value in have.items() if value is not None) or "none of them",
            fix="pass load_sequence(..., occupancy=PATTERN), or views with depth",
        )
    if "lidar" not in frame.poses:
        raise DataError(
            f"frame {frame.index} cannot be carved from its LiDAR points",
            expected="the LiDAR's pose in poses['lidar']",
            got=f"poses of {', '.join(frame.poses) or 'nothing'}",
        )
    # on the map's own lattice, so that a voxel of the grid is one of the map, from every frame
    corner = np.floor((frame.T_world_ego[:3, 3] + OCC3D_SPEC.origin) / LIDAR_SPEC.size) * LIDAR_SPEC.size
    T_world_grid = pose(corner)
    T_grid_ego = invert(T_world_grid) @ frame.T_world_ego
    points = transform(T_grid_ego, frame.points).astype(np.float32)
    sensor = (invert(T_world_grid) @ frame.poses["lidar"])[:3, 3]
    return grid_from_lidar(points, sensor, LIDAR_SPEC, T_world_grid=T_world_grid, min_range=MIN_LIDAR_RANGE)
