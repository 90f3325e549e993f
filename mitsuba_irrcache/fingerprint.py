"""What a cache depends on: quick identities within a process, digests of the contents for files."""

from __future__ import annotations

import hashlib
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .grid import Field
from .medium import MediumGrid


class Snapshot:
    """The light-carrying parameters of a scene, by identity: comparing two costs no kernel.

    It holds on to the arrays, so an array's identity cannot be given to another one. Sensors,
    films, samplers and integrators are no part of it. A parameter set to equal contents counts as
    changed.
    """

    def __init__(self, scene: mi.Scene, emission: mi.Volume | None = None) -> None:
        """``emission`` belongs to the integrator, which may not be the scene's."""
        camera_side = (mi.Sensor, mi.Film, mi.Sampler, mi.Integrator, mi.ReconstructionFilter)
        params = mi.traverse(scene)
        self._values = {
            key: params[key]
            for key, entry in params.properties.items()
            if not isinstance(entry[2], camera_side)
        }
        if emission is not None:
            own = mi.traverse(emission)
            self._values |= {f"emission.{key}": own[key] for key in own.keys()}
        self._identities = {key: _identity(value) for key, value in self._values.items()}

    def changes(self, other: Snapshot) -> list[str]:
        """Names of the parameters that differ."""
        mine, theirs = self._identities, other._identities
        return sorted(k for k in mine.keys() | theirs.keys() if mine.get(k) != theirs.get(k))


def _identity(value: Any) -> Any:
    if dr.is_tensor_v(value):
        return (value.shape, _identity(value.array))
    if dr.is_jit_v(value):
        if dr.depth_v(value) == 1:
            return value.index
        return tuple(_identity(component) for component in value)
    if dr.is_array_v(value):
        return tuple(np.array(value).ravel().tolist())
    matrix = getattr(value, "matrix", None)
    return _identity(matrix) if matrix is not None else value


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
