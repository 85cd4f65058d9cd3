"""Open-vocabulary 3D maps from occupancy.

    import openvocab_occ as ovo

    sequence = ovo.load_sequence("nuscenes-infos", "keyframe/")
    encoder = ovo.load_encoder("segmenter.onnx")
    scene = ovo.build_map(sequence, encoder)
    print(ovo.find(scene, "road").explain())

Names load on first use (PEP 562), so that importing this package loads nothing heavy.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from openvocab_occ._version import __version__ as __version__

if TYPE_CHECKING:
    from openvocab_occ.datasets.frame import Frame as Frame
    from openvocab_occ.datasets.frame import View as View
    from openvocab_occ.datasets.registry import load_sequence as load_sequence
    from openvocab_occ.depth.render import DepthImage as DepthImage
    from openvocab_occ.depth.render import render_depth as render_depth
    from openvocab_occ.export.views import export_views as export_views
    from openvocab_occ.geometry.camera import Camera as Camera
    from openvocab_occ.geometry.grid import GridSpec as GridSpec
    from openvocab_occ.mapping.voxel_map import VoxelMap as VoxelMap
    from openvocab_occ.memory.tile_map import TileMap as TileMap
    from openvocab_occ.memory.window import Prior as Prior
    from openvocab_occ.networks.predictor import load_network as load_network
    from openvocab_occ.objects.scene_map import SceneMap as SceneMap
    from openvocab_occ.objects.tree import ObjectTree as ObjectTree
    from openvocab_occ.objects.tree import SceneObject as SceneObject
    from openvocab_occ.occupancy.grid import OccupancyGrid as OccupancyGrid
    from openvocab_occ.occupancy.rays import RayHits as RayHits
    from openvocab_occ.occupancy.rays import cast_rays as cast_rays
    from openvocab_occ.occupancy.visibility import visibility_mask as visibility_mask
    from openvocab_occ.pipeline.build import MapBuilder as MapBuilder
    from openvocab_occ.pipeline.build import build_map as build_map
    from openvocab_occ.query.find import Answer as Answer
    from openvocab_occ.query.find import find as find
    from openvocab_occ.segmentation.encoder import PixelEncoder as PixelEncoder
    from openvocab_occ.segmentation.encoder import TextEncoder as TextEncoder
    from openvocab_occ.segmentation.onnx import load_encoder as load_encoder
    from openvocab_occ.viewer.server import view as view

_HOME = {
    "Answer": "openvocab_occ.query.find",
    "Camera": "openvocab_occ.geometry.camera",
    "DepthImage": "openvocab_occ.depth.render",
    "Frame": "openvocab_occ.datasets.frame",
    "GridSpec": "openvocab_occ.geometry.grid",
    "MapBuilder": "openvocab_occ.pipeline.build",
    "ObjectTree": "openvocab_occ.objects.tree",
    "OccupancyGrid": "openvocab_occ.occupancy.grid",
    "PixelEncoder": "openvocab_occ.segmentation.encoder",
    "Prior": "openvocab_occ.memory.window",
    "RayHits": "openvocab_occ.occupancy.rays",
    "SceneMap": "openvocab_occ.objects.scene_map",
    "SceneObject": "openvocab_occ.objects.tree",
    "TextEncoder": "openvocab_occ.segmentation.encoder",
    "TileMap": "openvocab_occ.memory.tile_map",
    "View": "openvocab_occ.datasets.frame",
    "VoxelMap": "openvocab_occ.mapping.voxel_map",
    "build_map": "openvocab_occ.pipeline.build",
    "cast_rays": "openvocab_occ.occupancy.rays",
    "export_views": "openvocab_occ.export.views",
    "find": "openvocab_occ.query.find",
    "load_encoder": "openvocab_occ.segmentation.onnx",
    "load_network": "openvocab_occ.networks.predictor",
    "load_sequence": "openvocab_occ.datasets.registry",
    "render_depth": "openvocab_occ.depth.render",
    "view": "openvocab_occ.viewer.server",
    "visibility_mask": "openvocab_occ.occupancy.visibility",
}
__all__ = [*_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
        globals()[name] = value  # the next access skips this function
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*_HOME, "__version__"])
