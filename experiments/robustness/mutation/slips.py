"""Mutants by ordinary mistakes in all modules: an index off by one, a wrong sign, a wrong
neighbour, a missing factor, exchanged axes, a normalisation for cubic voxels only.
"""

from __future__ import annotations

from experiments.robustness.mutation.mutants import CACHE, PROJECTION, UNBIASED, Mutant

BOUNDS = "tests/system/test_out_of_bounds_access.py"
LATTICE = "tests/unit/solvers/discrete_ordinates/test_tracks.py"
SCATTERING = "tests/unit/solvers/discrete_ordinates/test_multigrid.py"
LINE_DIRECTIONS = "tests/unit/solvers/discrete_ordinates/test_directions_of_incoming_radiance.py"
SKIES = "tests/unit/solvers/discrete_ordinates/test_distant_illumination.py"
COARSER = "tests/unit/solvers/discrete_ordinates/test_multigrid_levels.py"
MEANS = "tests/unit/solvers/discrete_ordinates/test_resampling_to_larger_voxels.py"
LAMPS = "tests/unit/lights/test_falloff.py"
SURFACES = "tests/system/test_surfaces.py"
AMONG_SURFACES = "tests/system/test_sweep_with_surfaces.py"
EMISSION = "tests/system/test_emission.py"
LAYERS = "tests/system/test_aovs_and_filter.py"
GRID = "tests/unit/grids/test_grid.py"
MACROCELLS = "tests/unit/grids/test_majorants.py"
VOLUME_FILES = "tests/unit/volumes/test_readers.py"
VOLUME_FORMATS = "tests/unit/volumes/test_formats.py"
PROCESSING = "tests/unit/volumes/test_processing.py"
TRANSFER = "tests/unit/volumes/test_transfer.py"
METRICS_OF_RUNS = "tests/unit/compare/test_metrics_common_error.py"

SLIPS = (
    Mutant(
        "the way back begins a slice too far (lattice)",
        "solvers/discrete_ordinates/track_layout.py",
        "(size[axis] - 1) * slope",
        "size[axis] * slope",
        (LATTICE,),
    ),
    Mutant(
        "sharpening takes the last voxel of a box for an inner one (lattice)",
        "solvers/discrete_ordinates/tracks.py",
        "(stride, lower[k], upper[k] - 1)",
        "(stride, lower[k], upper[k])",
        (BOUNDS,),
    ),
    Mutant(
        "directions of lines against their axis not turned (lattice)",
        "solvers/discrete_ordinates/track_layout.py",
        "directions * np.sign(along)[:, None]",
        "directions",
        (LINE_DIRECTIONS,),
    ),
    Mutant(
        "lines that begin next to a side pass half a slice at least (lines)",
        "solvers/discrete_ordinates/kernel.py",
        "dr.select(voxel == self.entry, minimum(nearest, 0.5), 0.5)",
        "dr.select(voxel == self.entry, dr.maximum(nearest, 0.5), 0.5)",
        (LATTICE,),
    ),
    Mutant(
        "lines that enter between slices collide in half a slice (lines)",
        "solvers/discrete_ordinates/kernel.py",
        "dr.select(state.since_entry < 1, state.since_entry, 0.5) * first",
        "0.5 * first",
        ("tests/unit/solvers/discrete_ordinates/test_tracks_in_homogeneous_media.py",),
    ),
    Mutant(
        "passes take the rows of the pass behind them (passes)",
        "solvers/discrete_ordinates/ordinates.py",
        "np.cumsum([0] + [len(each.directions) for each in sets])",
        "np.cumsum([len(each.directions) for each in sets])",
        (AMONG_SURFACES,),
    ),
    Mutant(
        "coarse extinction as if made of eight voxels always (scattering)",
        "solvers/discrete_ordinates/multigrid.py",
        "total / len(children)",
        "total / 8",
        (COARSER,),
    ),
    Mutant(
        "coarser grids of odd sides squeezed into the box (scattering)",
        "solvers/discrete_ordinates/multigrid.py",
        "scale = ratio * sides / grid.resolution",
        "scale = np.ones(3)",
        (COARSER,),
    ),
    Mutant(
        "coarse corrections moved by half a voxel (scattering)",
        "solvers/discrete_ordinates/multigrid.py",
        "(mi.Float(at) + 0.5) * dr.opaque",
        "mi.Float(at) * dr.opaque",
        (COARSER,),
    ),
    Mutant(
        "voxels send the same light both ways (moments)",
        "solvers/discrete_ordinates/moments.py",
        "even - odd, place + step",
        "even + odd, place + step",
        (LINE_DIRECTIONS,),
    ),
    Mutant(
        "even directions without their own weights beside bright ones (directions)",
        "solvers/discrete_ordinates/incident.py",
        "        return np.where(is_even, angle * weights * uniform, angle)\n",
        "        return angle\n",
        (SKIES,),
    ),
    Mutant(
        "density of bright directions without that of their opposites (directions)",
        "solvers/discrete_ordinates/incident.py",
        "for sign in (1, -1):",
        "for sign in (1,):",
        (SKIES,),
    ),
    Mutant(
        "solid angle of lamps by the distance, not its square (lamps of the sweep)",
        "solvers/discrete_ordinates/direct_light.py",
        "cosine / (dr.square(distance) * found.pdf)",
        "cosine / (distance * found.pdf)",
        ("tests/unit/solvers/discrete_ordinates/test_direct_light_solid_angle.py",),
    ),
    Mutant(
        "each lamp as bright as their mean (lamps of the sweep)",
        "solvers/discrete_ordinates/direct_light.py",
        "weight = mi.Float(count) / mi.Float(samples)",
        "weight = 1 / mi.Float(samples)",
        ("tests/unit/solvers/discrete_ordinates/test_direct_light.py",),
    ),
    Mutant(
        "half of the solid angle of polygons (area light)",
        "lights/solid_angle.py",
        "2 * dr.abs(dr.atan2(imaginary, real))",
        "dr.abs(dr.atan2(imaginary, real))",
        ("tests/unit/lights/test_solid_angle.py",),
    ),
    Mutant(
        "emitters in closed form are hit by paths, too (area light)",
        "transport/path_tracer.py",
        "dr.select(is_direct & (emitter == each), 0, emitted)",
        "emitted",
        ("tests/system/test_area_lights.py",),
    ),
    Mutant(
        "points on emitters all stand for the same solid angle (area light)",
        "lights/solid_angle.py",
        "dr.abs(height) / away * ratio",
        "dr.abs(height) / away + 0 * ratio",
        ("tests/unit/lights/test_solid_angle.py",),
    ),
    Mutant(
        "a flat emitter with fog on both sides bounds it (area light)",
        "scene/compile.py",
        "filled += [shape] if interior != exterior else []",
        "filled += [shape]",
        ("tests/system/test_area_lights.py",),
    ),
    Mutant(
        "sample points moved away from emitters relative to themselves (falloff)",
        "lights/falloff.py",
        "lamp + self._minimum_distance * away, p",
        "p + self._minimum_distance * away, p",
        ("tests/unit/lights/test_voxel_sample_points.py",),
    ),
    Mutant(
        "halves of slices exchanged (extinction)",
        "solvers/discrete_ordinates/extinction.py",
        "halves[0] | halves[1] << 16",
        "halves[1] | halves[0] << 16",
        (LATTICE,),
    ),
    Mutant(
        "extinction at the border interpolated with the next row's (extinction)",
        "solvers/discrete_ordinates/extinction.py",
        "int(sides[k]) - 1)",
        "int(sides[k]))",
        (LATTICE,),
    ),
    Mutant(
        "blocks of voxels with their axes exchanged (baking)",
        "solvers/discrete_ordinates/resampling.py",
        "np.ndindex(*block[::-1])",
        "np.ndindex(*block)",
        (MEANS,),
    ),
    Mutant(
        "blocks of voxels that do not fill the grid (baking)",
        "solvers/discrete_ordinates/resampling.py",
        "block = np.where(data.resolution % block == 0, block, 1)",
        "block = np.where(data.resolution % block >= 0, block, 1)",
        (MEANS,),
    ),
    Mutant(
        "rays skip one macrocell too many",
        "render/empty_space.py",
        "wall = c + clearance",
        "wall = c + clearance + 1",
        (PROJECTION,),
    ),
    Mutant(
        "errors of a segment are those of its near end",
        "render/raymarch.py",
        "near * a + far * b for",
        "near * a + far * a for",
        ("tests/unit/render/test_raymarch_errors.py",),
    ),
    Mutant(
        "what rays know of a lamp is that of the whole ray, not the segment",
        "render/raymarch.py",
        "falloff.means(self._lamps, state.t, part.end)",
        "falloff.means(self._lamps, self._near, part.end)",
        ("tests/system/test_point_lights.py",),
    ),
    Mutant(
        "emission of a segment bent to the wrong side",
        "render/quadrature.py",
        "bend = 0.5 * (sigma_a - sigma_b) * length",
        "bend = 0.5 * (sigma_b - sigma_a) * length",
        ("tests/unit/render/test_quadrature_of_emission.py",),
    ),
    Mutant(
        "behind a null surface a medium is seen from the camera on (camera rays)",
        "render/camera.py",
        "            state.near = dr.select(crosses, far, state.near)\n",
        "",
        ("tests/unit/render/test_camera_null_surfaces.py",),
    ),
    Mutant(
        "depth of media behind others as if these were clear (camera rays)",
        "render/camera.py",
        "old + scale * new for",
        "old + new for",
        ("tests/unit/render/test_camera_null_surfaces.py",),
    ),
    Mutant(
        "the last voxel interpolated with the next row's first (packets)",
        "grids/packed_fields.py",
        "max(n - 2, 0)) for n in sides",
        "max(n - 1, 0)) for n in sides",
        (BOUNDS,),
    ),
    Mutant(
        "macrocells without the voxel above them",
        "grids/majorants.py",
        "for k in range(size + 2)",
        "for k in range(size + 1)",
        (MACROCELLS,),
    ),
    Mutant(
        "the last macrocell ends at its wall",
        "grids/majorants.py",
        "cell >= limits, cell <= 0)",
        "cell > limits, cell <= 0)",
        (MACROCELLS,),
    ),
    Mutant(
        "no cell at the far border of a cut grid (edges)",
        "scene/cut_cells.py",
        "mi.Vector3f([mi.Float(n - 1) for n in self.cells])",
        "mi.Vector3f([mi.Float(n) for n in self.cells])",
        (BOUNDS,),
    ),
    Mutant(
        "tracks enter half a slice later (incoming radiance)",
        "solvers/discrete_ordinates/boundary_condition.py",
        "b, c = dr.fma(a - 0.5, read.slope_b, b)",
        "b, c = dr.fma(a, read.slope_b, b)",
        (LINE_DIRECTIONS,),
    ),
    Mutant(
        "media behind a lamp in its way (transport)",
        "transport/path.py",
        "far = dr.minimum(si.t, ray.maxt)",
        "far = dr.minimum(si.t, dr.inf)",
        ("tests/unit/transport/test_visibility.py",),
    ),
    Mutant(
        "emitters sampled one vertex too late (transport)",
        "transport/path_tracer.py",
        "(path.depth + 1 < self._max_depth)",
        "(path.depth < self._max_depth)",
        ("tests/unit/transport/test_path.py",),
    ),
    Mutant(
        "emission beyond the wall of a macrocell (tracking)",
        "transport/tracking.py",
        "end = dr.minimum(dr.select(exits_cell, cell_exit, candidate), emission_far)",
        "end = dr.minimum(candidate, emission_far)",
        (EMISSION,),
    ),
    Mutant(
        "early images take the same samples again (path)",
        "solvers/path/solver.py",
        "self._estimator.sums(voxels, 0, 2, self.size, more)",
        "self._estimator.sums(voxels, 0, 2, 0, more)",
        ("tests/unit/render/test_film.py", "tests/system/test_progressive.py"),
    ),
    Mutant(
        "a lamp in the medium shaded by what is behind it (path)",
        "solvers/path/solver.py",
        "dr.minimum(far, record.dist)",
        "dr.minimum(far, dr.inf)",
        (UNBIASED, "tests/system/test_point_lights.py"),
    ),
    Mutant(
        "the brightest light of a cache without what lamps add (cache)",
        "cache/lookups.py",
        "field.maximum *= falloff.maximum(active)",
        "field.maximum *= 1",
        ("tests/unit/cache/test_field_maximum.py",),
    ),
    Mutant(
        "light extrapolated without a limit (grid)",
        "grids/root_field.py",
        "dr.clip(outermost / dr.select(known, other, 1), 1 / STEEPEST, STEEPEST)",
        "outermost / dr.select(known, other, 1)",
        (GRID,),
    ),
    Mutant(
        "voxels half a voxel below matter are not active (cache)",
        "grids/occupancy.py",
        "dr.floor(c - extent - 0.5 - 1e-3)",
        "dr.floor(c - extent + 1e-3)",
        (CACHE,),
    ),
    Mutant(
        "width of the fixed filter by pixels without a medium, too",
        "render/denoise.py",
        "/ dr.count(valid)",
        "/ dr.width(valid)",
        ("tests/unit/render/test_denoise_symmetry_and_rejection.py",),
    ),
    Mutant(
        "crop windows filtered as if they were not moved (reconstruction)",
        "render/pixel_filter.py",
        "int(n) + 0.5) for n in film.crop_offset()",
        "0.5) for n in film.crop_offset()",
        ("tests/unit/render/test_pixel_filter.py",),
    ),
    Mutant(
        "light scattered once as if no peak had been taken away (phase functions)",
        "media/phase.py",
        "4 * np.pi / (1 - forward)",
        "4 * np.pi",
        ("tests/unit/media/test_delta_m_narrow_emitters.py",),
    ),
    Mutant(
        "axes exchanged of cells that a flame reaches (emission)",
        "media/emission.py",
        "np.diag([nx, ny, nz, 1.0])",
        "np.diag([nz, ny, nx, 1.0])",
        ("tests/unit/render/test_raymarch_segments.py",),
    ),
    Mutant(
        "lamps blurred by twice their size (directional)",
        "cache/angular.py",
        "dr.exp(-0.5 * variance)",
        "dr.exp(-variance)",
        ("tests/unit/cache/test_angular.py",),
    ),
    Mutant(
        "a volume's axes as rows of its placement (DICOM)",
        "volumes/dicom.py",
        "np.linalg.norm(stack)], axis=1)",
        "np.linalg.norm(stack)], axis=0)",
        (VOLUME_FILES,),
    ),
    Mutant(
        "a cropped volume moved along the wrong axes",
        "volumes/processing.py",
        "@ (x0, y0, z0, 1.0)",
        "@ (z0, y0, x0, 1.0)",
        (PROCESSING,),
    ),
    Mutant(
        "colours of percentiles without their lower end (transfer functions)",
        "volumes/transfer.py",
        "colour_values=low + self.colour_values",
        "colour_values=self.colour_values",
        (TRANSFER,),
    ),
    Mutant(
        "spacing of a grid file with its axes exchanged (readers)",
        "volumes/mitsuba_files.py",
        "values.shape[2::-1]",
        "values.shape[:3]",
        (VOLUME_FILES,),
    ),
    Mutant(
        "the origin of VTK image data taken for its first voxel (readers)",
        "volumes/vti_files.py",
        "grid.direction @ (grid.spacing * extent[:, 0])",
        "grid.direction @ (0 * grid.spacing)",
        (VOLUME_FORMATS,),
    ),
    Mutant(
        "values of decreasing coordinates not reversed (readers)",
        "volumes/netcdf_files.py",
        "if placed[axis].is_reversed:",
        "if False:",
        (VOLUME_FORMATS,),
    ),
    Mutant(
        "extinction of a cloud from half the cross section of its droplets (clouds)",
        "volumes/clouds.py",
        "1.5 * content",
        "0.75 * content",
        ("tests/unit/volumes/test_clouds.py",),
    ),
    Mutant(
        "two runs compared with the same half of a reference (metrics)",
        "compare/metrics.py",
        "np.mean((x - a) * (y - b), dtype",
        "np.mean((x - a) * (y - a), dtype",
        (METRICS_OF_RUNS,),
    ),
    Mutant(
        "noise of a difference taken for that of one run (metrics)",
        "compare/metrics.py",
        "root(0.5 * np.mean(",
        "root(np.mean(",
        (METRICS_OF_RUNS,),
    ),
)
