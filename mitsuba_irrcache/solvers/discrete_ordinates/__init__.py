"""The solver ``sweep``: discrete ordinates along long characteristics.

The modules in the order of the method:

- `solver` (`Sweep`): batches of ordinate sets, and how their results become the cache's values;
  `anisotropic`: the same for spherical-harmonic moments
- `angular_quadrature`, `incident`, `ordinates`: directions, weights, and what enters along them
- `boundary_condition`: radiance that surfaces around the medium send into it
- `resampling`, `extinction`, `empty_space`: the medium as tracks read it
- `tracks`, `track_record`, `track_table`, `kernel`, `layout`: transport sweeps along tracks
- `multigrid`, `anderson`: multiple scattering by source iteration, and its acceleration
- `moments`: anisotropic scattering
- `direct_light`, `direct_emission`: sources that are sampled voxel by voxel instead

E. E. Lewis and W. F. Miller, *Computational Methods of Neutron Transport*, 1984, treat the method;
M. L. Adams and E. W. Larsen, *Fast iterative methods for discrete-ordinates particle transport
calculations*, Progress in Nuclear Energy 40, 2002, its acceleration.
"""
