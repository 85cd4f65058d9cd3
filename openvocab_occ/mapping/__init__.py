"""Features onto voxels, fused over frames."""
