"""Monte Carlo: paths from every voxel of the cache."""
