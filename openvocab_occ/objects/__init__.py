"""Objects, their tree, and the scene map with its files."""
