"""Poses, cameras and grids: the ground that everything else stands on."""

from openvocab_occ.geometry.camera import Camera as Camera
from openvocab_occ.geometry.grid import GridSpec as GridSpec
from openvocab_occ.geometry.pose import as_pose as as_pose
from openvocab_occ.geometry.pose import invert as invert
from openvocab_occ.geometry.pose import look_at as look_at
from openvocab_occ.geometry.pose import matrix_from_wxyz as matrix_from_wxyz
from openvocab_occ.geometry.pose import pose as pose
from openvocab_occ.geometry.pose import transform as transform
from openvocab_occ.geometry.pose import wxyz_from_matrix as wxyz_from_matrix
