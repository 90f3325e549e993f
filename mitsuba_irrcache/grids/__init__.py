"""Voxel grids, fields on them, majorants and occupied voxels."""
