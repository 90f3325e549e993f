"""Detection of sharp shadows, as of blinds, that the voxels of a cache are too large for."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import kronecker
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.emitters import POINT_LIKE, EmitterKind, EmittersByKind
from mitsuba_irrcache.transport.path import illuminates

#: Number of pairs of positions one voxel apart, and the smallest number of them that an emitter
#: must illuminate; number of tested points on an area emitter, and of such emitters.
PAIRS, FEWEST, POINTS, MOST_LAMPS = 1 << 13, 64, 64, 8
#: Share of pairs with an edge of a shadow between them above which a warning is logged. With 0.48
#: (slats before a cube of fog) blocks of pixels are wrong by 6 to 15 %, with 0.83 (blinds before a
#: room) by 21 to 66 %. It is 0.02 to 0.13 with a few objects.
MANY_EDGES = 0.2


def warn_of_fine_shadows(scene: mi.Scene, grid: Grid, emitters: EmittersByKind, name: str) -> None:
    """Log a warning if the shadows of ``emitters`` in the medium of this ``name`` are finer than
    the voxels of ``grid``. Those of environments are not sharp.
    """
    sharp, lamps = emitters.of(EmitterKind.SUN, *POINT_LIKE), emitters.of(EmitterKind.AREA)
    shares = [share_of_edges(scene, grid, emitter) for emitter in sharp]
    shares += [share_of_edges(scene, grid, lamp, POINTS) for lamp in lamps[:MOST_LAMPS]]
    share = max(shares, default=0.0)
    if share > MANY_EDGES:
        mi.Log(
            mi.LogLevel.Warn,
            f"irrcache: voxels of the cache ({grid.voxel_size.max():.2g}) are large in comparison "
            f"to shadows of surfaces in {name}: between {share:.0%} of the neighbouring voxels "
            "that are illuminated there is the edge of a shadow. Errors of several percent are "
            f"expected in parts of the image. Raise resolution (now {max(grid.shape)}).",
        )


def share_of_edges(scene: mi.Scene, grid: Grid, emitter: mi.Emitter, points: int = 1) -> float:
    """Return the mean difference of the parts of ``emitter`` that are visible from two positions
    one voxel apart, relative to the larger part. ``points`` on it are tested.
    """
    rng, count = np.random.default_rng(PAIRS), PAIRS if points == 1 else PAIRS // 4
    place = rng.random((3, count), dtype=np.float32) * np.float32(grid.resolution)[:, None]
    first = grid.world.point(mi.Point3f(place))
    u = mi.Point2f(rng.random((2, count), dtype=np.float32))
    direction = mi.warp.square_to_uniform_sphere(u)
    second = first + float(grid.voxel_size.max()) * direction
    pointer = mi.EmitterPtr(emitter)
    dr.make_opaque(pointer)
    number = dr.opaque(mi.UInt32, points)
    a, b = (_visible_part(scene, pointer, p, number) for p in (first, second))
    larger, difference = dr.maximum(a, b), dr.abs(a - b)
    dr.eval(larger, difference)
    if dr.count(larger > 0)[0] < FEWEST:
        return 0.0
    return float(dr.sum(difference)[0] / dr.sum(larger)[0])


@symbolic
def _visible_part(scene: mi.Scene, emitter: mi.EmitterPtr, p: mi.Point3f, points: mi.UInt32):
    """Return the share of ``points`` on an emitter that illuminate positions and that no surface
    blocks.
    """
    vertex = dr.zeros(mi.Interaction3f, dr.width(p))
    vertex.p = p
    k, found, rng = mi.UInt32(0), mi.Float(0), mi.PCG32()
    while dr.hint(k < points, label="fine shadows"):
        record, value = emitter.sample_direction(vertex, mi.Point2f(kronecker(k, 2)), mi.Bool(True))
        seen, rng = illuminates(scene, vertex, record, value, rng, mi.Bool(True))
        found += dr.select(seen, mi.Float(1), 0)
        k += 1
    return found / mi.Float(points)
