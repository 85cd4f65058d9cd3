"""Features onto voxels, fused over frames."""

from openvocab_occ.mapping.cover import Cover as Cover
from openvocab_occ.mapping.cover import cover_grid as cover_grid
from openvocab_occ.mapping.cover import cover_keys as cover_keys
from openvocab_occ.mapping.cover import rows_from_depth as rows_from_depth
from openvocab_occ.mapping.cover import rows_from_grid as rows_from_grid
from openvocab_occ.mapping.free_space import FreeSpace as FreeSpace
from openvocab_occ.mapping.keys import keys_of as keys_of
from openvocab_occ.mapping.layers import DynamicLayer as DynamicLayer
from openvocab_occ.mapping.lift import Lifted as Lifted
from openvocab_occ.mapping.lift import PixelWeights as PixelWeights
from openvocab_occ.mapping.lift import Segments as Segments
from openvocab_occ.mapping.lift import Sight as Sight
from openvocab_occ.mapping.lift import join as join
from openvocab_occ.mapping.lift import lift as lift
from openvocab_occ.mapping.records import NO_LABEL as NO_LABEL
from openvocab_occ.mapping.voxel_map import VoxelMap as VoxelMap
