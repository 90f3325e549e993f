"""Voxel grids, fields on them, boundaries, majorants, occupancy, 16-bit copies for rays."""
