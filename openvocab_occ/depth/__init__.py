"""The camera's view of a grid."""

from openvocab_occ.depth.image import DepthImage as DepthImage
from openvocab_occ.depth.render import render_depth as render_depth
