"""The parameters of a scene with respect to which gradients are computed; others are refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients.film import LUMINANCE
from mitsuba_irrcache.grids.fields import Field
from mitsuba_irrcache.media.bake import children
from mitsuba_irrcache.media.medium import MediumGrid

#: Roles of a parameter in a medium.
SIGMA_T, ALBEDO, EMISSION, MEAN_COSINE = "sigma_t", "albedo", "emission", "g"
#: Parameters that are the position or the direction of emitters, by class.
PLACED = {"PointLight": "position", "DirectionalEmitter": "to_world"}
#: Textures of emitters on which their radiance depends linearly.
RADIANCE = ("radiance", "irradiance", "intensity")


class Placement:
    """The role of a parameter that is the position or the direction of an ``emitter``."""

    def __init__(self, emitter: mi.Emitter) -> None:
        self.emitter = emitter


class SharedTexture:
    """The role of a texture on which several emitters or BSDFs, the ``users``, depend."""

    def __init__(self, users: Sequence[mi.Object]) -> None:
        self.users = tuple(users)


def enabled(params: Mapping) -> list[str]:
    """Return the keys of the parameters that carry gradients.

    Raises IrrcacheError if an enclosing integrator does not pass the parameters on.
    """
    if not hasattr(params, "keys"):
        raise IrrcacheError(
            "irrcache computes no gradients within another integrator, which does not hand on the "
            'parameters; render with irrcache itself, or use the integrator "prbvolpath".'
        )
    return [key for key in params.keys() if _is_enabled(params[key])]


def _is_enabled(value: object) -> bool:
    if not dr.is_array_v(value):
        value = getattr(value, "matrix", None)  # of a transform
    return value is not None and dr.grad_enabled(value)


def roles_of(
    params: mi.SceneParameters,
    keys: list[str],
    medium: mi.Medium,
    scene: mi.Scene,
    emission: object = None,
) -> dict[str, str | mi.Emitter]:
    """Return the role of each of the parameters ``keys``, by key.

    A role is `SIGMA_T` or `ALBEDO` of ``medium``, the `MEAN_COSINE` of its phase function ``hg``,
    its `EMISSION` if the parameter belongs to the integrator's volume ``emission``, the emitter
    whose radiance the parameter is, or a `Placement` (isotropic media only).

    Raises IrrcacheError for any other parameter.
    """
    nodes = nodes_of_medium(params, keys, medium, emission) | nodes_of_emitters(scene)
    roles = {}
    for key in keys:
        node = params.properties[key][2]
        placed = PLACED.get(node.class_name()) == key.rpartition(".")[2]
        if is_mean_cosine(params, key, medium):
            roles[key] = MEAN_COSINE
        elif placed and medium.phase_function().class_name() == "IsotropicPhaseFunction":
            roles[key] = Placement(node)
        else:
            roles[key] = role_of(params, key, nodes)
            if isinstance(roles[key], SharedTexture):
                refuse(key, "several emitters depend on it; give each a texture of its own")
    return roles


def is_mean_cosine(params: mi.SceneParameters, key: str, medium: mi.Medium) -> bool:
    """Return whether a parameter is the mean cosine of the phase function ``hg`` of a medium."""
    node = params.properties[key][2]
    return node == medium.phase_function() and node.class_name() == "HGPhaseFunction"


def check_role(key: str, role: str, medium: MediumGrid) -> None:
    """Refuse derivatives by a mean cosine of 0, for which the cache has no moments, and by an
    emission of 0 everywhere, which is ignored.
    """
    if role == MEAN_COSINE and medium.phase.is_isotropic:
        refuse(key, "it is 0, where scattering is isotropic; start with 0.01 or -0.01")
    if role == EMISSION and medium.emission is None:
        reason = "the emission is 0 everywhere, and ignored"
        refuse_all([key], reason, "Start with a small positive value")


def role_of(params: mi.SceneParameters, key: str, nodes: Mapping[mi.Object, object]) -> object:
    """Return what ``nodes`` have for the object to which the parameter ``key`` belongs.

    Raises IrrcacheError if there is none, or if the parameter is none of its values.
    """
    node, last = params.properties[key][2], key.rpartition(".")[2]
    is_texels = node.class_name() == "EnvironmentMapEmitter" and last == "data"
    if isinstance(node, mi.Emitter) and not is_texels:
        refuse(key, f'"{last}" is not the radiance of the {node.class_name()}')
    if node not in nodes or last not in ("data", "value"):
        refuse(key, f"it belongs to a {node.class_name()}")
    return nodes[node]


def nodes_of_medium(
    params: mi.SceneParameters, keys: list[str], medium: mi.Medium, emission: object = None
) -> dict[mi.Object, str]:
    """Return the roles of the volumes of a ``medium``, and of objects within these."""
    own = children(medium)
    volumes = {SIGMA_T: own["sigma_t"], ALBEDO: own["albedo"]}
    nodes: dict[mi.Object, str] = dict.fromkeys(nodes_of_emission(emission), EMISSION)
    for role, volume in volumes.items():
        for node in (volume, *children(volume).values()):
            if nodes.get(node, role) != role:
                reason = f"both {nodes[node]} and {role} depend on it"
                refuse(key_of_node(params, keys, node, SIGMA_T), reason)
            nodes[node] = role
    return nodes


def nodes_of_emission(emission: object) -> tuple[mi.Object, ...]:
    """Return the integrator's volume ``emission`` and objects within it; nothing if it is none."""
    if not isinstance(emission, mi.Volume):
        return ()
    return emission, *children(emission).values()


def nodes_of_emitters(scene: mi.Scene) -> dict[mi.Object, mi.Emitter | SharedTexture]:
    """Return the emitters of ``scene`` and the textures of their radiance."""
    nodes: dict[mi.Object, object] = {}
    for emitter in scene.emitters():
        textures = (node for name, node in children(emitter).items() if name in RADIANCE)
        for node in (emitter, *textures):
            add_user(nodes, node, emitter)
    return nodes


def add_user(nodes: dict[mi.Object, object], node: mi.Object, user: mi.Object) -> None:
    """Add to ``nodes`` that an emitter or BSDF depends on the texture ``node``."""
    others = users_of(nodes[node]) if node in nodes else ()
    if user not in others:
        nodes[node] = SharedTexture([*others, user]) if others else user


def users_of(role: object) -> tuple[object, ...]:
    """Return the emitters and BSDFs that depend on a texture with this ``role``."""
    return role.users if isinstance(role, SharedTexture) else (role,)


def key_of_node(
    params: mi.SceneParameters, keys: list[str], node: mi.Object, otherwise: str
) -> str:
    """Return the first of ``keys`` that is a parameter of ``node``, or ``otherwise``."""
    return next((key for key in keys if params.properties[key][2] == node), otherwise)


def refuse(key: str, reason: str) -> None:
    """Raise IrrcacheError for a parameter with respect to which no gradient is computed."""
    raise IrrcacheError(
        f'irrcache computes no gradient of the parameter "{key}": {reason}. It has gradients of '
        "sigma_t, albedo and g of hg of a medium, of emission of a single one, and of radiance; "
        "among surfaces of diffuse reflectance; in isotropic media without surfaces of positions "
        "of points and directions of suns; detach this "
        'parameter (dr.disable_grad, params.update), or use the integrator "prbvolpath".'
    )


def refuse_all(keys: list[str], reason: str, remedy: str) -> None:
    """Raise IrrcacheError for a scene or setting in which no gradients are computed."""
    names = ", ".join(f'"{key}"' for key in keys[:3]) + (", ..." if len(keys) > 3 else "")
    raise IrrcacheError(
        f"irrcache computes no gradient of {names} here: {reason}. {remedy}, or use the integrator "
        '"prbvolpath".'
    )


def channels_of(value: object) -> int:
    """Return the number of channels of a constant parameter."""
    return len(value) if dr.depth_v(value) > 1 else 1


def shaped_like(value: object, grad: mi.Float) -> object:
    """Convert a gradient from a flat array to the type and shape of the parameter's ``value``."""
    kind = type(value)
    if dr.is_tensor_v(value):
        return kind(grad, value.shape)
    if dr.depth_v(value) == 1:
        return kind(dr.sum(grad) if dr.width(grad) != dr.width(value) else grad)
    count = dr.width(grad)
    return kind(
        *(dr.gather(mi.Float, grad, mi.UInt32(min(i, count - 1))) for i in range(len(value)))
    )


def by_parameter(value: object, field: Field, grad: mi.Float) -> mi.Float:
    """Return the derivative with respect to a parameter's ``value``, given the derivative ``grad``
    with respect to the ``field`` computed from it: grids have a scale, and monochromatic variants
    store the luminance of coloured data.
    """
    if field.grid is None:
        return grad * dr.opaque(mi.Float, field.scale)
    grad = grad * field.scale
    if dr.is_tensor_v(value) and value.shape[3] != field.channels:
        grad = interleaved([grad * share for share in LUMINANCE])
    dr.eval(grad)
    return grad
