"""2D models as ONNX files, their cards, and the words they know."""
