"""2D models as ONNX files, their cards, and the words they know."""

from openvocab_occ.segmentation.encoder import FeatureMap as FeatureMap
from openvocab_occ.segmentation.encoder import MaskMap as MaskMap
from openvocab_occ.segmentation.encoder import PixelEncoder as PixelEncoder
from openvocab_occ.segmentation.encoder import TextEncoder as TextEncoder
