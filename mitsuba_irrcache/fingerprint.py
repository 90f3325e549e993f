"""What a cache depends on: quick identities within a process, digests of the contents for files."""

from __future__ import annotations

import hashlib
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .grid import Field
from .medium import MediumGrid

#: Arrays of up to so many bytes are compared by their contents, all of them up to the second number
#: of bytes in a scene; of larger arrays, so many values are.
SMALL, SMALL_IN_ALL, SAMPLED = 1 << 17, 1 << 19, 1 << 12


class Snapshot:
    """The objects and parameters of a scene that its light depends on, as they are now. Comparing
    two of them launches no kernel unless a parameter was edited in between.

    It holds references of its own to Dr.Jit's variables, not to Mitsuba's members, which change
    with the scene. As long as it does, no other variable can get the index of one of them, and
    whatever writes to such an array (``dr.scatter``, ``params[key][i] = x``) writes to a copy,
    which has another index.

    Only memory that is written to through a NumPy view of an array keeps its index. So contents are
    compared, too, up to a size for which this takes no time; of larger arrays a few thousand values
    are. Who edits a larger array through a view has to call ``params.set_dirty``, as Mitsuba
    itself demands.

    A snapshot keeps the old arrays of an edited scene until the next rendering, which releases them
    before it makes the new cache.
    """

    def __init__(
        self,
        scene: mi.Scene,
        emission: mi.Volume | None = None,
        previous: Snapshot | None = None,
    ) -> None:
        """``emission`` belongs to the integrator, which may not be the scene's. What has not
        changed since the ``previous`` snapshot is shared with it, which makes comparing them quick.
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
        values = {
            key: value if kind is None else mi.get_property(value, kind, node)
            for key, (value, kind, node, _) in entries.items()
        }
        shared = {} if previous is None else previous._values
        budget = _Budget(SMALL_IN_ALL)
        self._values = {k: _kept(v, shared.get(k), budget) for k, v in values.items()}

    def changes(self, other: Snapshot) -> list[str]:
        """Names of the parameters that differ, and the classes of objects that only one has."""
        mine, theirs = self._values, other._values
        names = [k for k in mine.keys() | theirs.keys() if mine.get(k) != theirs.get(k)]
        return sorted({*names, *(node.class_name() for node in self._objects ^ other._objects)})

    def shares_objects_with(self, other: Snapshot) -> bool:
        """Whether both are of the same scene, or of scenes that have objects in common."""
        return not self._objects.isdisjoint(other._objects)


class _Budget:
    """Bytes that may still be compared by their contents."""

    __slots__ = ("left",)

    def __init__(self, left: int) -> None:
        self.left = left


class _Kept:
    """A one-dimensional Dr.Jit array, held and compared."""

    __slots__ = ("_array", "_bytes", "_kind", "_view", "_whole", "_width", "index")

    def __init__(self, array: Any, budget: _Budget) -> None:
        self._array = array = dr.detach(array)  # an object of our own, not the edited member
        self.index, self._kind, self._width = array.index, type(array), dr.width(array)
        self._view = self._bytes = None
        self._whole = False
        if array.state == dr.VarState.Literal or dr.backend_v(array) != dr.JitBackend.LLVM:
            return  # no memory that could be written to; on a GPU reading it would take time
        view = array.numpy()
        self._whole = view.nbytes <= min(SMALL, budget.left)
        self._view = view if self._whole else view[:: view.size // SAMPLED + 1]
        self._bytes = self._view.tobytes()
        budget.left -= view.nbytes if self._whole else 0

    @property
    def is_intact(self) -> bool:
        """Whether the memory of the array holds what it held, as far as that is compared."""
        return self._view is None or self._view.tobytes() == self._bytes

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Kept) or self._kind is not other._kind:
            return False
        if self._width != other._width or self._bytes != other._bytes:
            return False
        return self.index == other.index or (self._whole and other._whole)

    __hash__ = None


def _kept(value: Any, previous: Any, budget: _Budget) -> Any:
    """A form of ``value`` that stays as it is and can be compared; ``previous`` if it still is."""
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
    if isinstance(value, (bool, int, float, str, type(None))):
        return repr(value)  # in this form NaN is equal to itself
    matrix = getattr(value, "matrix", None)
    if matrix is not None:
        return _kept(matrix, previous, budget)
    if isinstance(value, mi.Object):
        return value
    array = np.array(value)
    return repr(value) if array.dtype == object else (array.dtype.str, array.tobytes())


def digests(scene: mi.Scene, medium: MediumGrid) -> dict[str, str]:
    """SHA-256 of the contents of each ingredient of the light in ``medium``."""
    boundary = medium.boundary
    found = {
        "medium": _medium_digest(medium),
        "boundary": _digest(boundary.kind, boundary.to_world),
        "emitters": _digest(*sorted(_emitter_digest(e) for e in scene.emitters())),
        "variant": "grey" if mi.is_monochromatic else "rgb",
    }
    if medium.surroundings is not None:
        media = medium.surroundings.media.grids
        found["media"] = _digest(*sorted(_medium_digest(grid) for grid in media))
        found["surfaces"] = _digest(*sorted(_shape_digest(s) for s in scene.shapes()))
    return found


def _medium_digest(medium: MediumGrid) -> str:
    parts = [*_field_parts(medium.sigma_t), *_field_parts(medium.albedo), medium.bbox or ()]
    if medium.phase is not None:
        parts.append(np.float32(medium.phase.moments))
    if medium.emission is not None:
        parts += ["emission", *_field_parts(medium.emission.field)]
    return _digest(*parts)


def _shape_digest(shape: mi.Shape) -> str:
    """Of a shape with its BSDF, and of which media are on its sides."""
    params = mi.traverse(shape)
    media = ("interior_medium", "exterior_medium")
    keys = [k for k in sorted(params.keys()) if not k.startswith(media)]
    values = [(key, np.array(_plain(params[key]))) for key in keys]
    sides = [m.id() if m else "" for m in (shape.interior_medium(), shape.exterior_medium())]
    bsdf = str(shape.bsdf())  # names all that is nested in it; its textures are in the values
    return _digest(shape.class_name(), bsdf, *sides, *(part for pair in values for part in pair))


def _field_parts(field: Field) -> tuple:
    if field.grid is None:
        return (np.array(field.value),)
    return (
        field.grid.shape,
        np.float32(field.grid.to_world),
        np.array(field.scale),
        field.channels,
        np.array(field.data),
    )


def _emitter_digest(emitter: mi.Emitter) -> str:
    params = mi.traverse(emitter)
    values = [(key, np.array(_plain(params[key]))) for key in sorted(params.keys())]
    return _digest(emitter.class_name(), *(part for pair in values for part in pair))


def _plain(value: Any) -> Any:
    matrix = getattr(value, "matrix", None)
    return value if matrix is None else matrix


def _digest(*parts: Any) -> str:
    sha = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else np.ascontiguousarray(part).tobytes()
        sha.update(len(data).to_bytes(8, "little"))
        sha.update(data)
    return sha.hexdigest()[:32]
