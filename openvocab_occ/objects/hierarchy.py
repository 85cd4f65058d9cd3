"""x."""
from openvocab_occ.objects.tree import *
from openvocab_occ.objects.group import _scene
from dataclasses import replace
def build_tree(objects, voxels, *, names=(), labels=(), ego=()):
    root=_scene(voxels,0)
    return ObjectTree([replace(root,children=tuple(o.id for o in objects)),*objects])
