"""Error of derivatives by the extinction of media that are dense at an illuminated boundary.

Light that several events scatter into a camera ray is scattered in a voxel first. What the
extinction removes on its way there is summed voxel by voxel. Where light of a sun or a point-like
emitter enters through a dense face of the medium, the irradiance varies so much within the
outermost voxels that the middle does not represent them, in particular at grazing incidence. There,
several positions in each voxel do, and steps along camera rays are shorter.
"""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.lights.emitters import POINT_LIKE, EmitterKind
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.solvers.grid_size import border_depth

#: Optical depth of an outermost voxel along the light above which this applies; number of positions
#: in each voxel, and of steps in place of one. Among surfaces and with several media it does not.
DENSE, POSITIONS, SHORTER = 0.15, 4, 4
#: Error of the derivative of an image by the logarithm of the extinction, in % of the radiance:
#: factor d^order, with that depth d, at most DEEPEST, beyond which little light passes the voxel;
#: for isolated media and for others. Found with cubes of optical depth 3 and 10 and 12 to 48
#: voxels, under suns whose cosine of incidence is 0.15 to 1; for others with a small surface below
#: these. A warning is logged above LARGE_ERROR.
ISOLATED, AMONG_SURFACES = (0.65, 1.1), (1.8, 1.5)
DEEPEST, LARGE_ERROR = 1.5, 0.5


def is_dense_at_illuminated_border(part: CachedMedium) -> bool:
    """Return whether `POSITIONS` in each voxel are needed."""
    return part.cache is not None and _largest_depth(part)[0] > DENSE


def warn_of_border_error(parts: Iterable[CachedMedium], isolated: bool) -> bool:
    """Log a warning if derivatives by the extinction of one of the media are inaccurate; return
    whether it was logged. ``isolated`` states that there are no surfaces and no other media.
    """
    factor, order = ISOLATED if isolated else AMONG_SURFACES
    for part in parts:
        depth, light = _largest_depth(part)
        error = factor * min(depth, DEEPEST) ** order
        if error > LARGE_ERROR:
            mi.Log(
                mi.LogLevel.Warn,
                f'irrcache: medium "{part.medium.name}" is dense at its boundary (optical depth '
                f'{depth:.2g} of an outermost voxel along the light of "{light}"): derivatives '
                f"by its extinction have errors of about {error:.1f} % of the radiance. Raise "
                "resolution, or leave empty voxels around the matter.",
            )
            return True
    return False


def _largest_depth(part: CachedMedium) -> tuple[float, str]:
    """Return the largest optical depth of a voxel at a face along the light that enters there, and
    the name of the emitter; 0 without such light.
    """
    grid, found = part.cache.grid, (0.0, "")
    depth = border_depth(part.medium, grid)
    # Columns are the normals of the faces.
    normals = np.linalg.inv(grid.to_world[:3, :3]).T
    normals = normals / np.linalg.norm(normals, axis=0)
    centre = dr.zeros(mi.Interaction3f)
    centre.p = mi.Point3f(*(grid.to_world @ [0.5, 0.5, 0.5, 1.0])[:3].tolist())
    for emitter in part.description.emitters.of(EmitterKind.SUN, *POINT_LIKE):
        record, _ = emitter.sample_direction(centre, mi.Point2f(0.5))
        cosines = np.abs(normals.T @ np.array(record.d).ravel())
        along = depth / cosines[cosines > 1e-3]
        found = max(found, (float(along.max()), emitter.id()))
    return found
