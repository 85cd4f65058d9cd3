"""Occupancy grids, and rays through them."""

from openvocab_occ.occupancy.grid import GEOMETRY_CLASSES as GEOMETRY_CLASSES
from openvocab_occ.occupancy.grid import OCC3D_CLASSES as OCC3D_CLASSES
from openvocab_occ.occupancy.grid import OCC3D_FREE as OCC3D_FREE
from openvocab_occ.occupancy.grid import OCC3D_SPEC as OCC3D_SPEC
from openvocab_occ.occupancy.grid import OccupancyGrid as OccupancyGrid
