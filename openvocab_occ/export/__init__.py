"""Maps to files that others read."""
