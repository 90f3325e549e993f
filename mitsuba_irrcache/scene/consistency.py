"""Check that the shapes of a scene define a unique medium at every position.

Mitsuba does not store which medium is where. Each ray has a current medium, which is replaced at
every shape with an ``interior`` or ``exterior`` medium. ``volpath`` therefore renders every scene,
but if boundaries overlap, leave a gap or have reversed normals, the medium at a position depends on
the path that led there. A cache depends on the position only, so such scenes are refused.

Random walks from outside and from the sensors find positions where a shape contradicts the current
medium of the ray. Because rays are offset from surfaces and may miss another surface nearby, each
suspected position is tested again: all shapes that straight rays from there hit first must define
the same medium.
"""

from __future__ import annotations

from collections import Counter

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.bounds import bounds_of_shapes
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.grids.boundary import orientation
from mitsuba_irrcache.transport.path import MOST_CROSSINGS, is_null, transmits

#: Number of walks from outside: minimum, per shape, and maximum; number from each sensor.
WALKS, WALKS_PER_SHAPE, MOST_WALKS, SENSOR_WALKS = 2048, 256, 1 << 16, 1024
#: Maximum number of events of a walk, and probability that a flight ends before the next surface.
EVENTS, TURNS = 24, 0.25
#: Maximum number of suspected positions that are tested, and number of rays from each.
PLACES, RAYS = 64, 64
#: Number of camera rays by which the position of the near plane is tested, and share of them that
#: begin in a medium above which a warning is logged.
VIEW_RAYS, LEAST_WITHIN = 1024, 0.02
#: Positions are sampled on a flight down to a distance of exp(-NEAREST) of its length to its ends.
NEAREST = 6.0
#: A position is disputed if at least `DISSENT` of its rays contradict the others, and a scene is
#: refused if at least `DISPUTED` positions are disputed. Single rays may be wrong at edges.
DISSENT, DISPUTED = 3, 2
#: Tolerated share of contradictory walks if no position is disputed; some occur at edges. The share
#: is larger if surfaces are closer together than the offset of rays.
ASTRAY = 0.05
#: A shape is considered not closed if more than this share of rays do not leave it as often as they
#: enter it, or hit its back first.
OPEN = 0.5
#: The normals of a shape are considered reversed if more than this share of rays hit its back
#: first; the share is 0.5 for a flat shape.
INWARDS = 0.6
#: Offset of Mitsuba's secondary rays from a surface, relative to 1 + the largest coordinate.
RAY_OFFSET = 9e-5

#: Results of a straight ray that determines the medium at its origin: no shape with media, a shape
#: with media, the ray leaves the scene.
_NOTHING, _CLAIM, _ESCAPE = 0, 1, 2


def check_media_agree(scene: mi.Scene) -> None:
    """Raise UnsupportedSceneError, naming shapes and media, unless the shapes of a scene define a
    unique medium everywhere.
    """
    shapes = [s for s in scene.shapes() if _bounds(s)]
    if not shapes:
        return
    # An exterior medium that no shape bounds may fill the outside of all shapes.
    outside = _nothing_is_outside(shapes)
    origin, direction, pointer, known = _starts(scene, shapes, bool(outside[0]))
    wrong, met, lost, place, *near = _walk(
        scene, mi.Ray3f(origin, direction), pointer, known, outside, dr.opaque(mi.UInt32, EVENTS)
    )
    near = [dr.reinterpret_array(mi.UInt32, shape) for shape in near]
    lost = dr.reinterpret_array(mi.UInt32, lost)
    dr.eval(wrong, met, lost, place, near)
    count, walks = int(dr.count(wrong)[0]), int(dr.count(met)[0])
    names = _Names(shapes, scene.shapes())
    (lane, *_) = np.nonzero(np.array(lost))
    if len(lane) > ASTRAY * walks:
        _refuse_infinite(names, int(np.array(lost)[lane[0]]))
    if not count:
        return
    chosen = np.unique(np.linspace(0, count - 1, min(count, PLACES)).astype(np.uint32))
    found = dr.gather(mi.UInt32, dr.compress(wrong), mi.UInt32(chosen))
    votes = _examine(scene, dr.gather(mi.Point3f, place, found), outside)
    disputes = [v for v in votes if _dissent(v) >= DISSENT]
    if len(disputes) >= min(DISPUTED, len(chosen)):
        _refuse_dispute(scene, names, max(disputes, key=_dissent))
    if count > ASTRAY * walks:
        pairs = np.array([dr.gather(mi.UInt32, shape, found) for shape in near]).T
        (pair, _), *_ = Counter(map(tuple, pairs.tolist())).most_common(1)
        _refuse_close(scene, names, *pair)


def check_sensor(scene: mi.Scene, sensor: mi.Sensor) -> None:
    """Raise UnsupportedSceneError for a sensor whose medium is not the one at its position.

    ``volpath`` would then extend this medium up to the first shape, without bounds, and show no
    environment behind it.
    """
    medium = sensor.get_medium()
    if medium is None:
        return
    shapes = [s for s in scene.shapes() if _bounds(s)]
    ray, _ = camera_rays(sensor, VIEW_RAYS)
    code, found, shape = _claims(scene, mi.Ray3f(ray.o, ray.d))
    outside = _nothing_is_outside(shapes)
    known = (code == _CLAIM) | (code == _ESCAPE) & outside
    wrong = known & (found != mi.MediumPtr(medium))
    number = dr.reinterpret_array(mi.UInt32, shape)
    dr.eval(known, wrong, number)
    share = int(dr.count(wrong)[0]) / max(int(dr.count(known)[0]), 1)
    if share <= ASTRAY:
        return
    named = Counter(np.array(number)[np.array(wrong)].tolist()).most_common(1)[0][0]
    by = _Names(shapes, scene.shapes()).shape(named)
    if share <= 0.5:
        at = dr.gather(mi.Point3f, ray.o, dr.compress(wrong)[:PLACES])
        votes = [_by_medium(v).most_common(1)[0][0] for v in _examine(scene, at, outside) if v]
        if votes.count(_number(mi.MediumPtr(medium))) >= 0.5 * len(votes):
            return  # the shapes contradict each other, which `check_media_agree` refuses
        raise UnsupportedSceneError(
            f'irrcache: sensor "{sensor.id()}" has the medium "{medium.id()}", but {share:.0%} of '
            f"its rays begin outside of it, according to {by}: its near plane or aperture is "
            "partly in the medium. Lower near_clip or the radius of the aperture, or move it. "
            'Otherwise render this scene with "volpath", which then extends the medium up to the '
            "next shape."
        )
    raise UnsupportedSceneError(
        f'irrcache: sensor "{sensor.id()}" has the medium "{medium.id()}", but is not located in '
        f"it, according to {by}. Remove the medium from the sensor, name the one in which it is "
        'located, or move it. Otherwise render this scene with "volpath", which then extends the '
        "medium up to the next shape."
    )


def warn_of_missing_medium(scene: mi.Scene, sensor: mi.Sensor) -> None:
    """Log a warning for a sensor in a medium that it does not name, or whose near plane is partly
    in a medium: its rays begin outside.
    """
    if sensor.get_medium() is not None:
        return
    ray, _ = camera_rays(sensor, VIEW_RAYS)
    code, found, _ = _claims(scene, mi.Ray3f(ray.o, ray.d))
    number = dr.select(code == _CLAIM, dr.reinterpret_array(mi.UInt32, found), 0)
    known = dr.count(code != _NOTHING)
    dr.eval(number, known)
    around = np.array(number)
    around = around[around > 0]
    share = around.size / max(int(known[0]), 1)
    if share <= LEAST_WITHIN:
        return
    named = Counter(around.tolist()).most_common(1)[0][0]
    shapes = scene.shapes()
    if share <= 0.5:
        mi.Log(
            mi.LogLevel.Warn,
            f'irrcache: the near plane of sensor "{sensor.id()}" lies in '
            f"{_Names(shapes, shapes).medium(named)} in {share:.0%} of its view. Rays that begin "
            "there begin in vacuum, as with Mitsuba's integrators: the image lacks the medium "
            "before the first surface, and is not that of volpath either. Lower near_clip.",
        )
        return
    mi.Log(
        mi.LogLevel.Warn,
        f'irrcache: sensor "{sensor.id()}" is located in {_Names(shapes, shapes).medium(named)}, '
        "but names no medium, so that its rays begin in vacuum, as with Mitsuba's integrators: the "
        "image lacks the medium between sensor and surfaces, and is not that of volpath either. "
        "Reference the medium within the sensor.",
    )


def warn_of_far_plane(scene: mi.Scene, sensor: mi.Sensor) -> None:
    """Log a warning for a far plane that hides what camera rays meet first, a medium among it."""
    ray, _ = camera_rays(sensor, RAYS)
    if not np.isfinite(np.array(ray.maxt)).any():
        return
    beyond = scene.ray_intersect(mi.Ray3f(ray.o, ray.d))
    is_hidden = beyond.is_valid() & ~scene.ray_test(ray)
    if sensor.get_medium() is None:
        is_hidden &= beyond.is_medium_transition()
    hidden = int(dr.count(is_hidden)[0])
    if hidden == 0:
        return
    # Rays begin at the near plane, and far_clip is a distance along the axis of the sensor.
    depth = (sensor.world_transform().inverse() @ beyond.p).z
    farthest = float(dr.max(dr.select(is_hidden, depth, 0))[0])
    is_inside = sensor.get_medium() is not None
    what = "the medium around it, and all behind it," if is_inside else "a medium"
    mi.Log(
        mi.LogLevel.Warn,
        f'irrcache: the far plane of sensor "{sensor.id()}" hides {what} in {hidden / RAYS:.0%} of '
        f"its view, as with volpath. Raise far_clip (Mitsuba's default is 10000) to more than "
        f"{farthest:.4g}.",
    )


def _nothing_is_outside(shapes: list[mi.Shape]) -> mi.Bool:
    """Return whether there is certainly no medium outside of all shapes.

    An exterior medium that is not the interior of any shape may be there.
    """
    filled = [s.interior_medium() for s in shapes]
    return dr.opaque(mi.Bool, all(s.exterior_medium() in (None, *filled) for s in shapes))


def camera_rays(sensor: mi.Sensor, count: int) -> tuple[mi.Ray3f, mi.Spectrum]:
    """Sample camera rays uniformly over the film of a sensor."""
    rng = mi.PCG32(count)
    film, aperture = (mi.Point2f(rng.next_float32(), rng.next_float32()) for _ in range(2))
    # Some sensors have no `sample_ray`.
    return sensor.sample_ray_differential(sensor.shutter_open(), 0.5, film, aperture)


def ray_offset(positions: np.ndarray) -> float:
    """Return by how much Mitsuba offsets secondary rays from surfaces at ``positions``, at most."""
    return float((1 + np.abs(positions).max(initial=0.0)) * RAY_OFFSET)


def described(shape: mi.Shape) -> str:
    """Describe a shape for a message, by its position if the scene does not name it."""
    if shape.id() and not shape.id().startswith("_unnamed"):
        return f'shape "{shape.id()}" ({shape.class_name()})'
    center = ", ".join(f"{float(x):.3g}" for x in np.array(shape.bbox().center()))
    return f"a shape without id ({shape.class_name()} at {center})"


def _bounds(shape: mi.Shape) -> bool:
    return shape.interior_medium() is not None or shape.exterior_medium() is not None


def _starts(
    scene: mi.Scene, shapes: list[mi.Shape], outside: bool
) -> tuple[mi.Point3f, mi.Vector3f, mi.MediumPtr, mi.Bool]:
    """Sample rays from outside through the bounds of each shape, and from the sensors.

    Returns origins, directions, the current medium, and whether that medium is known. Outside of
    all shapes it is known to be none if ``outside``. The medium of a sensor is known only if the
    sensor has one: without, ``volpath`` and irrcache treat it as outside of all media wherever it
    is.
    """
    boxes = np.array([[s.bbox().min, s.bbox().max] for s in shapes], dtype=np.float64).reshape(
        -1, 6
    )
    every = bounds_of_shapes(scene).reshape(6)
    boxes = np.where(np.isfinite(boxes), boxes, every)
    per_shape = max(WALKS_PER_SHAPE, WALKS // len(shapes))
    per_shape = max(1, min(per_shape, MOST_WALKS // len(shapes)))
    count = per_shape * len(shapes)
    rng = mi.PCG32(count)
    first = dr.arange(mi.UInt32, count) // per_shape * 6
    table = mi.Float(np.float32(boxes).ravel())
    lower, upper = (
        mi.Point3f(*(dr.gather(mi.Float, table, first + end + i) for i in range(3)))
        for end in (0, 3)
    )
    u = mi.Vector3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    direction = mi.warp.square_to_uniform_sphere(sample)
    size = np.linalg.norm(boxes[:, 3:].max(axis=0) - boxes[:, :3].min(axis=0))
    origin = lower + u * (upper - lower) - dr.opaque(mi.Float, 1.1 * float(size)) * direction
    none = dr.zeros(mi.MediumPtr)
    parts = [(count, origin, direction, none, outside)]
    for sensor in scene.sensors():
        start, _ = camera_rays(sensor, SENSOR_WALKS)
        medium = sensor.get_medium()
        pointer = none if medium is None else mi.MediumPtr(medium)
        parts.append((SENSOR_WALKS, start.o, start.d, pointer, medium is not None))

    def joined(kind: type, values: list) -> mi.Float:
        return dr.concat(
            [kind(v) + dr.zeros(kind, part[0]) for v, part in zip(values, parts, strict=True)]
        )

    origin, direction = (
        [joined(mi.Float, [part[k][i] for part in parts]) for i in range(3)] for k in (1, 2)
    )
    ids = joined(mi.UInt32, [dr.reinterpret_array(mi.UInt32, part[3]) for part in parts])
    known = joined(mi.UInt32, [int(part[4]) for part in parts]) > 0
    result = (
        mi.Point3f(origin),
        mi.Vector3f(direction),
        dr.reinterpret_array(mi.MediumPtr, ids),
        known,
    )
    dr.eval(result)
    return result


@symbolic
def _walk(
    scene: mi.Scene,
    ray: mi.Ray3f,
    pointer: mi.MediumPtr,
    known: mi.Bool,
    outside: mi.Bool,
    events: mi.UInt32,
):
    """Trace random walks with a current medium that changes as in ``volpath``.

    Returns whether a shape contradicts the current medium; whether any shape with media was hit;
    the medium of a ray that leaves the scene, if there may be a medium outside of all shapes (if
    not ``outside``); a position on the flight that led to the contradiction; the shape that
    contradicts, and the shape before it.
    """
    ray, pointer, known = mi.Ray3f(ray), mi.MediumPtr(pointer), mi.Bool(known)
    rng = mi.PCG32(dr.width(ray))
    wrong, met, place = mi.Bool(False), mi.Bool(False), mi.Point3f(0)
    contradicts, before = dr.zeros(mi.ShapePtr), dr.zeros(mi.ShapePtr)
    last, lost = mi.Point3f(ray.o), dr.zeros(mi.MediumPtr)
    event, active = mi.UInt32(0), mi.Bool(True)
    while dr.hint(active, label="walks"):
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        transition = hit & si.is_medium_transition()
        claim = si.target_medium(-ray.d)
        now = transition & known & (claim != pointer)
        # There is no medium outside of all shapes.
        escapes = active & ~hit & known & (pointer != None)  # noqa: E711
        now |= escapes & outside
        lost = dr.select(escapes & ~outside, pointer, lost)
        wrong |= now
        met |= transition
        # Prefer positions close to either end of the flight, from where small shapes appear large.
        end = dr.exp(-NEAREST * rng.next_float32(active)) / 2
        end = dr.select(rng.next_float32(active) < 0.5, end, 1 - end)
        length = dr.select(hit, si.t, dr.norm(ray.o - last))
        place = dr.select(now, ray(end * length), place)
        contradicts = dr.select(now & hit, si.shape, contradicts)
        turns, at, direction = _scattered(si, ray, rng, active)
        onwards = si.spawn_ray(direction)
        reaches = hit & ~turns
        pointer = dr.select(
            transition, dr.select(turns, claim, si.target_medium(direction)), pointer
        )
        known |= transition
        before = dr.select(reaches & ~now, si.shape, before)
        last = dr.select(hit, ray.o, last)
        ray.o = dr.select(turns, at, onwards.o)
        ray.d = direction
        event += 1
        active &= hit & ~now & (event < events)
    return wrong, met, lost, place, contradicts, before


def _scattered(
    si: mi.SurfaceInteraction3f, ray: mi.Ray3f, rng: mi.PCG32, active: mi.Bool
) -> tuple[mi.Bool, mi.Point3f, mi.Vector3f]:
    """Scatter before the surface, continue through it, or reflect.

    Returns whether the walk turns before the surface, a position where it may do so, and the
    direction in which it continues.
    """
    turns = rng.next_float32(active) < TURNS
    at = ray(rng.next_float32(active) * si.t)
    sample = mi.Point2f(rng.next_float32(active), rng.next_float32(active))
    anywhere = mi.warp.square_to_uniform_sphere(sample)
    flags = si.bsdf().flags()
    through = is_null(flags) | transmits(flags) & (rng.next_float32(active) < 0.5)
    side = dr.dot(si.n, ray.d)
    back = dr.select(dr.dot(anywhere, si.n) * side > 0, -anywhere, anywhere)
    return turns, at, dr.select(turns, anywhere, dr.select(through, ray.d, back))


def _examine(
    scene: mi.Scene, place: mi.Point3f, outside: mi.Bool
) -> list[dict[tuple[int, int], int]]:
    """Count, for each position, the straight rays that determine the medium there.

    The keys are the registry's numbers of the medium and of the shape that defines it; the latter
    is 0 for rays that leave the scene.
    """
    count = dr.width(place)
    index = dr.arange(mi.UInt32, count * RAYS)
    rng = mi.PCG32(count * RAYS)
    direction = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    origin = dr.gather(mi.Point3f, place, index // RAYS)
    code, medium, shape = _claims(scene, mi.Ray3f(origin, direction))
    numbers = [dr.reinterpret_array(mi.UInt32, pointer) for pointer in (medium, shape)]
    shared = np.array([dr.select(code == _ESCAPE, 0, n) for n in numbers]).T.reshape(count, RAYS, 2)
    said = np.array(code).reshape(count, RAYS)
    said = (said == _CLAIM) | (said == _ESCAPE) & bool(outside[0])
    return [
        Counter(tuple(row) for row in rows[which].tolist())
        for rows, which in zip(shared, said, strict=True)
    ]


@symbolic
def _claims(scene: mi.Scene, ray: mi.Ray3f):
    """Find the medium at the origin of rays according to the first shape with media along them.

    Rays continue through other shapes that transmit. Returns a code (`_NOTHING`, `_CLAIM` or
    `_ESCAPE`), the medium, and the shape.
    """
    ray, code = mi.Ray3f(ray), mi.UInt32(_NOTHING)
    medium, shape = dr.zeros(mi.MediumPtr), dr.zeros(mi.ShapePtr)
    event, active = mi.UInt32(0), mi.Bool(True)
    while dr.hint(active, label="claims"):
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        code = dr.select(active & ~hit, _ESCAPE, code)
        claims = hit & si.is_medium_transition()
        code = dr.select(claims, _CLAIM, code)
        medium = dr.select(claims, si.target_medium(-ray.d), medium)
        shape = dr.select(claims, si.shape, shape)
        active &= hit & ~claims & transmits(si.bsdf().flags())
        ray = si.spawn_ray(ray.d)
        event += 1
        active &= event < MOST_CROSSINGS
    return code, medium, shape


def _dissent(votes: Counter) -> int:
    """Count the rays that disagree with the medium that most rays indicate."""
    media = _by_medium(votes)
    return sum(media.values()) - max(media.values(), default=0)


def _by_medium(votes: Counter) -> Counter:
    media = Counter()
    for (medium, _), number in votes.items():
        media[medium] += number
    return media


class _Names:
    """Shapes and media by their numbers in Dr.Jit's registry."""

    def __init__(self, shapes: list[mi.Shape], every: list[mi.Shape]) -> None:
        self.shapes = {_number(mi.ShapePtr(s)): s for s in every}
        media = [m for s in shapes for m in (s.interior_medium(), s.exterior_medium())]
        self._media = {_number(mi.MediumPtr(m)): m for m in media if m is not None}

    def is_only_shape_of_its_medium(self, number: int) -> bool:
        """Return whether no other shape has the interior medium of this one."""
        interior = self.shapes[number].interior_medium()
        others = (s for n, s in self.shapes.items() if n != number)
        return all(interior not in (s.interior_medium(), s.exterior_medium()) for s in others)

    def medium(self, number: int) -> str:
        """Describe a medium for a message."""
        return f'medium "{self._media[number].id()}"' if number in self._media else "no medium"

    def shape(self, number: int) -> str:
        """Describe a shape and the media on both sides for a message."""
        shape = self.shapes.get(number)
        if shape is None:
            return "the outside of all shapes"
        sides = {"interior": shape.interior_medium(), "exterior": shape.exterior_medium()}
        said = " and ".join(f'{k} medium "{m.id()}"' for k, m in sides.items() if m is not None)
        return f"{described(shape)}" + (f" with {said}" if said else "")


def _number(pointer: mi.ShapePtr | mi.MediumPtr) -> int:
    return int(dr.reinterpret_array(mi.UInt32, pointer)[0])


def _refuse_dispute(scene: mi.Scene, names: _Names, votes: Counter) -> None:
    """Raise the error for a position at which shapes define different media."""
    (one, _), (other, _) = _by_medium(votes).most_common(2)
    sides = []
    for medium in (one, other):
        claims = Counter({shape: n for (m, shape), n in votes.items() if m == medium})
        sides.append(claims.most_common(1)[0][0])
    # The outside of all shapes is not an object that the user can change.
    known = [side for side in dict.fromkeys(sides) if side in names.shapes]
    if len(known) == 1:
        _refuse_single(scene, names, known[0], {one, other} - {0})
    for side in known:
        if (
            names.is_only_shape_of_its_medium(side)
            and max(orientation(scene, names.shapes[side])) > OPEN
        ):
            _refuse_single(scene, names, side, set())
    first, second = (names.shape(side) for side in sides)
    raise UnsupportedSceneError(
        f"irrcache: {first} and {second} disagree about the medium between them: "
        f"{names.medium(one)} according to the first, {names.medium(other)} according to the "
        "second. They overlap, or share a face, or there is a gap between them, or one is within "
        "the other and has another exterior than the medium around it. The medium would depend on "
        "the path of a ray. Move them apart by a thousandth of their size, or correct the "
        "exterior. Otherwise "
        'render this scene with "volpath", which shows the medium that was entered last.'
    )


def _refuse_single(scene: mi.Scene, names: _Names, number: int, media: set[int]) -> None:
    """Raise the error for a shape that contradicts itself, or the outside, about ``media``."""
    exterior = names.shapes[number].exterior_medium()
    if exterior is not None and media == {_number(mi.MediumPtr(exterior))}:
        raise UnsupportedSceneError(
            f"irrcache: {names.shape(number)} has the exterior medium on all sides, where it would "
            "reach to infinity. Put the shape into another one, with a null BSDF, that has this "
            "medium as its interior; or take the exterior away. Otherwise render this scene with "
            '"volpath".'
        )
    inwards, _ = orientation(scene, names.shapes[number])
    if inwards > INWARDS:
        raise UnsupportedSceneError(
            f"irrcache: the normals of {names.shape(number)} point inwards, so Mitsuba puts its "
            "interior medium outside of it, which would be rendered wrongly. Mirror its to_world "
            'once more, or toggle flip_normals. Otherwise render this scene with "volpath".'
        )
    raise UnsupportedSceneError(
        f"irrcache: {names.shape(number)} is not closed, or overlaps itself: some rays enter its "
        "medium twice, or leave it without having entered. (Mitsuba "
        "merges meshes that bound the same medium into one shape.) Close it, or move its parts "
        'apart by a thousandth of their size. Otherwise render this scene with "volpath".'
    )


def _refuse_infinite(names: _Names, medium: int) -> None:
    """Raise the error for a medium in which rays leave the scene."""
    raise UnsupportedSceneError(
        f"irrcache: {names.medium(medium)} is the exterior of shapes, but the interior of none: it "
        "would be infinite, and no radiance of an environment would reach the camera. Put a closed "
        "shape with a null BSDF, such as a cube, around the scene, and make the medium its "
        "interior. Otherwise "
        'render this scene with "volpath".'
    )


def _refuse_close(scene: mi.Scene, names: _Names, first: int, second: int) -> None:
    """Raise the error for shapes that are closer to each other than Mitsuba's ray offset."""
    corners = bounds_of_shapes(scene)
    offset = ray_offset(corners[np.isfinite(corners)])
    raise UnsupportedSceneError(
        f"irrcache: {names.shape(first)} is closer to {names.shape(second)} than Mitsuba's rays "
        f"resolve: they leave a surface at a distance of up to {offset:.1g} here, and miss what "
        "is nearer. Media would be missing, as with volpath. Move the shapes apart by a few times "
        "as much, or scale the scene up."
    )
