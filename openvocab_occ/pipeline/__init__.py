"""From frames to a map."""

from openvocab_occ.pipeline.build import MapBuilder as MapBuilder
from openvocab_occ.pipeline.build import build_map as build_map
from openvocab_occ.pipeline.build import grid_of as grid_of
