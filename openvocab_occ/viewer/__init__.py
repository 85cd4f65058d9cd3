"""The map in a web browser."""
