"""Voxel grids: placement, interpolation, majorants, occupancy, and bounding shapes."""
