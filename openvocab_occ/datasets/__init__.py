"""Drives read from files of many kinds, and a made-up one."""

from openvocab_occ.datasets.frame import Frame as Frame
from openvocab_occ.datasets.frame import FrameSequence as FrameSequence
from openvocab_occ.datasets.frame import View as View
from openvocab_occ.datasets.recording_writer import write_recording as write_recording
from openvocab_occ.datasets.registry import load_sequence as load_sequence
