"""Convert Mitsuba's scene to its description, and refuse unsupported scenes.

A medium is *isolated* if it fills a box or sphere, the scene has no other medium and no surface,
and all emitters are distant or point-like: then no ray has to be intersected with shapes. In all
other scenes Mitsuba's ray tracing finds surfaces and boundaries.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.bounds import bounds_of_shapes, correct_mesh_bounds, lost_extent
from mitsuba_irrcache.core.detail import Detail
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.grids.boundary import Boundary, boundary_of, rays_through
from mitsuba_irrcache.lights.emitters import (
    POINT_LIKE,
    EmitterKind,
    EmittersByKind,
    are_distant,
    check_placement,
    illuminating,
    is_never_sampled,
    kind_of,
    varies_in_space,
)
from mitsuba_irrcache.lights.environments import detail_of, is_uneven
from mitsuba_irrcache.media.bake import bake, children
from mitsuba_irrcache.media.delta_m import without_forward_peak
from mitsuba_irrcache.media.emission import Emission, check_emission_is_within
from mitsuba_irrcache.media.medium import MediumContext, MediumGrid
from mitsuba_irrcache.media.phase import Phase, refuse_sharp
from mitsuba_irrcache.scene.consistency import (
    check_media_agree,
    check_sensor,
    described,
    ray_offset,
    warn_of_far_plane,
    warn_of_missing_medium,
)
from mitsuba_irrcache.scene.description import SceneDescription
from mitsuba_irrcache.scene.occluders import corners_of
from mitsuba_irrcache.transport.path import (
    MOST_CROSSINGS,
    Media,
    flags_of,
    is_null,
    is_surface,
    refracts,
    transmits,
)

#: Offset of Mitsuba's secondary rays from a surface, over the shortest side of a medium, above
#: which a warning is logged.
LARGEST_OFFSET = 0.002
#: Relative difference of the cosines of face normals and interpolated normals of an emissive mesh,
#: averaged over its area, above which a warning is logged.
MOST_LOST = 0.02
#: Classes of shapes on which Mitsuba samples no positions.
NOT_SAMPLED = "BSplineCurve", "LinearCurve", "Ellipsoids"
#: Area of the faces of an emissive mesh in its texture above which they must overlap there, and
#: tolerance of texture coordinates.
LARGEST_TEXTURE, SLACK = 1.001, 1e-3
#: Number of samples by which the radiance behind media is bounded, and kinds of emitters that are
#: seen by reflection only.
BOUND_SAMPLES, REFLECTED = 4096, (EmitterKind.SUN, *POINT_LIKE)
#: Minimum number of distinct single-precision coordinates within a side of a medium, and within a
#: voxel.
STEPS_OF_A_SIDE, STEPS_OF_A_VOXEL = 256, 8


def compile_scene(
    scene: mi.Scene, emission: Emission | None = None, max_depth: int = -1
) -> SceneDescription:
    """Create the description of ``scene``.

    ``emission`` is the emission coefficient of its media, ``max_depth`` the property of the
    integrator. Raises UnsupportedSceneError, naming the object, for scenes that would be rendered
    incorrectly.
    """
    correct_mesh_bounds(scene)
    emitters = EmittersByKind(illuminating(scene))
    media = media_of(scene)
    if not media:
        if emission is not None:
            check_emission_is_within(emission, [])
        return SceneDescription(Media([]), (), emitters)
    for medium, shapes in media.items():
        for shape in shapes:
            lower, upper = (np.array(p) for p in (shape.bbox().min, shape.bbox().max))
            finest = (upper - lower).max() / STEPS_OF_A_SIDE
            _check_distance(medium.id(), np.abs([lower, upper]).max(), finest)
    for emitter in scene.emitters():
        _warn_of_texture(emitter)
        check_placement(emitter)
        _warn_of_weight(emitter)
        _warn_of_normals(emitter)
        _warn_of_directional_area(emitter)
        _check_samples(emitter)
    _warn_of_lost_bounds(scene)
    for sensor in scene.sensors():
        check_sensor(scene, sensor)
        warn_of_missing_medium(scene, sensor)
        warn_of_far_plane(scene, sensor)
    has_surfaces = _has_surfaces(scene)
    boundary = _boundary_without_surfaces(scene, media)
    is_isolated = boundary is not None
    if is_isolated and _is_isotropic(*media):
        (medium,) = media
        context = MediumContext(detail=_detail(scene, emission, max_depth))
        grids = visible = (bake(medium, boundary).replaced(emission=emission, context=context),)
        if emission is not None:
            check_emission_is_within(emission, [grids[0].frame])
        brightest = bound = None
    else:
        if not is_isolated:
            _check_general(scene, media)
        unscaled, names, reason = _baked(scene, media, emission, is_isolated, max_depth)
        brightest = dr.opaque(mi.Float, _brightest(scene))
        largest = _background_bound(scene, float(brightest[0]), has_surfaces)
        bound = dr.opaque(mi.Float, largest)
        if emission is not None:
            check_emission_is_within(emission, [grid.frame for grid in unscaled])
        grids = tuple(_among_others(unscaled, number, names) for number in range(len(unscaled)))
        visible = tuple(grid for grid in grids if grid.name in names)
        if not visible:
            _warn_that_none_is_visible(emission, reason)
        _warn_of_scale(grids)
    for grid in visible:
        corners = grid.frame @ [[0, 1, 0, 0, 1], [0, 0, 1, 0, 1], [0, 0, 0, 1, 1], [1] * 5]
        _check_distance(grid.name, np.abs(corners[:3]).max(), grid.shortest_edge / STEPS_OF_A_VOXEL)
    return SceneDescription(Media(grids), visible, emitters, brightest, bound, has_surfaces)


def _detail(scene: mi.Scene, emission: Emission | None, max_depth: int) -> Detail:
    """Return how much the radiance in an isolated medium varies.

    Emission and single scattering count as sharp: single scattering has the shadows that the medium
    casts on itself, which higher orders blur.
    """
    if emission is not None or max_depth == 2:
        return Detail.SHARP
    return detail_of(illuminating(scene))


def _holds_emitters(scene: mi.Scene, frame: np.ndarray) -> bool:
    """Return whether the bounding box of any emitting shape meets that of the cube [-1, 1]^3 mapped
    by ``frame``.
    """
    shapes = (emitter.get_shape() for emitter in scene.emitters())
    return any((_sides_within(shape, frame) >= 0).all() for shape in shapes if shape is not None)


def _object_sizes(scene: mi.Scene, frame: np.ndarray) -> tuple[float, ...]:
    """Return `MediumContext.object_sizes` for a medium in the cube [-1, 1]^3 mapped by ``frame``.

    The second largest side, so that neither the length of a rod nor the thickness of a sheet
    counts.
    """
    sides = (_sides_within(shape, frame) for shape in scene.shapes() if is_surface(shape))
    return tuple(sorted({float(np.sort(s)[1]) for s in sides if (s >= 0).all()}))


def _sides_within(shape: mi.Shape, frame: np.ndarray) -> np.ndarray:
    """Return the sides (3) of the intersection of the bounding boxes of a shape and of the cube
    [-1, 1]^3 mapped by ``frame``; negative ones if they do not meet.
    """
    reach = np.abs(frame[:3, :3]).sum(axis=1)
    lower = np.maximum(np.array(shape.bbox().min), frame[:3, 3] - reach)
    return np.minimum(np.array(shape.bbox().max), frame[:3, 3] + reach) - lower


def _has_surfaces(scene: mi.Scene) -> bool:
    """Return whether any shape is more than the boundary of a medium."""
    return any(
        shape.bsdf() is not None and not is_null(int(shape.bsdf().flags()))
        for shape in scene.shapes()
    )


def _check_general(scene: mi.Scene, media: dict[mi.Medium, list[mi.Shape]]) -> None:
    """Raise UnsupportedSceneError for shapes and media that cannot be traced."""
    shapes = scene.shapes()
    for shape in shapes:
        _check_shape(scene, shape)
    for medium, filled in media.items():
        if not filled and medium.class_name() != "HeterogeneousMedium":
            _refuse_unbounded(medium, shapes)
    check_media_agree(scene)


def _baked(
    scene: mi.Scene,
    media: dict[mi.Medium, list[mi.Shape]],
    emission: Emission | None,
    is_isolated: bool,
    max_depth: int,
) -> tuple[list[MediumGrid], set[str], str]:
    """Convert all media to grids, without delta-M scaling.

    Returns the grids, the names of the visible media, and the reason why another one is not
    visible ("" if all are).
    """
    grids: list[MediumGrid] = []
    visible, reason = set(), ""
    for medium, filled in media.items():
        exact = _exact_boundary(scene, filled)
        pointer = mi.MediumPtr(medium)
        dr.make_opaque(pointer)
        boundary = exact or Boundary("box", _extent(medium, filled))
        grid = bake(medium, boundary).replaced(
            name=_unique_name(medium, [g.name for g in grids]),
            emission=emission,
            context=MediumContext(
                pointer,
                len(grids),
                is_isolated=is_isolated,
                has_exact_boundary=exact is not None,
                refracts=any(refracts(shape) for shape in filled),
                detail=_detail(scene, emission, max_depth) if is_isolated else Detail.SHARP,
                holds_emitters=_holds_emitters(scene, boundary.to_world),
                object_sizes=_object_sizes(scene, boundary.to_world),
            ),
        )
        if is_isolated and not is_uneven(scene.environment()):
            grid = grid.replaced(phase=grid.phase.in_even_light())
        grids.append(grid)
        if _is_visible(scene, medium):
            visible.add(grid.name)
            if not grid.phase.has_peak:
                refuse_sharp(grid.phase, f'medium "{medium.id()}" ({medium.class_name()})')
            continue
        why = _why_not_through_glass(scene, medium, grid.phase, max_depth)
        if why is None:
            visible.add(grid.name)
        reason = why or reason
    return grids, visible, reason


def _is_visible(scene: mi.Scene, medium: mi.Medium) -> bool:
    """Return whether a camera ray can reach a medium without crossing a surface other than a null
    one.
    """
    return any(is_null(flags_of(s)) for s in _around(scene, medium)) or any(
        sensor.get_medium() == medium for sensor in scene.sensors()
    )


def _around(scene: mi.Scene, medium: mi.Medium) -> list[mi.Shape]:
    """Return the shapes that have ``medium`` on either side."""
    return [s for s in scene.shapes() if medium in (s.interior_medium(), s.exterior_medium())]


def _why_not_through_glass(
    scene: mi.Scene, medium: mi.Medium, phase: Phase, max_depth: int
) -> str | None:
    """Return why a ``medium`` behind surfaces gets no cache; None if it gets one.

    Camera paths through glass end with their first collision in the medium, where the cache holds
    the sum of all orders of scattering only.
    """
    name = f'medium "{medium.id()}" ({medium.class_name()})'
    if not any(transmits(flags_of(s)) for s in _around(scene, medium)):
        return f"{name} is behind surfaces that transmit nothing"
    if max_depth >= 0:
        return (
            f"{name} is behind glass, where only all orders together (max_depth -1) are supported, "
            f"not max_depth {max_depth}"
        )
    if phase.order is None:
        return f"{name} is behind glass, and its phase function is too sharp for a cache there"
    return None


def _among_others(grids: list[MediumGrid], number: int, visible: set[str]) -> MediumGrid:
    """Return the medium with this number, with the others as context.

    It is scaled by delta-M if it is visible and its phase function has a forward peak.
    """
    medium = grids[number]
    others = tuple(grid for grid in grids if grid is not medium)
    if medium.name in visible and medium.phase.has_peak:
        medium = without_forward_peak(medium)
    return medium.replaced(context=medium.context.among(others)) if others else medium


def _warn_that_none_is_visible(emission: Emission | None, reason: str) -> None:
    if emission is not None:
        _refuse(f"{reason}, and volpath does not render the emission of media")
    mi.Log(
        mi.LogLevel.Warn,
        f"irrcache: {reason}, so this scene is rendered as volpath does. A shape that only bounds "
        'a medium needs <bsdf type="null"/>.',
    )


def _check_distance(name: str, distance: float, finest: float) -> None:
    """Refuse a medium too far from the origin for the resolution of single precision."""
    step = float(np.spacing(np.float32(distance)))
    if step > finest:
        _refuse(
            f'medium "{name}" is {distance:.2g} away from the origin, where positions in single '
            f"precision are {step:.1g} apart",
            " Scale it up, or move it to the origin.",
        )


def media_of(scene: mi.Scene) -> dict[mi.Medium, list[mi.Shape]]:
    """Return all media of a scene, each with the shapes that it fills.

    A shape with the same medium on both sides, such as a lamp in fog, does not bound it.
    """
    found: dict[mi.Medium, list[mi.Shape]] = {}
    for shape in scene.shapes():
        interior, exterior = shape.interior_medium(), shape.exterior_medium()
        if interior is not None:
            filled = found.setdefault(interior, [])
            filled += [shape] if interior != exterior else []
        if exterior is not None:
            found.setdefault(exterior, [])
    for sensor in scene.sensors():
        if sensor.get_medium() is not None:
            found.setdefault(sensor.get_medium(), [])
    return found


def _boundary_without_surfaces(
    scene: mi.Scene, media: dict[mi.Medium, list[mi.Shape]]
) -> Boundary | None:
    """Return the boundary of the single medium of a scene without surfaces; None otherwise."""
    bounded = [s for s in scene.shapes() if s.interior_medium() is not None]
    if len(media) != 1 or len(bounded) != 1:
        return None
    for shape in scene.shapes():
        if is_surface(shape) or shape.exterior_medium() is not None:
            return None
    try:
        return boundary_of(scene, bounded[0])
    except UnsupportedSceneError:
        return None


def _is_isotropic(medium: mi.Medium) -> bool:
    return medium.phase_function().class_name() == "IsotropicPhaseFunction"


def _exact_boundary(scene: mi.Scene, filled: list[mi.Shape]) -> Boundary | None:
    """Return the box or sphere that a medium fills; None if it fills other shapes or several."""
    try:
        return boundary_of(scene, filled[0]) if len(filled) == 1 else None
    except UnsupportedSceneError:
        return None


def _unique_name(medium: mi.Medium, taken: list[str]) -> str:
    """Return the medium's id, with a number if another medium has the same one."""
    name, number = medium.id(), 2
    while name in taken:
        name, number = f"{medium.id()}_{number}", number + 1
    return name


def _extent(medium: mi.Medium, filled: list[mi.Shape]) -> np.ndarray:
    """Return the map (4, 4) from the cube [-1, 1]^3 to the world box of ``medium``, the
    intersection of the bounding boxes of the shapes that it fills and of its grid.
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
    """Raise the error for a medium without bounds."""
    around = [s for s in shapes if s.exterior_medium() == medium]
    role = ""
    if around:
        more = f" and of {len(around) - 1} more" if len(around) > 1 else ""
        role = f"is the exterior of {described(around[0])}{more}, and "
    _refuse(
        f'medium "{medium.id()}" ({medium.class_name()}) {role}fills no shape: it would be '
        "infinite, and a cache cannot be",
        " Put a closed shape with a null BSDF, such as a cube, around everything that has it as "
        "its interior. Walls and objects within that shape need neither interior nor exterior, "
        "since rays that they reflect stay in the medium; only glass does.",
    )


def _check_shape(scene: mi.Scene, shape: mi.Shape) -> None:
    if shape.class_name() == "Instance" and _has_media(scene, shape):
        _refuse(
            f"{described(shape)} is an instance of shapes with media, whose positions Mitsuba does "
            "not report",
            " Put these shapes into the scene without an instance.",
        )


def _has_media(scene: mi.Scene, instance: mi.Shape) -> bool:
    """Return whether rays through an instance enter a medium there."""
    return bool(dr.any(_meets_media(scene, mi.ShapePtr(instance), rays_through(instance))))


@symbolic
def _meets_media(scene: mi.Scene, instance: mi.ShapePtr, ray: mi.Ray3f):
    """Return whether a medium begins or ends at an instance along rays."""
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


def _warn_of_lost_bounds(scene: mi.Scene) -> None:
    """Log a warning if volpath takes the scene to be smaller than it is."""
    if lost_extent(scene) and any(are_distant(e) for e in scene.emitters()):
        mi.Log(
            mi.LogLevel.Warn,
            "irrcache: Mitsuba has merged meshes of this scene, and lost the bounding boxes of "
            "rectangles among them, so that its own integrators miss distant shapes that occlude a "
            "sun or an environment: images by volpath may be too bright. Those by irrcache are not "
            "affected. To compare them, load the scene with optimize=False.",
        )


def _warn_of_scale(grids: Sequence[MediumGrid]) -> None:
    """Log a warning if Mitsuba's offset of rays from surfaces near a medium, which is proportional
    to their distance from the origin, is large compared to the medium.
    """
    for grid in grids:
        offset = ray_offset(corners_of(grid.frame))
        size = np.linalg.norm(grid.frame[:3, :3], axis=0).min()
        if offset > LARGEST_OFFSET * size:
            mi.Log(
                mi.LogLevel.Warn,
                f'irrcache: medium "{grid.name}" is {size:.2g} thin, and rays that leave surfaces '
                f"near it skip up to {offset:.1g}, as in volpath: the image is too dark. "
                "Scale the scene up, or move it to the origin.",
            )


def _warn_of_weight(emitter: mi.Emitter) -> None:
    """Log a warning for an emitter that is never sampled, and does not illuminate the scene."""
    if is_never_sampled(emitter):
        mi.Log(
            mi.LogLevel.Warn,
            f'irrcache: emitter "{emitter.id()}" has sampling_weight 0 and does not illuminate the '
            "scene, as with Mitsuba's integrators, which never sample it.",
        )


def _check_samples(emitter: mi.Emitter) -> None:
    """Refuse emitters that Mitsuba cannot sample, or whose radiance it evaluates to 0 wherever it
    samples a position.
    """
    shape = emitter.get_shape()
    if shape is not None and shape.class_name() in NOT_SAMPLED:
        raise UnsupportedSceneError(
            f"irrcache: {described(shape)} emits, and Mitsuba cannot sample positions on such "
            "shapes. Use a mesh, cylinders or spheres, or remove the emitter."
        )
    texture = children(emitter).get("radiance")
    if texture is not None and texture.class_name() == "MeshAttribute":
        raise UnsupportedSceneError(
            f'irrcache: the radiance of {described(emitter.get_shape())} is a "mesh_attribute", '
            "which Mitsuba evaluates to 0 at positions that it samples on a mesh: with volpath, "
            "too, such an emitter hardly illuminates the scene. Use a bitmap as its radiance, or a "
            "mesh for each value."
        )


def _warn_of_directional_area(emitter: mi.Emitter) -> None:
    """Log a warning for an emitter that only paths which start at emitters would find."""
    if kind_of(emitter) is EmitterKind.DIRECTIONAL_AREA:
        mi.Log(
            mi.LogLevel.Warn,
            f'irrcache: emitter "{emitter.id()}" ({emitter.class_name()}) illuminates nothing, as '
            "with volpath: paths from the camera cannot reach it. Use an emitter of the type "
            '"directional", "spot" or "area".',
        )


def _warn_of_texture(emitter: mi.Emitter) -> None:
    """Log a warning for textured emitters that Mitsuba samples wrongly: cylinders, and meshes on
    which positions share texture coordinates, of which it samples one only.
    """
    shape = emitter.get_shape()
    if shape is None or not varies_in_space(emitter):
        return
    if shape.class_name() == "Cylinder":
        mi.Log(
            mi.LogLevel.Warn,
            f"irrcache: {described(shape)} is a cylinder whose radiance is a texture, which "
            "Mitsuba samples with wrong densities, volpath as well: what it contributes to "
            'surfaces, and to media with the solver "path", has errors of up to a third. Use a '
            "mesh.",
        )
    params = mi.traverse(shape)
    if "vertex_texcoords" not in params or not len(params["vertex_texcoords"]):
        return
    coordinates = np.array(params["vertex_texcoords"], dtype=np.float64).reshape(-1, 2)
    corners = coordinates[np.array(params["faces"]).reshape(-1, 3)]
    sides = corners[:, 1:] - corners[:, :1]
    area = 0.5 * np.abs(np.linalg.det(sides)).sum()
    if area > LARGEST_TEXTURE or coordinates.min() < -SLACK or coordinates.max() > 1 + SLACK:
        mi.Log(
            mi.LogLevel.Warn,
            f"irrcache: {described(shape)} is a mesh whose radiance is a texture, and parts of it "
            f"share texture coordinates (its faces cover {area:.2g} times the texture, from "
            f"{coordinates.min():.2g} to {coordinates.max():.2g}). Mitsuba samples only one of "
            "these parts, volpath as well: the image is too dark. Give each part of the mesh its "
            "own coordinates between 0 and 1, or divide it into several shapes.",
        )


def _warn_of_normals(emitter: mi.Emitter) -> None:
    """Log a warning for an emissive mesh with interpolated normals: Mitsuba samples its emission by
    the cosine of these normals, and emits by those of the faces if rays hit it.
    """
    shape = emitter.get_shape()
    if shape is None or not shape.is_mesh() or not shape.has_vertex_normals():
        return
    params = mi.traverse(shape)
    if "vertex_normals" not in params or not len(params["vertex_normals"]):
        return
    corners, normals = (
        np.array(params[key], dtype=np.float64).reshape(-1, 3)
        for key in ("vertex_positions", "vertex_normals")
    )
    faces = np.array(params["faces"]).reshape(-1, 3)
    a, b, c = (corners[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    areas = np.linalg.norm(across, axis=1)
    cosines = np.einsum("ij,ikj->ik", across, normals[faces]).mean(axis=1)
    lost = 1 - cosines.sum() / max(areas.sum(), 1e-300)
    if lost > MOST_LOST:
        mi.Log(
            mi.LogLevel.Warn,
            f"irrcache: {described(shape)} is an emitter with interpolated vertex normals, which "
            f"differ from those of its faces (by a mean cosine of {1 - lost:.2g}). Mitsuba samples "
            "its emission by the former, which rays that hit it do not: volpath is inconsistent, "
            'and solver "sweep" uses the latter. Set face_normals to true.',
        )


def _brightest(scene: mi.Scene) -> float:
    """Estimate the maximum radiance of visible emitters."""
    rng = mi.PCG32(1024)
    si = dr.zeros(mi.SurfaceInteraction3f, 1024)
    si.uv = mi.Point2f(rng.next_float32(), rng.next_float32())
    found = [0.0]
    for emitter in scene.emitters():
        kind = kind_of(emitter)
        sample = mi.Point2f(rng.next_float32(), rng.next_float32())
        si.wi = (
            mi.warp.square_to_uniform_sphere(sample)
            if kind.is_environment
            else mi.Vector3f(0, 0, 1)
        )
        value = mi.Spectrum(emitter.eval(si))
        found.append(float(np.nanmax(np.array(value))))
    return max(f for f in found if np.isfinite(f))


def _background_bound(scene: mi.Scene, brightest: float, has_surfaces: bool) -> float:
    """Estimate an upper bound of the radiance behind media: ``brightest``, that of the environment
    in the directions that Mitsuba samples from it, which find a small sun, and what surfaces may
    reflect of suns and point-like emitters.
    """
    rng, count = mi.PCG32(BOUND_SAMPLES), BOUND_SAMPLES
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    place = mi.Vector3f(*(rng.next_float32() for _ in range(3)))
    ends = bounds_of_shapes(scene)
    low, high = ends if np.isfinite(ends).all() else (np.zeros(3), np.ones(3))
    vertex = dr.zeros(mi.Interaction3f, count)
    vertex.p = mi.Point3f(*map(float, low)) + place * mi.Vector3f(*map(float, high - low))
    found = [brightest]
    for emitter in scene.emitters():
        kind = kind_of(emitter)
        if kind.is_environment or (has_surfaces and kind in REFLECTED):
            record, value = emitter.sample_direction(vertex, sample)
            # The weight of a direction is the radiance over its density, or an irradiance.
            value *= record.pdf if kind.is_environment else 1
            largest = np.nanmax(np.where(np.isfinite(np.array(value)), np.array(value), 0))
            found.append(float(largest))
    return max(found)


def _refuse(reason: str, hint: str = "") -> None:
    raise UnsupportedSceneError(
        f"irrcache: {reason}, which would be rendered wrongly.{hint} Otherwise render this scene "
        'with "volpath".'
    )
