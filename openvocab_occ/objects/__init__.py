"""Objects, their tree, and the scene map with its files."""

from openvocab_occ.objects.box import Box as Box
from openvocab_occ.objects.group import group_objects as group_objects
from openvocab_occ.objects.scene_map import EncoderInfo as EncoderInfo
from openvocab_occ.objects.scene_map import KeyFrame as KeyFrame
from openvocab_occ.objects.scene_map import NamedCamera as NamedCamera
from openvocab_occ.objects.scene_map import Provenance as Provenance
from openvocab_occ.objects.scene_map import SceneMap as SceneMap
from openvocab_occ.objects.tree import ObjectTree as ObjectTree
from openvocab_occ.objects.tree import SceneObject as SceneObject
