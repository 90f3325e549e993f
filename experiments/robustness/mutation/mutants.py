"""Typical faults: each changes one line of the library, and lists the tests that should fail."""

from __future__ import annotations

from dataclasses import dataclass

CLOSED_FORMS = "tests/correctness/test_closed_forms.py"
SWEEP = "tests/system/test_sweep.py"
UNBIASED = "tests/system/test_path_is_unbiased.py"
PROJECTION = "tests/unit/render/test_raymarch.py"
CACHE = "tests/unit/cache/test_volume.py"
MOMENTS = "tests/unit/solvers/discrete_ordinates/test_moments.py"
PHASE = "tests/system/test_anisotropic_scattering.py"


@dataclass(frozen=True)
class Mutant:
    """Replace ``old``, which occurs once in ``file`` (of mitsuba_irrcache), by ``new``."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


MUTANTS = (
    Mutant(
        "a factor 4 pi dropped (projection)",
        "render/raymarch.py",
        "albedo * phi * dr.inv_four_pi, extras",
        "albedo * phi, extras",
        (CLOSED_FORMS,),
    ),
    Mutant(
        "1 % of what is scattered lost (sweep)",
        "solvers/discrete_ordinates/multigrid.py",
        "phi * self.albedo * dr.inv_four_pi",
        "phi * self.albedo * (0.99 * dr.inv_four_pi)",
        (SWEEP,),
    ),
    Mutant(
        "cache voxels shifted by half a voxel",
        "grids/grid.py",
        "*self.voxel_indices(index)) + 0.5)",
        "*self.voxel_indices(index)))",
        (CLOSED_FORMS,),
    ),
    Mutant(
        "lookups shifted by half a voxel",
        "grids/grid.py",
        "s = clipped(u - 0.5, 0.0",
        "s = clipped(u, 0.0",
        ("tests/unit/grids/test_grid.py",),
    ),
    Mutant(
        "what rays read of a volume always rounded down",
        "grids/packed_fields.py",
        " + (noise >> (32 - DROPPED))",
        "",
        ("tests/unit/grids/test_grid.py",),
    ),
    Mutant(
        "a bias of e^-x that adds up over steps",
        "core/fast_math.py",
        "dr.fma(value, part, 1))",
        "dr.fma(value, part, 0.9999998))",
        ("tests/unit/core/test_fast_math.py",),
    ),
    Mutant(
        "extinction of coarse caches shifted by half a voxel (sweep)",
        "solvers/discrete_ordinates/track_layout.py",
        "self.lower[k] * ratio - 0.5,",
        "self.lower[k] * ratio,",
        (SWEEP,),
    ),
    Mutant(
        "the cosine of the slope forgotten: length of a line in a slice (sweep)",
        "solvers/discrete_ordinates/track_layout.py",
        "length=1 / np.abs(along)",
        "length=1 / np.linalg.norm(velocities, axis=1)",
        (SWEEP,),
    ),
    Mutant(
        "the cosine of the slope forgotten: area of a line (sweep)",
        "solvers/discrete_ordinates/kernel.py",
        "mi.Vector4f(0, middle, lost * area, count * tau * area)",
        "mi.Vector4f(0, middle, lost, count * tau)",
        (SWEEP,),
    ),
    Mutant(
        "the albedo of a voxel is its plain mean, not that of its collisions (sweep)",
        "solvers/discrete_ordinates/resampling.py",
        "sigma_t = mi.Spectrum(medium.sigma_t.at_world(p)) * weight",
        "sigma_t = mi.Spectrum(weight)",
        ("tests/unit/solvers/discrete_ordinates/test_resampling.py",),
    ),
    Mutant(
        "lines that leave through a side go on with their light (sweep)",
        "solvers/discrete_ordinates/kernel.py",
        "return voxel, position, dr.select(outside, self.since_entry(position), 1.0)",
        "return voxel, position, dr.select(outside, mi.Float(1.0), 1.0)",
        (SWEEP,),
    ),
    Mutant(
        "every other pair of directions forgotten (sweep)",
        "solvers/discrete_ordinates/kernel.py",
        "place += step",
        "place += 2 * step",
        ("tests/unit/solvers/discrete_ordinates/test_tracks.py",),
    ),
    Mutant(
        "samples on the wrong side of their pixel's row (film)",
        "render/pixel_filter.py",
        "(dr.opaque(mi.Int32, samples.border) - down)",
        "(dr.opaque(mi.Int32, samples.border) + down)",
        ("tests/unit/render/test_pixel_filter.py",),
    ),
    Mutant(
        "steep decay behind dense faces ignored",
        "cache/border.py",
        "found = is_known & (rest > 0)",
        "found = is_known & (rest < 0)",
        ("tests/correctness/test_dense_border.py",),
    ),
    Mutant(
        "whole steps behind dense faces",
        "render/raymarch.py",
        "if depth > SUBSTEP_DEPTH and",
        "if depth < 0 and",
        ("tests/correctness/test_dense_border.py",),
    ),
    Mutant(
        "values at centres taken as means at dense faces",
        "solvers/discrete_ordinates/tracks.py",
        "self.layers = LAYERS if has_dense_faces else 0",
        "layers = 0",
        ("tests/correctness/test_dense_border.py",),
    ),
    Mutant(
        "few samples of environment maps",
        "solvers/discrete_ordinates/incident.py",
        "0.5, 2.0, 4.0",
        "0.5, 0.5, 0.5",
        ("tests/correctness/test_environment_maps.py",),
    ),
    Mutant(
        "sharpening with the wrong sign (sweep)",
        "solvers/discrete_ordinates/tracks.py",
        "below + above - 2 * here, 0)",
        "2 * here - below - above, 0)",
        (SWEEP,),
    ),
    Mutant(
        "light of an environment from the other side (sweep)",
        "lights/environments.py",
        "interaction.wi = mi.Vector3f(directions.T",
        "interaction.wi = mi.Vector3f(-directions.T",
        (SWEEP,),
    ),
    Mutant(
        "the last segment skipped",
        "render/raymarch.py",
        "active &= (end < self._far) & (~empty",
        "active &= (end + self._projection.step < self._far) & (~empty",
        (PROJECTION,),
    ),
    Mutant(
        "the curvature of a segment with the wrong sign",
        "render/quadrature.py",
        "maximum(1 - sag, 0)",
        "maximum(1 + sag, 0)",
        (PROJECTION,),
    ),
    Mutant(
        "rays stopped at 5 % of their light",
        "render/raymarch.py",
        "EARLY_STOP = 1e-4",
        "EARLY_STOP = 5e-2",
        (PROJECTION,),
    ),
    Mutant(
        "the background in front of the medium",
        "render/camera.py",
        "(through * transmittance + straight * unscattered) * radiance + emitted",
        "radiance + emitted",
        (CLOSED_FORMS,),
    ),
    Mutant(
        "one order of scattering too many (path)",
        "solvers/path/solver.py",
        "order = mi.UInt32(1)",
        "order = mi.UInt32(0)",
        (UNBIASED,),
    ),
    Mutant(
        "a bounce counted twice (path)",
        "solvers/path/solver.py",
        "scattered += dr.select(active, weight * light, 0)",
        "scattered += dr.select(active, weight * light * dr.select(order == 2, 2, 1), 0)",
        (UNBIASED,),
    ),
    Mutant(
        "the albedo forgotten (path)",
        "solvers/path/solver.py",
        "weight *= medium.albedo.at_world(position, active)",
        "weight *= 1",
        (UNBIASED,),
    ),
    Mutant(
        "roulette without its weight (path)",
        "solvers/path/solver.py",
        "                weight /= survival\n",
        "",
        (UNBIASED,),
    ),
    Mutant(
        "1 % of all collisions missed (path)",
        "transport/tracking.py",
        "choice * majorant < sigma_t)",
        "choice * majorant < 0.99 * sigma_t)",
        ("tests/unit/transport/test_tracking.py", UNBIASED, CLOSED_FORMS),
    ),
    Mutant(
        "roulette without its weight (transmittance)",
        "transport/tracking.py",
        "result * (ROULETTE_BELOW / largest), 0)",
        "result, 0)",
        ("tests/unit/transport/test_tracking.py", UNBIASED),
    ),
    Mutant(
        "emitters counted twice: sampled and met (surfaces)",
        "transport/path_tracer.py",
        "mis_weight = dr.select(sampled, power_heuristic(path.pdf, density), 1)",
        "mis_weight = mi.Float(1)",
        ("tests/system/test_surfaces.py",),
    ),
    Mutant(
        "light scattered backwards (phase functions)",
        "media/phase.py",
        "found.p, found.wi = p, -direction",
        "found.p, found.wi = p, direction",
        ("tests/system/test_anisotropic_scattering.py",),
    ),
    Mutant(
        "standard errors of samples, not of batches",
        "cache/statistics.py",
        "spread / (n * (n - 1))",
        "spread / (n * (n * self.batch - 1))",
        (CACHE,),
    ),
    Mutant(
        "roots of noisy values not made up for",
        "cache/statistics.py",
        "return dr.rsqrt(1 - (1 - 8 / 27) / 4 * variance)",
        "return 1 + 0 * variance",
        (CACHE,),
    ),
    Mutant(
        "means of two caches not weighted by their samples",
        "cache/statistics.py",
        "(n * more / (n + more))",
        "(n * more / (n + more + 1))",
        (CACHE,),
    ),
    Mutant(
        "the ends of a segment exchanged (falloff of lamps)",
        "lights/falloff.py",
        "angle = dr.atan2(q * length, dr.fma(x, y, q * q)) / q",
        "x, y = -y, -x; angle = dr.atan2(q * length, dr.fma(x, y, q * q)) / q",
        ("tests/unit/lights/test_falloff.py",),
    ),
    Mutant(
        "light in the voxel of a lamp as in its middle (sweep)",
        "solvers/discrete_ordinates/solver.py",
        "else irradiance[channel] * self._inverse_square_mean",
        "else irradiance[channel]",
        ("tests/system/test_point_lights.py",),
    ),
    Mutant(
        "light from the opposite side (moments)",
        "solvers/discrete_ordinates/moments.py",
        "even, odd = forward + backward, forward - backward",
        "even, odd = forward + backward, backward - forward",
        (MOMENTS,),
    ),
    Mutant(
        "what lines lose not per depth (moments)",
        "solvers/discrete_ordinates/kernel.py",
        "dr.select(t.w > 0, t.z / t.w, t.y)",
        "t.z",
        (PHASE,),
    ),
    Mutant(
        "light of narrow lights twice (moments)",
        "cache/angular.py",
        "radiance = radiance - own",
        "radiance = radiance - 0 * own",
        (PHASE,),
    ),
    Mutant(
        "light that comes back to a medium seen from any side (moments)",
        "solvers/discrete_ordinates/moments.py",
        "for factor in basis[: self.moments.count - 1]:",
        "for factor in ():",
        (PHASE,),
    ),
    Mutant(
        "wide lamps as narrow as points (directional)",
        "cache/angular.py",
        "attenuation = attenuation * ratio",
        "attenuation *= 1",
        ("tests/unit/cache/test_angular.py",),
    ),
    Mutant(
        "forward peaks of other media taken away, too",
        "scene/compile.py",
        "tuple(grid for grid in grids if grid is not medium)",
        "tuple(without_forward_peak(g) if g.phase.has_peak else g for g in grids if g is not "
        "medium)",
        ("tests/unit/media/test_delta_m.py",),
    ),
    Mutant(
        "suns of skies as bright as directions met them",
        "solvers/discrete_ordinates/incident.py",
        "incoming[number == k] *= factor",
        "incoming[number == k] *= 1",
        ("tests/system/test_sweep.py",),
    ),
    Mutant(
        "the medium behind a mask does not attenuate (incoming radiance)",
        "solvers/discrete_ordinates/boundary_condition.py",
        "media = boundary.other_media if boundary.surfaces is None else boundary.media",
        "media = boundary.other_media",
        ("tests/system/test_surfaces_among_voxels.py",),
    ),
    Mutant(
        "moments of lamps forgotten (directional sweep)",
        "solvers/discrete_ordinates/anisotropic.py",
        "moments.moment(smooth, k) + sum(values[k] for values in others)",
        "moments.moment(smooth, k)",
        (PHASE,),
    ),
    Mutant(
        "a forward peak of what is absorbed, too",
        "media/delta_m.py",
        "s * (1 - share * a)",
        "s * (1 - share)",
        ("tests/unit/media/test_delta_m.py",),
    ),
    Mutant(
        "interpolated roots do not keep the light",
        "cache/lookups.py",
        "roots = conserving(grid, roots, known, channels, share, separated)",
        "roots = roots + 0",
        ("tests/unit/cache/test_lookups.py",),
    ),
    Mutant(
        "interpolated roots keep half of the light that bends",
        "cache/conservative.py",
        "second_difference(smoothed) / 6",
        "second_difference(smoothed) / 12",
        ("tests/unit/cache/test_conservative.py",),
    ),
    Mutant(
        "directions are not rotated",
        "solvers/discrete_ordinates/angular_quadrature.py",
        "points = points @ rotation.T",
        "points = points",
        ("tests/unit/solvers/discrete_ordinates/test_angular_quadrature.py",),
    ),
)
