"""Refusal of beams that are too narrow for gradients.

The adjoint fluence of a voxel is multiplied by the irradiance of an emitter at one position of it.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.gradients.parameters import refuse_all
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.emitters import SPOT_LIKE, position_of
from mitsuba_irrcache.lights.falloff import lies_in
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.scene.occluders import bounding_sphere

#: Least width of a beam at the centre of the medium, in voxels of the cache. At three voxels the
#: derivative with respect to the intensity of a spot is 15 % too small, at six within 2 %.
BEAM_VOXELS = 4
#: Number of rays of an emitter by which its beam is measured.
RAYS = 256


def check_beams(part: CachedMedium, keys: list[str]) -> None:
    """Raise IrrcacheError if a spot or projector illuminates the medium by a beam that is narrower
    than `BEAM_VOXELS`, or lies in it.
    """
    grid = part.cache.grid
    for light in part.description.emitters.of(*SPOT_LIKE):
        is_inside, width = lies_in(light, grid), _width_at(light, grid)
        if is_inside or width < BEAM_VOXELS * grid.voxel_size.max():
            where = "in the medium" if is_inside else f"narrower than {BEAM_VOXELS} voxels"
            refuse_all(
                keys,
                f'the beam of the emitter "{light.id()}" ({light.class_name()}) is {where}',
                "Move it away, widen its beam or raise resolution",
            )


def _width_at(light: mi.Emitter, grid: Grid) -> float:
    """Return the least width of the beam of ``light`` at the distance of the centre of ``grid``;
    infinite if the beam misses the sphere around the grid.
    """
    centre, radius = bounding_sphere(grid.to_world)
    offset = centre - position_of(light)
    distance = np.linalg.norm(offset)

    rng = np.random.default_rng(RAYS)
    sample, position = (mi.Point2f(np.float32(rng.random((2, RAYS)))) for _ in range(2))
    ray, _ = light.sample_ray(mi.Float(0), mi.Float(0.5), sample, position)
    directions = np.array(ray.d, dtype=np.float64).T
    axis = directions.mean(axis=0)
    axis /= np.linalg.norm(axis)
    reach = np.arccos(np.clip((directions @ axis).min(), -1, 1))
    angle = np.arccos(np.clip(axis @ offset / distance, -1, 1))
    if distance > radius and angle > reach + np.arcsin(radius / distance):
        return np.inf

    # Across the axis, the variance of a uniform beam of width w is at most w^2 / 12.
    cosines = np.maximum(directions @ axis, 1e-3)
    across = directions / cosines[:, None] - axis
    least = max(np.linalg.eigvalsh(across.T @ across / RAYS)[1], 0.0)
    return distance * np.sqrt(12 * least)
