"""The solver ``sweep``: discrete ordinates along long characteristics.

The modules in the order of the method:

- `solver` (`Sweep`): batches of ordinate sets, and how their results become the cache's values;
  `anisotropic`: the same for spherical-harmonic moments
- `angular_quadrature`, `incident`, `ordinates`: directions, weights, incoming radiance along them
- `boundary_condition`, `crossings`: radiance from surfaces around the medium and among its voxels
- `resampling`, `extinction`, `empty_space`: the medium in the form that tracks read
- `tracks`, `track_layout`, `track_record`, `track_table`, `kernel`, `layout`: transport sweeps
- `multigrid`, `anderson`: multiple scattering by source iteration, and its acceleration
- `moments`: anisotropic scattering
- `direct_light`, `direct_emission`, `refracted_light`: sources that are sampled voxel by voxel

E. E. Lewis and W. F. Miller, *Computational Methods of Neutron Transport*, 1984, treat the method;
M. L. Adams and E. W. Larsen, *Fast iterative methods for discrete-ordinates particle transport
calculations*, Progress in Nuclear Energy 40, 2002, its acceleration.
"""
