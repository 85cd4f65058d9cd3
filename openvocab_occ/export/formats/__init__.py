"""Maps in the file formats of others, and points from them."""

from openvocab_occ.export.formats.cloud import Cloud as Cloud
from openvocab_occ.export.formats.convert import convert as convert
from openvocab_occ.export.formats.convert import read_cloud as read_cloud
from openvocab_occ.export.formats.octomap import Octree as Octree
from openvocab_occ.export.formats.octomap import read_bt as read_bt
