"""LMPOcc's experiments on the demo city."""
