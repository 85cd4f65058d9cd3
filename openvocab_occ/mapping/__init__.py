"""Features onto voxels, fused over frames."""

from openvocab_occ.mapping.keys import keys_of as keys_of
from openvocab_occ.mapping.lift import Lifted as Lifted
from openvocab_occ.mapping.lift import join as join
from openvocab_occ.mapping.lift import lift as lift
from openvocab_occ.mapping.lift import rows_from_depth as rows_from_depth
from openvocab_occ.mapping.lift import rows_from_grid as rows_from_grid
from openvocab_occ.mapping.voxel_map import NO_LABEL as NO_LABEL
from openvocab_occ.mapping.voxel_map import VoxelMap as VoxelMap
