"""Words to hits."""

from openvocab_occ.query.answer import Answer as Answer
from openvocab_occ.query.answer import Hit as Hit
from openvocab_occ.query.find import score_voxels as score_voxels
