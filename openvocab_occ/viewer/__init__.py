"""The map in a web browser."""

from openvocab_occ.viewer.server import Viewer as Viewer
from openvocab_occ.viewer.server import view as view
