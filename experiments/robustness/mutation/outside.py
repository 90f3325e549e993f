"""Mutants by people who had not seen the tests, and that no test detected at that time."""

from __future__ import annotations

from experiments.robustness.mutation.mutants import Mutant

NEIGHBOURS = "tests/unit/cache/test_conservative_symmetry_and_borders.py"
FILTER = "tests/unit/render/test_denoise_symmetry_and_rejection.py"
ERRORS = "tests/unit/cache/test_uncertainty_of_lookups.py"
SIMILARITY = "tests/unit/media/test_delta_m_narrow_emitters.py"
SEGMENTS = "tests/unit/render/test_raymarch_segments.py"

OUTSIDE = (
    Mutant(
        "the last voxels but one keep plain roots (conservation)",
        "cache/conservative.py",
        "(place + 1 < mi.UInt32(side))",
        "(place + 2 < mi.UInt32(side))",
        (NEIGHBOURS,),
    ),
    Mutant(
        "only the lower neighbour has to be known (conservation)",
        "cache/conservative.py",
        "for there in (voxel - stride, voxel + stride):",
        "for there in (voxel - stride,):",
        (NEIGHBOURS,),
    ),
    Mutant(
        "the filter is applied although its risk is larger than without",
        "render/denoise.py",
        "if risks[least] >= np.array(dr.block_sum(unfiltered, count))[0]:",
        "if False:",
        (FILTER,),
    ),
    Mutant(
        "rows of the filter's window without the stride",
        "render/denoise.py",
        "y + dy * stride",
        "y + dy",
        (FILTER,),
    ),
    Mutant(
        "errors that all voxels share have random signs",
        "cache/uncertainty.py",
        "random = random & 0",
        "random = random | 0",
        (ERRORS,),
    ),
    Mutant(
        "the inverse square of lamps missing in the error",
        "cache/uncertainty.py",
        "phi * smooth, error * smooth",
        "phi * smooth, error",
        (ERRORS,),
    ),
    Mutant(
        "the inverse square of lamps missing in light and error",
        "cache/uncertainty.py",
        "smooth = 1 / cache.falloff.of_voxels(cache.active)",
        "smooth = 1",
        (ERRORS,),
    ),
    Mutant(
        "spheres that surround what is up to 14 % outside",
        "grids/boundary.py",
        "return dr.squared_norm(local) <= 1\n",
        "return dr.squared_norm(local) <= 1.3\n",
        ("tests/unit/grids/test_boundary_containment.py",),
    ),
    Mutant(
        "light in a forward peak is never scattered",
        "media/delta_m.py",
        "unscaled=Unscaled(medium, exponent),",
        "unscaled=Unscaled(medium, np.ones(1)),",
        (SIMILARITY,),
    ),
    Mutant(
        "emission begins before the ray does",
        "media/emission.py",
        "return dr.maximum(near, enters), dr",
        "return enters, dr",
        (SEGMENTS,),
    ),
    Mutant(
        "steps of 64 where little light is left",
        "render/raymarch.py",
        "dr.select(remaining > COARSEST * accumulated, stride, 4)",
        "dr.select(remaining > COARSEST * accumulated, stride, 64)",
        (SEGMENTS,),
    ),
    Mutant(
        "a segment that enters matter has the light of its dark end",
        "render/raymarch.py",
        "        here.source = dr.select(enters, there.source, here.source)\n",
        "",
        (SEGMENTS,),
    ),
    Mutant(
        "a segment that leaves matter has the light of its dark end",
        "render/raymarch.py",
        "there.source = dr.select(leaves, here.source, there.source)",
        "there.source = there.source + 0",
        (SEGMENTS,),
    ),
)
