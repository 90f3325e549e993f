"""What irrcache finds in a scene, and what it has to refuse.

A scene is *simple* if all there is to it is one medium in a box or sphere, and light that comes
from far away or from points: then nothing has to be intersected, and every ray's way is known in
closed form. In all other scenes Mitsuba's ray tracing says where surfaces and boundaries are.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .boundary import Boundary, boundary_of
from .emission import Emission, place_emission
from .errors import UnsupportedSceneError
from .medium import MediumGrid, bake, children
from .phase import refuse_sharp
from .similarity import take_away_peak
from .surroundings import Surroundings
from .symbolic import symbolic
from .transport import MOST_CROSSINGS, is_null

#: Rays that find out whether a shape is closed, and the share of them that may say it is not:
#: edges are hit twice, or not at all.
CLOSED_RAYS, CLOSED_TOLERANCE = 1024, 0.05
#: Mitsuba's rays leave a surface at (1 + largest coordinate) times this, ...
RAY_OFFSET = 9e-5
#: ... which should not exceed this part of the shortest side of a medium.
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
    for shape in shapes:
        _check_shape(scene, shape)
    for medium, filled in media_of(scene).items():
        exact = _exact_boundary(scene, filled)
        grid = bake(medium, exact or Boundary("box", _extent(medium, filled)))
        grid.exact, grid.alone = exact is not None, alone
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
            take_away_peak(grid)
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
    name = f'medium "{medium.id()}" ({medium.class_name()})'
    if not boxes or not np.isfinite(boxes).all():
        _refuse(
            f"{name} fills no shape: it would reach to infinity, and a cache cannot",
            " Put a large shape with a null BSDF around the scene that has it as its interior.",
        )
    lower = np.max([b[0] for b in boxes], axis=0).astype(np.float64)
    upper = np.min([b[1] for b in boxes], axis=0).astype(np.float64)
    if not (lower < upper).all():
        _refuse(f"the grid of {name} lies outside of the shapes that it fills, or these are flat")
    frame = np.diag([*(0.5 * (upper - lower)), 1.0])
    frame[:3, 3] = 0.5 * (lower + upper)
    return frame


def _check_shape(scene: mi.Scene, shape: mi.Shape) -> None:
    name = f'shape "{shape.id()}" ({shape.class_name()})'
    if shape.class_name() == "Instance" and _has_media(scene, shape):
        _refuse(
            f"{name} is an instance of shapes with media, of which there is no telling where they "
            "are",
            " Place these shapes in the scene themselves.",
        )
    if shape.interior_medium() is None:
        return
    hit, inwards, open_ = _crossings(scene, shape)
    if inwards > 0.5 * hit:
        _refuse(
            f"the normals of {name} point inwards, so Mitsuba puts its interior medium outside of "
            "it",
            " Mirror its to_world once more, or toggle flip_normals.",
        )
    if inwards + open_ > CLOSED_TOLERANCE * hit:
        _refuse(
            f"{name} is not closed, or has a face in common with another shape: {inwards + open_} "
            f"of {hit} rays do not leave it as they entered, so its interior medium has no bounds",
            " Close it, or move the shapes apart by a thousandth of their size.",
        )


def _crossings(scene: mi.Scene, shape: mi.Shape) -> tuple[int, int, int]:
    """Of rays from outside through ``shape``: those that meet it, those that meet its inside first,
    and other ones that do not leave it as often as they enter.
    """
    first, depth, _ = _count_crossings(scene, mi.ShapePtr(shape), _rays_through(shape))
    inwards = first < 0
    open_ = (first > 0) & (depth != 0)
    return tuple(int(dr.count(c)[0]) for c in (first != 0, inwards, open_))


def _has_media(scene: mi.Scene, instance: mi.Shape) -> bool:
    """Whether rays through an instance come into a medium there."""
    *_, inside = _count_crossings(scene, mi.ShapePtr(instance), _rays_through(instance))
    return bool(dr.any(inside))


def _rays_through(shape: mi.Shape) -> mi.Ray3f:
    """From outside through the bounding box of a shape."""
    rng = mi.PCG32(CLOSED_RAYS)
    lower, upper = mi.Point3f(shape.bbox().min), mi.Point3f(shape.bbox().max)
    u = mi.Vector3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    target = lower + u * (upper - lower)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    direction = mi.warp.square_to_uniform_sphere(sample)
    return mi.Ray3f(target - 1.1 * dr.norm(upper - lower) * direction, direction)


@symbolic
def _count_crossings(scene: mi.Scene, shape: mi.ShapePtr, ray: mi.Ray3f):
    """How rays cross a shape first (1: inwards, -1: outwards, 0: never), and all of these added;
    whether a medium begins or ends at an instance of this shape.
    """
    ray, inside = mi.Ray3f(ray), mi.Bool(False)
    first, depth = mi.Int32(0), mi.Int32(0)
    crossings, active = mi.UInt32(0), mi.Bool(True)
    while dr.hint(active, label="crossings"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        inside |= active & (si.instance == shape) & si.is_medium_transition()
        step = dr.select(dr.dot(si.n, ray.d) < 0, mi.Int32(1), -1)
        step = dr.select(active & (si.shape == shape), step, 0)
        first = dr.select(first == 0, step, first)
        depth += step
        ray = si.spawn_ray(ray.d)
        crossings += 1
        active &= crossings < MOST_CROSSINGS
    return first, depth, inside


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
