"""Poses, cameras and grids: the ground that everything else stands on."""

from openvocab_occ.geometry.axes import T_EGO_CAM_AXES as T_EGO_CAM_AXES
from openvocab_occ.geometry.axes import T_OPENGL_OPENCV as T_OPENGL_OPENCV
from openvocab_occ.geometry.axes import turn_up as turn_up
from openvocab_occ.geometry.camera import Camera as Camera
from openvocab_occ.geometry.grid import GridSpec as GridSpec
from openvocab_occ.geometry.pose import as_pose as as_pose
from openvocab_occ.geometry.pose import invert as invert
from openvocab_occ.geometry.pose import look_at as look_at
from openvocab_occ.geometry.pose import matrix_from_wxyz as matrix_from_wxyz
from openvocab_occ.geometry.pose import pose as pose
from openvocab_occ.geometry.pose import transform as transform
from openvocab_occ.geometry.pose import wxyz_from_matrix as wxyz_from_matrix
from openvocab_occ.geometry.trajectory import Trajectory as Trajectory
from openvocab_occ.geometry.trajectory import interpolate as interpolate
