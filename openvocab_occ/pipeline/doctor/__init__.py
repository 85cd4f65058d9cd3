"""Looks at a drive before hours are spent on it, and says in plain words what is wrong."""

from openvocab_occ.pipeline.doctor.examine import Diagnosis as Diagnosis
from openvocab_occ.pipeline.doctor.examine import examine as examine
from openvocab_occ.pipeline.doctor.finding import Finding as Finding
