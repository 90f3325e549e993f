"""Detection of sharp shadows, as of blinds, that the voxels of a cache are too large for."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.transport.path import Media, position_on, visibility, with_valid_direction

#: Number of pairs of positions one voxel apart, and the smallest number of them that an emitter
#: must illuminate.
PAIRS, FEWEST = 1 << 13, 64
#: Share of pairs with an edge of a shadow between them above which a warning is logged. With 0.48
#: (slats before a cube of fog) blocks of pixels are wrong by 6 to 15 %, with 0.83 (blinds before a
#: room) by 21 to 66 %. It is 0.02 to 0.13 with a few objects.
MANY_EDGES = 0.2


def warn_of_fine_shadows(
    scene: mi.Scene, grid: Grid, emitters: Sequence[mi.Emitter], name: str
) -> None:
    """Log a warning if the shadows of ``emitters`` without extent in the medium of this ``name``
    are finer than the voxels of ``grid``.
    """
    share = max((share_of_edges(scene, grid, emitter) for emitter in emitters), default=0.0)
    if share > MANY_EDGES:
        mi.Log(
            mi.LogLevel.Warn,
            f"irrcache: voxels of the cache ({grid.voxel_size.max():.2g}) are large in comparison "
            f"to shadows of surfaces in {name}: between {share:.0%} of the neighbouring voxels "
            "that are illuminated there is the edge of a shadow. Errors of several percent are "
            f"expected in parts of the image. Raise resolution (now {max(grid.shape)}).",
        )


def share_of_edges(scene: mi.Scene, grid: Grid, emitter: mi.Emitter) -> float:
    """Return the share of pairs of positions one voxel apart, of which ``emitter`` illuminates at
    least one, of which it illuminates only one.
    """
    rng = np.random.default_rng(PAIRS)
    place = rng.random((3, PAIRS), dtype=np.float32) * np.float32(grid.resolution)[:, None]
    first = grid.world.point(mi.Point3f(place))
    u = mi.Point2f(rng.random((2, PAIRS), dtype=np.float32))
    direction = mi.warp.square_to_uniform_sphere(u)
    second = first + float(grid.voxel_size.max()) * direction
    pointer = mi.EmitterPtr(emitter)
    dr.make_opaque(pointer)
    a, b = (_illuminates(scene, pointer, p) for p in (first, second))
    either, edges = dr.count(a | b), dr.count(a ^ b)
    count = int(either[0])
    return int(edges[0]) / count if count >= FEWEST else 0.0


@symbolic
def _illuminates(scene: mi.Scene, emitter: mi.EmitterPtr, p: mi.Point3f):
    """Return whether no surface blocks the light of an emitter without extent at positions."""
    vertex = dr.zeros(mi.Interaction3f, dr.width(p))
    vertex.p = p
    record, value = emitter.sample_direction(vertex, mi.Point2f(0.5), mi.Bool(True))
    sampled = (record.pdf > 0) & (dr.max(value) > 0)
    record = with_valid_direction(record)
    none, rng = dr.zeros(mi.MediumPtr, dr.width(p)), mi.PCG32()
    target = position_on(record, vertex)
    passed, _ = visibility(scene, Media([]), vertex, target, none, rng, sampled, exact=True)
    return sampled & (dr.max(passed) > 0)
