"""What irrcache finds in a scene, and what it has to refuse.

A scene is *simple* if all there is to it is one medium in a box or sphere, and light that comes
from far away or from points: then nothing has to be intersected, and every ray's way is known in
closed form. In all other scenes Mitsuba's ray tracing says where surfaces and boundaries are.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.grids.boundary import Boundary, boundary_of, rays_through
from mitsuba_irrcache.lights.emitters import check_placement
from mitsuba_irrcache.media.bake import bake, children
from mitsuba_irrcache.media.delta_m import truncate_forward_peak
from mitsuba_irrcache.media.emission import Emission, place_emission
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.media.phase import refuse_sharp
from mitsuba_irrcache.scene.consistency import (
    RAY_OFFSET,
    check_media_agree,
    check_sensor,
    described,
)
from mitsuba_irrcache.scene.context import Surroundings
from mitsuba_irrcache.transport.path import MOST_CROSSINGS, is_null

#: The distance at which Mitsuba's rays leave a surface should not exceed this part of the shortest
#: side of a medium.
LARGEST_OFFSET = 0.002
#: Steps between positions in single precision that a side of a medium, and a voxel, must have.
STEPS_OF_A_SIDE, STEPS_OF_A_VOXEL = 256, 8


def bake_media(scene: mi.Scene, emission: Emission | None = None) -> list[MediumGrid]:
    """The media of a scene that a camera may see other than through a surface, on their grids; none
    where there are none. They shine with ``emission``.

    Raises UnsupportedSceneError, naming the object, for what would not be rendered right.
    """
    media = media_of(scene)
    if not media:
        place_emission(emission, [])
        return []
    for medium, shapes in media.items():
        for shape in shapes:
            lower, upper = (np.array(p) for p in (shape.bbox().min, shape.bbox().max))
            finest = (upper - lower).max() / STEPS_OF_A_SIDE
            _check_distance(medium.id(), np.abs([lower, upper]).max(), finest)
    for emitter in scene.emitters():
        check_placement(emitter)
    for sensor in scene.sensors():
        check_sensor(scene, sensor)
    boundary = simple_boundary(scene)
    if boundary is not None and _is_isotropic(*media):
        grids = [_bake_simple(scene, boundary)]
        place_emission(emission, grids)
    else:
        grids = bake_general(scene, emission, boundary is not None)
    for grid in grids:
        corners = grid.frame @ [[0, 1, 0, 0, 1], [0, 0, 1, 0, 1], [0, 0, 0, 1, 1], [1] * 5]
        _check_distance(grid.name, np.abs(corners[:3]).max(), grid.shortest_edge / STEPS_OF_A_VOXEL)
    return grids


def _check_distance(name: str, distance: float, finest: float) -> None:
    """Refuses a medium so far away from the origin that positions in it cannot be told apart."""
    step = float(np.spacing(np.float32(distance)))
    if step > finest:
        _refuse(
            f'medium "{name}" is {distance:.2g} away from the origin, where single precision tells '
            f"positions {step:.1g} apart only",
            " Scale it up, or move it to the origin.",
        )


def media_of(scene: mi.Scene) -> dict[mi.Medium, list[mi.Shape]]:
    """All media of a scene, each with the shapes that it fills."""
    found: dict[mi.Medium, list[mi.Shape]] = {}
    for shape in scene.shapes():
        interior, exterior = shape.interior_medium(), shape.exterior_medium()
        if interior is not None:
            found.setdefault(interior, []).append(shape)
        if exterior is not None:
            found.setdefault(exterior, [])
    for sensor in scene.sensors():
        if sensor.get_medium() is not None:
            found.setdefault(sensor.get_medium(), [])
    return found


def _flags(shape: mi.Shape) -> int:
    bsdf = shape.bsdf()
    return int(bsdf.flags()) if bsdf is not None else 0


def simple_boundary(scene: mi.Scene) -> Boundary | None:
    """The boundary of the one medium in a scene that has no surface besides; None for others."""
    media = media_of(scene)
    bounded = [s for s in scene.shapes() if s.interior_medium() is not None]
    if len(media) != 1 or len(bounded) != 1:
        return None
    for shape in scene.shapes():
        surface = not is_null(_flags(shape)) or shape.is_emitter() or shape.is_sensor()
        if surface or shape.exterior_medium() is not None:
            return None
    try:
        return boundary_of(scene, bounded[0])
    except UnsupportedSceneError:
        return None


def _is_isotropic(medium: mi.Medium) -> bool:
    return medium.phase_function().class_name() == "IsotropicPhaseFunction"


def bake_scene(scene: mi.Scene) -> MediumGrid | None:
    """The medium of a simple scene on its grids, or None where there is none."""
    for shapes in media_of(scene).values():
        return _bake_simple(scene, boundary_of(scene, shapes[0]))
    return None


def _bake_simple(scene: mi.Scene, boundary: Boundary) -> MediumGrid:
    (medium,) = media_of(scene)
    grid = bake(medium, boundary)
    grid.name = medium.id()
    return grid


def bake_general(
    scene: mi.Scene, emission: Emission | None = None, alone: bool = False
) -> list[MediumGrid]:
    """The media of any scene on grids that know their `Surroundings`; only those that are seen. In
    a simple scene there is but one, which is ``alone``.
    """
    shapes, grids, seen = scene.shapes(), [], []
    if not alone:
        for shape in shapes:
            _check_shape(scene, shape)
        for medium, filled in media_of(scene).items():
            if not filled and medium.class_name() != "HeterogeneousMedium":
                _refuse_unbounded(medium, shapes)
        check_media_agree(scene)
    for medium, filled in media_of(scene).items():
        exact = _exact_boundary(scene, filled)
        grid = bake(medium, exact or Boundary("box", _extent(medium, filled)))
        grid.has_exact_boundary, grid.is_isolated = exact is not None, alone
        grid.pointer, grid.name = mi.MediumPtr(medium), _name(medium, [g.name for g in grids])
        dr.make_opaque(grid.pointer)
        grids.append(grid)
        around = [s for s in shapes if medium in (s.interior_medium(), s.exterior_medium())]
        if any(is_null(_flags(s)) for s in around) or any(
            sensor.get_medium() == medium for sensor in scene.sensors()
        ):
            seen.append(grid)
            if grid.phase is not None and not grid.phase.has_peak:
                refuse_sharp(grid.phase, f'medium "{medium.id()}" ({medium.class_name()})')
    Surroundings(scene, grids)
    place_emission(emission, grids)
    for grid in seen:
        if grid.phase is not None and grid.phase.has_peak:
            truncate_forward_peak(grid)
    if not seen and emission is not None:
        _refuse("all media are behind surfaces, and the emission in them is unknown to volpath")
    if not seen:
        mi.Log(
            mi.LogLevel.Warn,
            "irrcache: all media are behind surfaces, so this scene is rendered as volpath does. A "
            'shape that only bounds a medium needs <bsdf type="null"/>.',
        )
    _warn_of_scale(scene, grids)
    return seen


def _exact_boundary(scene: mi.Scene, filled: list[mi.Shape]) -> Boundary | None:
    """Of the one box or sphere that a medium fills; None where it fills others."""
    try:
        return boundary_of(scene, filled[0]) if len(filled) == 1 else None
    except UnsupportedSceneError:
        return None


def _name(medium: mi.Medium, taken: list[str]) -> str:
    """The medium's id; with a number where another one has it too."""
    name, number = medium.id(), 2
    while name in taken:
        name, number = f"{medium.id()}_{number}", number + 1
    return name


def _extent(medium: mi.Medium, filled: list[mi.Shape]) -> np.ndarray:
    """``to_world`` of the cube [-1, 1]^3 over the world box of ``medium``: of the shapes that it
    fills, and of its own grid.
    """
    boxes = []
    if filled:
        boxes.append(
            (
                np.min([np.array(s.bbox().min) for s in filled], axis=0),
                np.max([np.array(s.bbox().max) for s in filled], axis=0),
            )
        )
    if medium.class_name() == "HeterogeneousMedium":
        box = children(medium)["sigma_t"].bbox()
        boxes.append((np.array(box.min), np.array(box.max)))
    if not boxes or not np.isfinite(boxes).all():
        _refuse_unbounded(medium, [])
    lower = np.max([b[0] for b in boxes], axis=0).astype(np.float64)
    upper = np.min([b[1] for b in boxes], axis=0).astype(np.float64)
    if not (lower < upper).all():
        name = f'medium "{medium.id()}" ({medium.class_name()})'
        _refuse(f"the grid of {name} lies outside of the shapes that it fills, or these are flat")
    frame = np.diag([*(0.5 * (upper - lower)), 1.0])
    frame[:3, 3] = 0.5 * (lower + upper)
    return frame


def _refuse_unbounded(medium: mi.Medium, shapes: list[mi.Shape]) -> None:
    """The error for a medium that nothing bounds."""
    around = [s for s in shapes if s.exterior_medium() == medium]
    role = ""
    if around:
        more = f" and of {len(around) - 1} more" if len(around) > 1 else ""
        role = f"is the exterior of {described(around[0])}{more}, and "
    _refuse(
        f'medium "{medium.id()}" ({medium.class_name()}) {role}fills no shape: it would reach to '
        "infinity, and a cache cannot",
        " Put a closed shape with a null BSDF, such as a cube, around everything that has it as "
        "its interior. Walls and objects within that shape need neither interior nor exterior, "
        "since rays that they send back stay in the medium; only glass does.",
    )


def _check_shape(scene: mi.Scene, shape: mi.Shape) -> None:
    if shape.class_name() == "Instance" and _has_media(scene, shape):
        _refuse(
            f"{described(shape)} is an instance of shapes with media, of which there is no "
            "telling where they are",
            " Place these shapes in the scene themselves.",
        )


def _has_media(scene: mi.Scene, instance: mi.Shape) -> bool:
    """Whether rays through an instance come into a medium there."""
    return bool(dr.any(_meets_media(scene, mi.ShapePtr(instance), rays_through(instance))))


@symbolic
def _meets_media(scene: mi.Scene, instance: mi.ShapePtr, ray: mi.Ray3f):
    """Whether a medium begins or ends at an instance along rays."""
    ray, inside = mi.Ray3f(ray), mi.Bool(False)
    crossings, active = mi.UInt32(0), mi.Bool(True)
    while dr.hint(active, label="crossings"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        inside |= active & (si.instance == instance) & si.is_medium_transition()
        ray = si.spawn_ray(ray.d)
        crossings += 1
        active &= ~inside & (crossings < MOST_CROSSINGS)
    return inside


def _warn_of_scale(scene: mi.Scene, grids: list[MediumGrid]) -> None:
    """Tells where Mitsuba's rays, which leave a surface at some distance from it, lose light."""
    corners = np.abs([np.array(scene.bbox().min), np.array(scene.bbox().max)])
    offset = (1 + corners[np.isfinite(corners)].max(initial=0.0)) * RAY_OFFSET
    for grid in grids:
        size = np.linalg.norm(grid.frame[:3, :3], axis=0).min()
        if offset > LARGEST_OFFSET * size:
            mi.Log(
                mi.LogLevel.Warn,
                f'irrcache: medium "{grid.name}" is {size:.2g} thin, and rays that leave surfaces '
                f"in this scene skip up to {offset:.1g}, as in volpath: light is lost. Scale the "
                "scene up, or move it to the origin.",
            )


def _refuse(reason: str, hint: str = "") -> None:
    raise UnsupportedSceneError(
        f"irrcache: {reason}, which would be rendered wrongly.{hint} Otherwise render this scene "
        'with "volpath".'
    )
