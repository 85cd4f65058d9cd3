"""More than one map: cut out, put side by side, merge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from jaxtyping import Bool, Float

from openvocab_occ.errors import ConfigError, DataError, EncoderMismatchError
from openvocab_occ.geometry import transform
from openvocab_occ.mapping import DynamicLayer, VoxelMap, keys_of
from openvocab_occ.objects import KeyFrame, NamedCamera, ObjectTree, Provenance, SceneMap, SceneObject, group_objects
from openvocab_occ.objects.sightings import with_sightings
from openvocab_occ.objects.tree import without
from openvocab_occ.pipeline.compare import diff

MIN_OVERLAP = 0.5
"""Least share of the smaller map's voxels that must find a partner within one voxel for an alignment to count."""
_MIN_POINTS = 100


@dataclass(frozen=True, eq=False)
class Alignment:
    """How two maps were brought together."""

    T_a_b: Float[np.ndarray, "4 4"]
    """World of b to world of a."""
    overlap: float
    """Share of the voxels of the smaller map that have a partner within one voxel."""
    rmse_m: float
    """Root mean square distance of partners."""


@dataclass(frozen=True, eq=False)
class Merged:
    """A merged map, and what it took."""

    scene: SceneMap
    alignment: Alignment | None
    """None where both maps were taken to be of one frame."""
    gone: int
    """Voxels of the earlier map that the later one saw through."""


def crop(scene: SceneMap, region: Float[np.ndarray, "2 3"]) -> SceneMap:
    """Return the voxels whose centres lie in the region (lower and upper corner, metres), and the objects they are of.

    Box and embedding of an object that is cut remain those of the whole. Frames are kept: their views are of them all.
    """
    if region.shape != (2, 3) or not np.isfinite(region).all() or (region[0] >= region[1]).any():
        raise ConfigError("region is not a box", expected="lower and upper corner, metres", got=region.tolist())
    return only(scene, ((scene.voxels.centers >= region[0]) & (scene.voxels.centers < region[1])).all(axis=1))


def only(scene: SceneMap, chosen: Bool[np.ndarray, " n"]) -> SceneMap:
    """Return some voxels of a map and the objects they are of; see `crop`."""
    return replace(scene, voxels=scene.voxels.subset(chosen), objects=ObjectTree(_kept(scene, chosen)))


def concat(scenes: Sequence[SceneMap]) -> SceneMap:
    """Put maps of one frame that share no voxel below one another; the objects of each are kept as they are.

    Undoes `crop`. Maps that overlap raise DataError: those are to be merged.
    """
    if not scenes:
        raise DataError("there is nothing to put together", expected="at least 1 map", got=0)
    first, *others = scenes
    for other in others:
        _check_same_kind(first, other)
    voxels = VoxelMap(
        first.voxels.voxel_size, first.voxels.dim, contract=first.voxels.contract, num_classes=first.voxels.num_classes
    )
    for scene in scenes:
        shared = int((voxels.index(scene.voxels.keys) >= 0).sum())
        if shared:
            raise DataError("maps share voxels", expected="none in common", got=shared, fix="merge them")
        voxels.merge(scene.voxels)
    nodes = [replace(first.objects.root, children=())]
    for scene in scenes:
        up = max(node.id for node in nodes)
        at = voxels.index(scene.voxels.keys)
        nodes += [
            replace(
                node, id=node.id + up, voxels=at[node.voxels], children=tuple(child + up for child in node.children),
                parent=node.parent + up if node.parent else node.parent,
            )
            for node in scene.objects.nodes
            if node.id
        ]  # fmt: skip
    nodes[0] = replace(nodes[0], children=tuple(node.id for node in nodes[1:] if node.parent == 0))
    frames = {frame.index: frame for scene in scenes for frame in scene.frames}
    layers = {layer.frame: layer for scene in scenes for layer in scene.dynamic}
    return replace(
        first,
        voxels=voxels,
        objects=ObjectTree(nodes),
        frames=tuple(frames[index] for index in sorted(frames)),
        dynamic=tuple(layers[index] for index in sorted(layers)),
        provenance=_provenance(scenes, "concat"),
    )


def merge(a: SceneMap, b: SceneMap, *, align: bool = False) -> Merged:
    """Merge two drives of one place, as if one builder had seen all their frames; objects are grouped anew.

    Voxels of the drive that ended first are left out where the other, if all of it is later, looked through them: what
    left between the drives is gone. Frames of b are numbered on from those of a.

    Args:
        a: Its world is the frame of the result.
        b: Of the same frame, or with `align` of one near enough for ICP (a metre and a few degrees).
        align: Bring b to a by point-to-plane ICP on the voxels' centres.

    Raises:
        EncoderMismatchError: The maps were made by different encoders.
        DataError: The alignment is poor: fewer than half of the voxels of the smaller map find a partner.
    """
    _check_same_kind(a, b)
    alignment = aligned(a, b) if align else None
    first = max((frame.index for frame in a.frames), default=-1) + 1
    shift = max(first - min((frame.index for frame in b.frames), default=first), 0)
    T = np.eye(4) if alignment is None else alignment.T_a_b
    there = b.voxels.moved(T, first_frame=shift) if shift or alignment else b.voxels
    moved = replace(b, voxels=there)
    gone = _gone(a, moved)
    voxels = a.voxels.subset(~gone[0])
    voxels.merge(there.subset(~gone[1]))
    voxels = voxels.subset(voxels.log_odds >= 0)
    frames = (*a.frames, *(_moved_frame(frame, T, shift) for frame in b.frames))
    layers = (*a.dynamic, *(_moved_layer(layer, T, shift, voxels.voxel_size) for layer in b.dynamic))
    grouped = group_objects(voxels, labels=a.encoder.labels, class_names=a.class_names)
    objects = with_sightings(grouped, voxels, frames)
    made = _provenance((a, b), "merge")
    scene = SceneMap(voxels, objects, a.encoder, frames, made, a.class_names, layers)
    return Merged(scene, alignment, int(gone[0].sum() + gone[1].sum()))


def aligned(a: SceneMap, b: SceneMap) -> Alignment:
    """Find the rigid motion that brings map b onto map a."""
    import open3d as o3d

    if min(len(a.voxels), len(b.voxels)) < _MIN_POINTS:
        raise DataError(
            "maps are too small to align", expected=f"{_MIN_POINTS} voxels", got=(len(a.voxels), len(b.voxels))
        )
    size = a.voxels.voxel_size
    clouds = []
    for scene in (b, a):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scene.voxels.centers.copy()))
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=4 * size, max_nn=30))
        clouds.append(cloud)
    T = np.eye(4)
    for reach in (5 * size, 2.5 * size, 1.5 * size):  # from far to near
        result = o3d.pipelines.registration.registration_icp(
            *clouds, reach, T, o3d.pipelines.registration.TransformationEstimationPointToPlane()
        )
        T = np.array(result.transformation)
    back = len(b.voxels) > len(a.voxels)  # judged from the smaller map's side
    source, target = (clouds[1], clouds[0]) if back else (clouds[0], clouds[1])
    pose = np.linalg.inv(T) if back else T
    fit = o3d.pipelines.registration.evaluate_registration(source, target, size, pose)
    if fit.fitness < MIN_OVERLAP:
        raise DataError(
            "maps could not be aligned",
            expected=f"a partner within {size:g} m for {MIN_OVERLAP:.0%} of the voxels",
            got=f"{fit.fitness:.0%}",
            fix="give poses of one frame, or start nearer",
        )
    R, _, Rt = np.linalg.svd(T[:3, :3])  # a pose to the last bit
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = R @ Rt, T[:3, 3]
    return Alignment(rigid, float(fit.fitness), float(fit.inlier_rmse))


def _gone(a: SceneMap, b: SceneMap) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " m"]]:
    """Tell which voxels of each map the other, if it is all later, saw through."""
    none = np.zeros(len(a.voxels), dtype=bool), np.zeros(len(b.voxels), dtype=bool)
    if not len(a.voxels) or not len(b.voxels):
        return none
    if a.voxels.last_seen.max() < b.voxels.first_seen.min():
        none[0][diff(a, b).vanished] = True
    elif b.voxels.last_seen.max() < a.voxels.first_seen.min():
        none[1][diff(b, a).vanished] = True
    return none


def _check_same_kind(a: SceneMap, b: SceneMap) -> None:
    if a.encoder.fingerprint != b.encoder.fingerprint:
        raise EncoderMismatchError(
            "maps were made by different encoders",
            expected=f"{a.encoder.name} ({a.encoder.fingerprint[:12]})",
            got=f"{b.encoder.name} ({b.encoder.fingerprint[:12]})",
            fix="build both with one encoder",
        )
    for name, one, other in (
        ("voxel sizes", a.voxels.voxel_size, b.voxels.voxel_size),
        ("occupancy classes", a.class_names, b.class_names),
    ):
        if one != other:
            raise ConfigError(f"maps have different {name}", expected=one, got=other)


def _kept(scene: SceneMap, inside: Bool[np.ndarray, " n"]) -> list[SceneObject]:
    """Return the nodes that hold voxels inside, with their new positions."""
    at = np.cumsum(inside) - 1
    nodes, gone = [], set()
    for node in scene.objects.nodes:
        chosen = inside[node.voxels]
        if len(chosen) and not chosen.any():
            gone.add(node.id)
        nodes.append(replace(node, voxels=at[node.voxels[chosen]], points=node.points[chosen]))
    return without(nodes, gone)


def _moved_frame(frame: KeyFrame, T: Float[np.ndarray, "4 4"], shift: int) -> KeyFrame:
    cameras = tuple(NamedCamera.of(camera.at(T @ camera.T_world_cam), camera.name) for camera in frame.cameras)
    return KeyFrame(frame.index + shift, frame.timestamp, T @ frame.T_world_ego, cameras)


def _moved_layer(layer: DynamicLayer, T: Float[np.ndarray, "4 4"], shift: int, size: float) -> DynamicLayer:
    keys = keys_of(transform(T, (layer.keys + 0.5) * size), size)
    keys, first = np.unique(keys, axis=0, return_index=True)
    return replace(layer, frame=layer.frame + shift, keys=keys, thing=layer.thing[first])


def _provenance(scenes: Sequence[SceneMap], how: str) -> Provenance:
    names = [scene.provenance.name for scene in scenes]
    return replace(
        scenes[0].provenance,
        name=reduce(lambda a, b: a if a == b else f"{a} + {b}", names),
        synthetic=any(scene.provenance.synthetic for scene in scenes),
        options={**scenes[0].provenance.options, how: names},
    )
