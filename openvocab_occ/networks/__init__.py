"""Occupancy networks in plain PyTorch, and the long-term memory that they read and write (LMPOcc)."""
