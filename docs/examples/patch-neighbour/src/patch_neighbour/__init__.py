"""The package of the matcher patch-neighbour."""
