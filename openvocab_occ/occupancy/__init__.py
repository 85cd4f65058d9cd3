"""Occupancy grids, and rays through them."""

from openvocab_occ.occupancy.grid import GEOMETRY_CLASSES as GEOMETRY_CLASSES
from openvocab_occ.occupancy.grid import OCC3D_CLASSES as OCC3D_CLASSES
from openvocab_occ.occupancy.grid import OCC3D_FREE as OCC3D_FREE
from openvocab_occ.occupancy.grid import OCC3D_SPEC as OCC3D_SPEC
from openvocab_occ.occupancy.grid import OccupancyGrid as OccupancyGrid
from openvocab_occ.occupancy.lidar import grid_from_lidar as grid_from_lidar
from openvocab_occ.occupancy.occ3d import Occ3DMasks as Occ3DMasks
from openvocab_occ.occupancy.occ3d import read_occ3d as read_occ3d
from openvocab_occ.occupancy.occ3d import read_occ3d_masks as read_occ3d_masks
from openvocab_occ.occupancy.occ3d import write_occ3d as write_occ3d
from openvocab_occ.occupancy.rays import RayHits as RayHits
from openvocab_occ.occupancy.rays import cast_rays as cast_rays
from openvocab_occ.occupancy.visibility import Visibility as Visibility
from openvocab_occ.occupancy.visibility import observe as observe
from openvocab_occ.occupancy.visibility import visibility_mask as visibility_mask
