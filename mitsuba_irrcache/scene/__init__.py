"""Description of a Mitsuba scene for the solvers: checks, fingerprint, surfaces among voxels."""
