"""Mutants of surfaces among the voxels, irradiance on surfaces, gradients and the tolerance."""

from __future__ import annotations

from experiments.robustness.mutation.mutants import Mutant

AMONG = "tests/system/test_surfaces_among_voxels.py"
CROSSINGS = "tests/unit/solvers/discrete_ordinates/test_crossings.py"
NODES = "tests/unit/cache/test_surface.py"
IMAGES = "tests/system/test_surface_irradiance.py"
GRADIENTS = "tests/system/test_gradients.py"
TOLERANCE = "tests/system/test_tolerance.py"
TOUCHING = "tests/unit/scene/test_clearance.py"
AMONG_SURFACES = "tests/system/test_gradients_among_surfaces.py"
FORWARD = "tests/system/test_forward_mode.py"

SURFACES = (
    Mutant(
        "parts of tracks are not exchanged for the way back",
        "solvers/discrete_ordinates/kernel.py",
        "first, last, before, behind = -last, -first, behind, before",
        "first, last, before, behind = -last, -first, before, behind",
        (CROSSINGS, AMONG),
    ),
    Mutant(
        "both parts of a track use the source of the same voxel",
        "solvers/discrete_ordinates/kernel.py",
        "            voxels = voxels[1], voxels[0]\n",
        "            voxels = voxels[1], voxels[1]\n",
        (CROSSINGS, AMONG),
    ),
    Mutant(
        "radiance behind a surface is attenuated before it begins",
        "solvers/discrete_ordinates/kernel.py",
        "carried.append(dr.select(crosses, y - lost[1], x - lost[0] + y))",
        "carried.append(dr.select(crosses, y - lost[1] - lost[0], x - lost[0] + y))",
        (CROSSINGS, AMONG),
    ),
    Mutant(
        "parts on the far side of a surface count for the voxel",
        "solvers/discrete_ordinates/crossings.py",
        "return dr.select(hidden, mi.Float(0), 1), dr.select(hidden, away, segment.voxel)",
        "return mi.Float(1), dr.select(hidden, away, segment.voxel)",
        (CROSSINGS, AMONG),
    ),
    Mutant(
        "crossings end at the first surface",
        "solvers/discrete_ordinates/crossings.py",
        "last = dr.select(hit, segment.ahead - far / slice_length, -BEYOND)",
        "last = dr.select(hit, first, -BEYOND)",
        (CROSSINGS, AMONG),
    ),
    Mutant(
        "the coarsest nodes are used wherever there are some",
        "cache/surface.py",
        "finer |= divided | (total == 0)",
        "finer &= False",
        (NODES, IMAGES),
    ),
    Mutant(
        "nodes of surfaces that face elsewhere apply",
        "cache/surface.py",
        " & (cosine > SAME_SIDE)\n",
        "\n",
        (NODES, IMAGES),
    ),
    Mutant(
        "nodes receive only direct light",
        "render/surface_irradiance.py",
        "    for _ in range(MOST_ITERATIONS):\n",
        "    for _ in range(0):\n",
        (IMAGES,),
    ),
    Mutant(
        "nodes do not know the medium before them",
        "render/surface_irradiance.py",
        "dr.gather(mi.UInt32, medium, lane))\n            active = dr.gather(mi.Float",
        "mi.UInt32(0) * lane)\n            active = dr.gather(mi.Float",
        (IMAGES,),
    ),
    Mutant(
        "refined pixels have half the radiance",
        "render/pixel_filter.py",
        "dr.opaque(mi.Float, 1 / further)",
        "dr.opaque(mi.Float, 0.5 / further)",
        ("tests/unit/render/test_pixel_filter.py",),
    ),
    Mutant(
        "samples decide themselves whether they are replaced",
        "render/film.py",
        "variance, halves ^ 1)",
        "variance, halves)",
        ("tests/unit/render/test_film.py",),
    ),
    Mutant(
        "the number of refined samples is a constant of the kernel",
        "render/film.py",
        "sequence.words(cell * each + k, shifts",
        "sequence.words(cell * further + k, shifts",
        (IMAGES,),
    ),
    Mutant(
        "the adjoint lacks what camera rays leave in the voxel itself",
        "gradients/transport.py",
        "phi = source + level.antidiffused(level.solve(first, self.solving))",
        "phi = level.antidiffused(level.solve(first, self.solving))",
        (GRADIENTS,),
    ),
    Mutant(
        "the error of the voxels is the difference of two resolutions",
        "render/tolerance.py",
        "difference / (ratio ** self._order(levels) - 1)",
        "difference / 8",
        (TOLERANCE,),
    ),
    Mutant(
        "the directions have no error",
        "render/tolerance.py",
        "        return last.scatter\n",
        "        return 0.0\n",
        (TOLERANCE,),
    ),
    Mutant(
        "an edit keeps the caches of a tolerance",
        "render/tolerance.py",
        "            del self._levels[1:]\n",
        "            pass\n",
        (TOLERANCE,),
    ),
    Mutant(
        "the error of a tolerance has one part only",
        "render/certificate.py",
        "sum(part**2 for part in self.parts.values())",
        "max(part**2 for part in list(self.parts.values())[-1:])",
        (TOLERANCE,),
    ),
    Mutant(
        "a boundary that surfaces touch keeps its place",
        "scene/clearance.py",
        "np.count_nonzero(own & left) >= FEWEST",
        "np.count_nonzero(own & left) < 0",
        (TOUCHING,),
    ),
    Mutant(
        "moves of faces that meet are added",
        "scene/clearance.py",
        "np.linalg.solve(matrix, right[:, :, None])[place.ravel(), :, 0]",
        "right[place.ravel()]",
        (TOUCHING,),
    ),
    Mutant(
        "a nested boundary moves as far as the one around it",
        "scene/clearance.py",
        "CLEARANCE * ray_offset(boxes[shape]) + max(around, default=0.0)",
        "CLEARANCE * ray_offset(boxes[shape])",
        (TOUCHING,),
    ),
    Mutant(
        "moved shapes keep the scene that was traced before",
        "scene/clearance.py",
        "    return isinstance(node, mi.Shape) or name",
        "    return name",
        (TOUCHING,),
    ),
    Mutant(
        "depth of tilted floors ignored",
        "scene/clearance.py",
        "max(within[own].max(), 0.0) + self._clearance",
        "self._clearance",
        (TOUCHING,),
    ),
    Mutant(
        "paths from voxels do not grow with the views",
        "gradients/surroundings_adjoint.py",
        "self._samples += film.samples",
        "self._samples = film.samples",
        (AMONG_SURFACES,),
    ),
    Mutant(
        "all images of a loss have the same paths",
        "gradients/surroundings.py",
        "word = mi.sample_tea_32(word, dr.opaque(mi.UInt32, view))[0]",
        "word = mi.sample_tea_32(word, dr.opaque(mi.UInt32, 0))[0]",
        (AMONG_SURFACES,),
    ),
    Mutant(
        "changes of textures add up over their evaluations",
        "gradients/tangent_fields.py",
        "        self._set(-1)\n        dr.forward_to(value, flags=dr.ADFlag.ClearNone)\n",
        "",
        (FORWARD,),
    ),
    Mutant(
        "forward mode neglects radiance that returns to a medium",
        "gradients/surroundings_tangent.py",
        "while not self.media[0].single and self._norm(change) > TOLERANCE * scale:",
        "while False:",
        (FORWARD,),
    ),
    Mutant(
        "forward mode reads what returns to a medium along its own segment",
        "gradients/surroundings_tangent.py",
        "return [self._incident(n, use, read, without_first=n) for n in range(len(self.media))]",
        "return [self._incident(n, use, read) for n in range(len(self.media))]",
        (FORWARD,),
    ),
    Mutant(
        "radiance of lamps has no higher moments in forward mode",
        "gradients/tangent_transport.py",
        "if not source.sharp:",
        "if False:",
        (FORWARD,),
    ),
    Mutant(
        "rays from the BSDF end at emitters that let light through",
        "render/surface_paths.py",
        "active &= hit & (dr.max(attenuation) > 0) & (crossings < MOST_CROSSINGS)",
        "active &= hit & ~is_emitter & (dr.max(attenuation) > 0) & (crossings < MOST_CROSSINGS)",
        (IMAGES,),
    ),
    Mutant(
        "rooms with outward normals count as objects",
        "scene/voxel_classes.py",
        "self.enclosed &= _unreached(scene, grid)",
        "pass",
        (AMONG,),
    ),
    Mutant(
        "objects do not separate voxels from illuminated ones",
        "scene/voxel_classes.py",
        "exists &= ~dr.gather(mi.Bool, barrier, lower, exists)",
        "exists &= True",
        (AMONG, "tests/unit/scene/test_cut_cells.py"),
    ),
    Mutant(
        "media behind masks are transparent",
        "render/surface_paths.py",
        "sums.passed *= dr.select(hit & path.first & (entry < leave), unscattered, 1)",
        "pass",
        ("tests/system/test_surfaces.py",),
    ),
    Mutant(
        "shadows of blinds are fine",
        "scene/fine_shadows.py",
        "dr.abs(a - b)",
        "dr.abs(a + b)",
        ("tests/unit/scene/test_fine_shadows.py",),
    ),
    Mutant(
        "emission is not attenuated within a step",
        "gradients/replay.py",
        "change += length * emitted * _derivative_of_mean_transmittance(tau, absorbed)",
        "pass",
        (AMONG_SURFACES,),
    ),
    Mutant(
        "paths that the camera does not follow have another phase function (g)",
        "gradients/replay.py",
        "march._neighbours = [each.indirect() for each in marches], factor",
        "march._neighbours = None",
        (AMONG_SURFACES,),
    ),
)
