"""The camera's view of a grid."""
