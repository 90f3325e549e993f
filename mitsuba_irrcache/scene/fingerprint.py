"""Inputs of a cache, compared by identity in a process (`SceneVersion`), in files by `digests`; and
those of an image (`SensorVersion`).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.bounds import bounds_of_shapes
from mitsuba_irrcache.core.jit import graph_variables
from mitsuba_irrcache.grids.fields import Field
from mitsuba_irrcache.lights.emitters import SPOT_LIKE, EmittersByKind
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.transport.path import Media

#: Maximum number of bytes of an array, and of all arrays of a scene together, up to which whole
#: contents are compared; number of values compared in larger arrays.
SMALL, SMALL_IN_ALL, SAMPLED = 1 << 17, 1 << 19, 1 << 12
#: Names of the inputs in `digests` that are compared with a tolerance, the number of rays per
#: shape and of positions per emitter, and the tolerance of their means.
RESPONSES, RESPONSE_RAYS, BEAMS, POSITIONS = "responses of surfaces", 512, "beams", 4096
TOLERANCE = 1e-4
#: Parts of ``str(object)`` that are not properties of the object: mesh name, scene bounds, address.
_ELSEWHERE = re.compile(
    r"\A\w+\[\s*name = [^\n]*|\bbsphere = \w+\[.*?\n *\],?|0x[0-9a-f]+", re.DOTALL
)


class SceneVersion:
    """Objects and parameters of a scene on which its caches depend, at one time.

    Comparing two versions launches no kernel unless a parameter was edited in between. A version
    references Dr.Jit variables directly, not the members of Mitsuba's objects, which change with
    the scene. While it holds a variable, no other variable can get the same index, and all
    operations that write to such an array (``dr.scatter``, ``params[key][i] = x``) write to a copy
    with another index.

    Only writes through a NumPy view of an array (on a GPU, one of another library) keep its index.
    Therefore the contents of small arrays are compared too, and a few thousand values of larger
    ones. Code that edits a large array through a view has to call ``params.set_dirty``, which
    Mitsuba requires as well.

    Reading a literal, a constant without memory, as a NumPy array gives it memory and another
    index: what has the same contents is no edit.

    A version keeps the old arrays of an edited scene alive until the next rendering, which
    releases them before it creates the new cache.
    """

    def __init__(
        self,
        scene: mi.Scene,
        emission: mi.Volume | None = None,
        previous: SceneVersion | None = None,
        selected: Callable[[str, mi.Object], bool] = lambda name, node: True,
    ) -> None:
        """Record the present version of ``scene``.

        ``emission`` is a volume of the integrator, which need not be part of the scene. Values that
        have not changed since the ``previous`` version are shared with it, so that comparing the
        two is fast. Parameters that are not ``selected``, by name and object, are left out.
        """
        params = mi.traverse(scene)
        camera_side = (mi.Sensor, mi.Film, mi.Sampler, mi.Integrator, mi.ReconstructionFilter)
        # The scene owns the integrator, which owns this: holding it, neither would be freed.
        self._objects = {
            node
            for node in params.hierarchy
            if not isinstance(node, (mi.Scene, *camera_side)) and node is not emission
        }
        entries = {k: e for k, e in params.properties.items() if not isinstance(e[2], camera_side)}
        if emission is not None:
            own = mi.traverse(emission).properties
            entries |= {f"emission.{key}": entry for key, entry in own.items()}
        values = {key: _value(e) for key, e in entries.items() if selected(key, e[2])}
        #: whether a parameter carries gradients
        self.carries_gradients = any(map(graph_variables, values.values()))
        shared = {} if previous is None else previous._values
        budget = _Budget(SMALL_IN_ALL)
        self._values = {k: _kept(v, shared.get(k), budget) for k, v in values.items()}

    def changes(self, other: SceneVersion) -> list[str]:
        """Return names of differing parameters, and classes of objects that only one has."""
        names = _different(self._values, other._values)
        return sorted({*names, *(node.class_name() for node in self._objects ^ other._objects)})

    def shares_objects_with(self, other: SceneVersion) -> bool:
        """Return whether both belong to the same scene, or to scenes that share objects."""
        return not self._objects.isdisjoint(other._objects)


class SensorVersion:
    """Parameters of a sensor and of its film at one time, like those of a `SceneVersion`."""

    def __init__(self, sensor: mi.Sensor) -> None:
        entries, budget = mi.traverse(sensor).properties, _Budget(SMALL_IN_ALL)
        self._values = {
            key: _kept(_value(entry), None, budget)
            for key, entry in entries.items()
            if not isinstance(entry[2], mi.Sampler)
        }

    def changes(self, other: SensorVersion) -> list[str]:
        """Return the names of differing parameters."""
        return sorted(_different(self._values, other._values))


def _different(mine: dict[str, Any], theirs: dict[str, Any]) -> list[str]:
    """Return the keys whose values differ, or that only one has."""
    return [key for key in mine.keys() | theirs.keys() if mine.get(key) != theirs.get(key)]


def values_of(value: Any) -> np.ndarray:
    """Return a Dr.Jit array, or anything else, as a NumPy array; it stays as it is.

    NumPy evaluates what it reads, so that a literal of a scene would get memory and another index,
    and the kernels that use it another text: a copy is read, which shares all other memory.
    """
    return np.array(dr.detach(value) if dr.is_array_v(value) else value)


def _value(entry: tuple) -> Any:
    """Return the value of a traversed parameter; None if the plugin has none."""
    value, kind, node, _ = entry
    return value if kind is None else mi.get_property(value, kind, node)


def _is_transform(value: Any) -> bool:
    """Return whether a value is a transform. Points accept any attribute name as a swizzle."""
    return not dr.is_array_v(value) and hasattr(value, "matrix")


class _Budget:
    """Number of bytes, ``left``, up to which contents may still be compared."""

    __slots__ = ("left",)

    def __init__(self, left: int) -> None:
        self.left = left


class _Kept:
    """A one-dimensional Dr.Jit array kept for comparison."""

    __slots__ = ("_array", "_bytes", "_kind", "_view", "_whole", "_width", "index")

    def __init__(self, array: Any, budget: _Budget) -> None:
        self._array = array = dr.detach(array)  # an object of our own, not the edited member
        self.index, self._kind, self._width = array.index, type(array), dr.width(array)
        self._view = self._bytes = None
        self._whole = False
        size = dr.itemsize_v(array) * self._width
        if array.state == dr.VarState.Literal:  # no memory that could be written to
            self._whole = size <= SMALL
            return
        self._whole = size <= min(SMALL, budget.left)
        budget.left -= size if self._whole else 0
        if dr.backend_v(array) == dr.JitBackend.LLVM:
            view = array.numpy()
            self._view = view if self._whole else view[:: self._stride]
        self._bytes = self._read()

    @property
    def _stride(self) -> int:
        return self._width // SAMPLED + 1

    def _read(self) -> bytes:
        """Read the values that are compared; those of GPUs are copied at each call."""
        if self._view is not None:
            return self._view.tobytes()
        if self._whole:
            return self._array.numpy().tobytes()
        place = dr.arange(mi.UInt32, -(-self._width // self._stride)) * self._stride
        return dr.gather(self._kind, self._array, place).numpy().tobytes()

    @property
    def _contents(self) -> bytes:
        """The values when this was made; those of a literal are read when they are asked for."""
        return values_of(self._array).tobytes() if self._bytes is None else self._bytes

    @property
    def is_intact(self) -> bool:
        """Whether the memory of the array is unchanged, as far as it is compared."""
        return self._bytes is None or self._read() == self._bytes

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Kept) or self._kind is not other._kind:
            return False
        if self._width != other._width:
            return False
        if self.index == other.index:
            return self._bytes == other._bytes
        return self._whole and other._whole and self._contents == other._contents

    __hash__ = None


def _kept(value: Any, previous: Any, budget: _Budget) -> Any:
    """Return an immutable, comparable form of ``value``; ``previous`` if it is unchanged."""
    if value is None:  # unset parameters, such as those of "hair"
        return repr(value)
    if dr.is_jit_v(value):
        if dr.is_tensor_v(value):
            parts, shape = (value.array,), value.shape
        elif dr.depth_v(value) > 1:
            parts, shape = tuple(value), ()
        elif type(previous) is _Kept and previous.index == value.index and previous.is_intact:
            return previous
        else:
            return _Kept(value, budget)
        known = previous[1] if type(previous) is tuple else ()
        if len(known) != len(parts):
            known = (None,) * len(parts)
        return shape, tuple(_kept(p, k, budget) for p, k in zip(parts, known, strict=True))
    if isinstance(value, (bool, int, float, str)):
        return repr(value)  # in this form NaN is equal to itself
    if isinstance(value, mi.Object):
        return value
    if _is_transform(value):
        return _kept(value.matrix, previous, budget)
    array = values_of(value)
    return repr(value) if array.dtype == object else (array.dtype.str, array.tobytes())


def digests(scene: mi.Scene, media: Media, medium: MediumGrid) -> dict[str, str]:
    """Return a digest (128 bits) of each input of the irradiance in ``medium``, by its name.

    ``medium`` is one of the ``media`` of the scene. `RESPONSES` and `BEAMS` are not digests, see
    `responses`.
    """
    boundary = medium.boundary
    found = {
        "medium": _medium_digest(medium),
        "boundary": _digest(boundary.kind, boundary.to_world),
        "emitters": digest_of_emitters(scene),
        "variant": "grey" if mi.is_monochromatic else "rgb",
    }
    if medium.is_traced:
        found["media"] = _digest(*sorted(_medium_digest(grid) for grid in media.grids))
        found["surfaces"] = digest_of_surfaces(scene)
        found[RESPONSES] = responses(scene)
    found[BEAMS] = beams(scene)
    return found


def digest_of_emitters(scene: mi.Scene) -> str:
    """Compute the SHA-256 of all emitters, whatever their order."""
    return _digest(*sorted(_object_digest(emitter) for emitter in scene.emitters()))


def digest_of_surfaces(scene: mi.Scene) -> str:
    """Compute the SHA-256 of all shapes, whatever their order."""
    return _digest(*sorted(_shape_digest(shape) for shape in scene.shapes()))


def differing(mine: dict[str, str], theirs: dict[str, str]) -> list[str]:
    """Return the names of the inputs that differ between two results of `digests`."""
    names = sorted(mine.keys() | theirs.keys())
    return [n for n in names if not _agree(n, mine.get(n), theirs.get(n))]


def _agree(name: str, mine: str | None, theirs: str | None) -> bool:
    if name not in (RESPONSES, BEAMS) or mine is None or theirs is None:
        return mine == theirs
    try:
        first, second = (np.array(text.split(), dtype=np.float64) for text in (mine, theirs))
    except ValueError:
        return False
    return first.shape == second.shape and bool((np.abs(first - second) <= TOLERANCE).all())


def responses(scene: mi.Scene) -> str:
    """Return statistics of random rays that hit each shape of a scene, as text: numbers in [0, 1].

    Some options of Mitsuba's plugins are neither traversed parameters nor part of ``str(plugin)``
    (the filter of a bitmap, the normals of an sdfgrid, invalid normals of a bump map, ...), but
    they change normals, BSDF values and emission at intersections. Rounding of these numbers
    differs between machines, so they are compared with a tolerance instead of being digested.
    """
    shapes = sorted(scene.shapes(), key=_shape_digest)
    if not shapes:
        return ""
    lower, upper = (
        np.array([getattr(shape.bbox(), end) for shape in shapes], dtype=np.float32).T
        for end in ("min", "max")
    )
    count = len(shapes) * RESPONSE_RAYS
    shape = dr.arange(mi.UInt32, count) // RESPONSE_RAYS
    lower, upper = (
        mi.Point3f([dr.gather(mi.Float, mi.Float(row), shape) for row in rows])
        for rows in (lower, upper)
    )
    # The same random numbers for each shape: their order does not matter.
    lane = dr.arange(mi.UInt32, count) % RESPONSE_RAYS
    draws = [mi.sample_tea_float32(lane, mi.UInt32(k), 6) for k in range(16)]
    target = lower + mi.Point3f(draws[:3]) * (upper - lower)
    direction = mi.warp.square_to_uniform_sphere(mi.Point2f(draws[3:5]))
    ray = mi.Ray3f(target - 1.01 * dr.norm(upper - lower) * direction, direction)
    si = scene.ray_intersect(ray)
    valid, bsdf = si.is_valid(), si.bsdf()
    outgoing = mi.warp.square_to_uniform_sphere(mi.Point2f(draws[5:7]))
    context, random = mi.BSDFContext(), mi.Point2f(draws[8:10])
    reflected = bsdf.eval(context, si, outgoing, valid)
    sample, weight = bsdf.sample(context, si, draws[7], random, valid)
    emitted = si.emitter(scene).eval(si, valid)
    axis = mi.warp.square_to_uniform_sphere(mi.Point2f(draws[10:12]))
    found = [
        0.5 + 0.5 * dr.dot(axis, si.n),
        0.5 + 0.5 * dr.dot(axis, si.sh_frame.n),
        0.5 + 0.5 * dr.dot(axis, sample.wo),
        *(_squashed(value) for value in (reflected, weight, emitted)),
    ]
    # Random weights distinguish responses that have the same mean.
    sums = [dr.block_sum(dr.select(valid, value, 0) * draws[12], RESPONSE_RAYS) for value in found]
    numbers = np.nan_to_num(np.array(sums, dtype=np.float64) / RESPONSE_RAYS, nan=1.0)
    return " ".join(f"{number:.6f}" for number in numbers.T.ravel())


def beams(scene: mi.Scene) -> str:
    """Return statistics of the irradiance from spot lights and projectors, as `responses`: the
    filter of their textures is neither a traversed parameter nor part of ``str(emitter)``.
    """
    found, emitters = [], EmittersByKind(scene.emitters()).of(*SPOT_LIKE)
    lower, upper = (mi.Point3f(*map(float, end)) for end in bounds_of_shapes(scene))
    draws = [
        mi.sample_tea_float32(dr.arange(mi.UInt32, POSITIONS), mi.UInt32(k), 6) for k in range(4)
    ]
    at = dr.zeros(mi.Interaction3f, POSITIONS)
    at.p = lower + mi.Point3f(draws[:3]) * (upper - lower)
    for emitter in sorted(emitters, key=_object_digest):
        _, irradiance = emitter.sample_direction(at, mi.Point2f(0.5))
        found.append(float(dr.mean(_squashed(irradiance) * draws[3])[0]))
    return " ".join(f"{number:.6f}" for number in found)


def _squashed(value: mi.Spectrum) -> mi.Float:
    """Map a radiance or BSDF of any magnitude to [0, 1], with different weights of channels."""
    parts = [channel / (1 + dr.abs(channel)) for channel in mi.Spectrum(value)]
    scale = 1 / len(parts)
    total = sum((i + 1) * scale * dr.clip(part, 0, 1) for i, part in enumerate(parts))
    return dr.select(dr.isfinite(total), total * scale, 1)


def _medium_digest(medium: MediumGrid) -> str:
    parts = [*_field_parts(medium.sigma_t), *_field_parts(medium.albedo), medium.bbox or ()]
    if not medium.phase.is_isotropic:
        parts.append(np.float32(medium.phase.moments))
    if medium.emission is not None:
        parts += ["emission", *_field_parts(medium.emission.field)]
    return _digest(*parts)


def _shape_digest(shape: mi.Shape) -> str:
    """Return the SHA-256 of a shape with its BSDF and emitter, and the names of its media."""
    sides = [m.id() if m else "" for m in (shape.interior_medium(), shape.exterior_medium())]
    flags = shape.has_flipped_normals(), shape.is_mesh() and shape.has_face_normals()
    media = ("interior_medium", "exterior_medium")
    return _digest(_object_digest(shape, media), str(flags), *sides)


def _object_digest(node: mi.Object, without: tuple[str, ...] = ()) -> str:
    """Return the SHA-256 of an object: of the exact values of its traversed parameters, except
    those ``without`` these prefixes, and of ``str(node)``, which names nested objects and options.
    """
    values = [
        (key, values_of(_plain(value)))
        for key, entry in sorted(mi.traverse(node).properties.items())
        if not key.startswith(without or "\0") and (value := _value(entry)) is not None
    ]
    description = _ELSEWHERE.sub("", str(node))
    return _digest(node.class_name(), description, *(part for pair in values for part in pair))


def _field_parts(field: Field) -> tuple:
    if field.grid is None:
        return (values_of(field.value),)
    return (
        field.grid.shape,
        np.float32(field.grid.to_world),
        values_of(field.scale),
        field.channels,
        values_of(field.data),
    )


def _plain(value: Any) -> Any:
    return value.matrix if _is_transform(value) else value


def _digest(*parts: Any) -> str:
    sha = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else np.ascontiguousarray(part).tobytes()
        sha.update(len(data).to_bytes(8, "little"))
        sha.update(data)
    return sha.hexdigest()[:32]
