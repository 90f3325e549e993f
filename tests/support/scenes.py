"""Builders of scenes that are small enough to be rendered many times."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)

ISOTROPIC_SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [0.6, 0.8, 1.0]}}


SUN = {
    "type": "directional",
    "direction": [0.4, -1.0, 0.55],
    "irradiance": {"type": "rgb", "value": [3.0, 2.5, 2.0]},
}


def placement(
    edges=(2.0, 2.0, 2.0), turn: float = 0.0, mirror: bool = False, center=(0.0, 0.0, 0.0)
) -> np.ndarray:
    """Return the ``to_world`` of the unit cube for a box with these edges around ``center``.

    The box is rotated by ``turn`` degrees about an oblique axis, and mirrored in its own x axis if
    requested.
    """
    axis = np.array([0.48, 0.64, 0.6])
    cross = np.cross(np.eye(3), axis)
    angle = np.deg2rad(turn)
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    matrix = np.eye(4)
    matrix[:3, :3] = rotation @ np.diag(np.array(edges) * (-1.0 if mirror else 1.0, 1.0, 1.0))
    matrix[:3, 3] = np.array(center) - 0.5 * matrix[:3, :3].sum(axis=1)
    return matrix


def texture(shape: tuple[int, ...], low: float, high: float, seed: int) -> np.ndarray:
    """Return random voxels in [low, high], float32, (z, y, x[, channel])."""
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def volume(values, to_world: np.ndarray | None = None, **properties) -> dict:
    """Return a gridvolume of an array (z, y, x[, channel]), or a constvolume of a number or a
    colour.
    """
    if isinstance(values, np.ndarray) and values.ndim >= 3:
        grid = mi.VolumeGrid(values.astype(np.float32).reshape(*values.shape[:3], -1))
        place = mi.ScalarTransform4f(np.eye(4) if to_world is None else to_world)
        return {"type": "gridvolume", "grid": grid, "raw": True, "to_world": place} | properties
    if np.ndim(values) == 0:
        return {"type": "constvolume", "value": float(values)}
    colour = {"type": "rgb", "value": [float(v) for v in values]}
    return {"type": "constvolume", "value": colour}


def medium(sigma_t, albedo, to_world: np.ndarray | None = None, **properties) -> dict:
    """Return a heterogeneous medium if ``sigma_t`` is an array, else a homogeneous one."""
    varies = isinstance(sigma_t, np.ndarray) and sigma_t.ndim >= 3
    return {
        "type": "heterogeneous" if varies else "homogeneous",
        "sigma_t": volume(sigma_t, to_world),
        "albedo": volume(albedo, to_world),
    } | properties


def boundary(interior: dict, to_world: np.ndarray | None = None, kind: str = "cube") -> dict:
    """Return a shape that encloses the unit cube transformed by ``to_world`` and bounds a
    medium.

    Its normals point outwards.
    """
    to_world = placement() if to_world is None else to_world
    outwards = np.sign(np.linalg.det(to_world[:3, :3]))
    local = np.diag([0.5 * outwards, 0.5, 0.5, 1])
    local[:3, 3] = 0.5
    place = to_world @ local
    return {
        "type": kind,
        "to_world": mi.ScalarTransform4f(place),
        "bsdf": {"type": "null"},
        "interior": interior,
    }


def description(
    integrator: dict,
    shape: dict | None,
    size: int = 24,
    default_solver: str | None = None,
    **objects,
) -> dict:
    """Return a scene seen from (1, 1.5, -5).

    It has a coloured environment and a sun unless ``objects`` contains other emitters. The
    integrator ``irrcache`` must specify its solver unless ``default_solver`` is set.
    """
    look = mi.ScalarTransform4f().look_at([1.0, 1.5, -5.0], [0, 0, 0], [0, 1, 0])
    film = {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    sensor = {"type": "perspective", "fov": 34.0, "to_world": look, "film": film}
    emitters = {} if "emitter" in objects else {"emitter": ISOTROPIC_SKY, "sun": SUN}
    shapes = {} if shape is None else {"shape": shape}
    if integrator.get("type") == "irrcache":
        if default_solver is None and "solver" not in integrator:
            raise ValueError("a test names the solver that it is about, or auto")
        integrator = {"solver": default_solver} | integrator
    scene = {"type": "scene", "integrator": integrator, "sensor": sensor}
    return scene | shapes | emitters | {k: v for k, v in objects.items() if v is not None}


def load(
    integrator: dict,
    shape: dict | None,
    size: int = 24,
    default_solver: str | None = None,
    **objects,
) -> mi.Scene:
    """Load the scene of ``description``."""
    return mi.load_dict(description(integrator, shape, size, default_solver, **objects))


def image(scene: mi.Scene, **options) -> np.ndarray:
    """Return the rendered image, float64."""
    return np.array(mi.render(scene, **options), dtype=np.float64)


#: A volume in the file density.npy beside the scene; $light: file of its irradiance.
VOLUME_IN_FILE = """<scene version="3.0.0">
    <default name="light" value=""/>
    <integrator type="irrcache">
        <integer name="max_depth" value="-1"/>
        <integer name="cache_spp" value="64"/>
        <string name="sigma_t_file" value="density.npy"/>
        <string name="max_memory" value="1GB"/>
        <string name="irradiance_file" value="$light"/>
    </integrator>
    <sensor type="perspective">
        <film type="hdrfilm">
            <integer name="width" value="8"/> <integer name="height" value="8"/>
        </film>
        <transform name="to_world"> <lookat origin="0, 1, 5" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
    </sensor>
    <shape type="cube">
        <bsdf type="null"/>
        <medium name="interior" type="homogeneous">
            <rgb name="sigma_t" value="1, 1, 1"/>
            <rgb name="albedo" value="0.9, 0.8, 0.7"/>
            <float name="scale" value="4"/>
        </medium>
    </shape>
    <emitter type="directional">
        <vector name="direction" x="0.4" y="-1" z="0.5"/>
    </emitter>
    <emitter type="constant"/>
</scene>
"""
