"""A Mitsuba scene as the solvers see it: checks, fingerprint, surfaces among voxels."""
