"""Export of a volume as a Mitsuba scene in a folder, for use with any Mitsuba 3."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.mitsuba_vol import write_vol
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.staging import staged_files, staged_folder
from mitsuba_irrcache.volumes.transfer import DensityMapping, TransferFunction

SIGMA_T_FILE, ALBEDO_FILE, MAPPING_FILE = "sigma_t.vol", "albedo.vol", "transfer_function.json"
EMISSION_FILE = "emission.vol"
_FIELD_OF_VIEW = 30.0
_MARGIN = 1.08
# Views as (direction in which the camera lies, up). Medical volumes are LPS: the patient faces -y
# with the head at +z, so the camera stands in front, a little to the patient's right and above.
VIEWS = {
    "z": (np.array([-0.45, -1.0, 0.25]), np.array([0.0, 0.0, 1.0])),
    "y": (np.array([-0.45, 0.25, 1.0]), np.array([0.0, 1.0, 0.0])),
}


# The direction of the rays of a sun to the right of the camera, 40 degrees high.
_SUN = {"z": np.array([-0.7, 0.3, -0.64]), "y": np.array([-0.7, -0.64, -0.3])}


@dataclass(frozen=True)
class SceneSettings:
    """The parameters of ``scene.xml`` (``-D name=value``) with their defaults, and its view.

    Attributes:
        asymmetry: mean cosine of scattering; 0: isotropic, otherwise Henyey-Greenstein.
        sun: irradiance of a sun beside the uniform environment; 0: there is none.
        up: the world axis that points up in the picture, ``"z"`` (medical) or ``"y"``.
    """

    integrator: str = "volpath"
    max_depth: int = 2
    spp: int = 64
    width: int = 512
    height: int = 512
    scale: float = 1.0
    radiance: float = 1.0
    hide_emitters: bool = False
    asymmetry: float = 0.0
    sun: float = 0.0
    up: str = "z"


def write_scene(
    target: str | os.PathLike,
    volume: VolumeData,
    mapping: TransferFunction | DensityMapping,
    sigma_t: np.ndarray,
    albedo: np.ndarray,
    settings: SceneSettings | None = None,
    overwrite: bool = False,
    emission: np.ndarray | None = None,
) -> int:
    """Write ``scene.xml``, ``sigma_t.vol``, ``albedo.vol`` and ``transfer_function.json``.

    With ``emission`` also ``emission.vol``, which the integrator ``irrcache`` alone renders.

    Args:
        target: a folder, created atomically; it replaces an earlier import on success only. Or a
            file ending in ``.xml`` in an existing folder, which also receives the other files and
            whose unrelated files are not changed.
        volume: gives the placement; scene units are its world units.
        mapping: how the grids were made, saved as a record.
        sigma_t: shape ``(z, y, x)`` or ``(z, y, x, 3)``, extinction in 1/world unit.
        albedo: shape ``(z, y, x, 3)``; stored as one channel where it is grey.
        settings: defaults of the scene's parameters.
        overwrite: replace an earlier import.
        emission: shape ``(z, y, x, 3)``, radiance emitted per world unit.

    Returns:
        the number of bytes written.

    Raises:
        IrrcacheError: shapes that disagree, values outside their range, an empty medium, or a
            target that may not be replaced. No files are written then.
    """
    settings = settings or SceneSettings()
    _check_medium(volume, sigma_t, albedo)
    target = Path(target)
    as_file = target.suffix.lower() == ".xml"
    scene_name = target.name if as_file else "scene.xml"
    # An earlier import may have had an emission.
    names = {SIGMA_T_FILE, ALBEDO_FILE, EMISSION_FILE, MAPPING_FILE, scene_name}
    staged = (
        staged_files(target.parent, names, overwrite)
        if as_file
        else staged_folder(target, names, overwrite)
    )
    with staged as folder:
        write_vol(folder / SIGMA_T_FILE, sigma_t)
        write_vol(folder / ALBEDO_FILE, albedo[..., :1] if _is_grey(albedo) else albedo)
        if emission is not None:
            write_vol(folder / EMISSION_FILE, emission)
        (folder / MAPPING_FILE).write_text(mapping.to_json(), encoding="utf-8")
        view = camera(volume, sigma_t, settings.up)
        xml = scene_xml(volume.to_world, view, settings, emission is not None)
        (folder / scene_name).write_text(xml, encoding="utf-8")
        return sum(path.stat().st_size for path in folder.iterdir())


def camera(volume: VolumeData, sigma_t: np.ndarray, up: str = "z") -> tuple[np.ndarray, ...]:
    """Return origin, target and up vector of a camera that frames the nonempty voxels.

    Raises:
        IrrcacheError: ``up`` is neither "z" nor "y".
    """
    if up not in VIEWS:
        raise IrrcacheError(f"up axis {up!r}: give z or y")
    towards, up_vector = VIEWS[up]
    towards = towards / np.linalg.norm(towards)
    occupied = _occupied_ends(volume, sigma_t)
    target = 0.5 * (occupied.min(axis=0) + occupied.max(axis=0))
    right = np.cross(up_vector, towards)
    right /= np.linalg.norm(right)
    relative = occupied - target
    along = relative @ towards
    aside = np.maximum(np.abs(relative @ right), np.abs(relative @ np.cross(towards, right)))
    slope = np.tan(np.radians(_FIELD_OF_VIEW / 2))
    # A single voxel has no extent between its ends.
    voxel = float(np.linalg.norm(volume.spacing)) / slope
    distance = max((along + _MARGIN * aside / slope).max(), voxel)
    return target + distance * towards, target, up_vector


def scene_xml(
    to_world: np.ndarray,
    view: tuple[np.ndarray, ...],
    settings: SceneSettings,
    emits: bool = False,
) -> str:
    """Return the scene; ``to_world`` is of the grids' unit cube, ``view`` as from ``camera``."""
    defaults = {
        "integrator": settings.integrator,
        "max_depth": settings.max_depth,
        "hide_emitters": str(settings.hide_emitters).lower(),
        "spp": settings.spp,
        "width": settings.width,
        "height": settings.height,
        "scale": f"{settings.scale:.9g}",
        "radiance": f"{settings.radiance:.9g}",
    }
    emission = ""
    if emits:
        defaults["emission"] = "1"
        emission = f"""
{_volume_xml("emission", EMISSION_FILE, to_world)}
        <float name="emission_scale" value="$emission"/>"""
    if settings.asymmetry:
        defaults["g"] = f"{settings.asymmetry:.9g}"
    sun = ""
    if settings.sun:
        defaults["sun"] = f"{settings.sun:.9g}"
        sun = f"""
    <emitter type="directional">
        <vector name="direction" value="{_text(_SUN[settings.up])}"/>
        <rgb name="irradiance" value="$sun, $sun, $sun"/>
    </emitter>
"""
    return f"""<scene version="3.0.0">
{_default_lines(defaults)}

    <integrator type="$integrator">
        <integer name="max_depth" value="$max_depth"/>
        <boolean name="hide_emitters" value="$hide_emitters"/>{emission}
    </integrator>

{_sensor_xml(view)}

    <emitter type="constant">
        <rgb name="radiance" value="$radiance, $radiance, $radiance"/>
    </emitter>
{sun}
    <!-- Lengths are in the units of the data (mm for medical volumes), extinction in 1/length. -->
{_medium_xml(to_world, is_isotropic=not settings.asymmetry)}
</scene>
"""


def _sensor_xml(view: tuple[np.ndarray, ...]) -> str:
    """Return the sensor with its film; ``view`` is as from ``camera``."""
    origin, target, up = (_text(vector) for vector in view)
    far = 10 * float(np.linalg.norm(np.subtract(view[0], view[1])))
    return f"""    <sensor type="perspective">
        <float name="fov" value="{_FIELD_OF_VIEW:g}"/>
        <string name="fov_axis" value="smaller"/>
        <float name="near_clip" value="{far * 1e-5:.9g}"/>
        <float name="far_clip" value="{far:.9g}"/>
        <transform name="to_world">
            <lookat origin="{origin}" target="{target}" up="{up}"/>
        </transform>
        <sampler type="independent">
            <integer name="sample_count" value="$spp"/>
        </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$width"/>
            <integer name="height" value="$height"/>
            <string name="pixel_format" value="rgb"/>
            <string name="component_format" value="float32"/>
            <rfilter type="gaussian"/>
        </film>
    </sensor>"""


def _medium_xml(to_world: np.ndarray, is_isotropic: bool) -> str:
    """Return the medium and the shape that bounds it."""
    phase = '<phase type="hg"><float name="g" value="$g"/></phase>'
    if is_isotropic:
        phase = '<phase type="isotropic"/>'
    boundary = _text(_boundary_to_world(to_world))
    return f"""    <medium type="heterogeneous" id="volume">
{_volume_xml("sigma_t", SIGMA_T_FILE, to_world)}
{_volume_xml("albedo", ALBEDO_FILE, to_world)}
        <float name="scale" value="$scale"/>
        {phase}
    </medium>

    <shape type="cube">
        <transform name="to_world"><matrix value="{boundary}"/></transform>
        <bsdf type="null"/>
        <ref name="interior" id="volume"/>
    </shape>"""


def _volume_xml(name: str, file: str, to_world: np.ndarray) -> str:
    """Return a property that is a grid volume in a file."""
    return f"""        <volume name="{name}" type="gridvolume">
            <string name="filename" value={quoteattr(file)}/>
            <transform name="to_world"><matrix value="{_text(to_world)}"/></transform>
        </volume>"""


def _boundary_to_world(to_world: np.ndarray) -> np.ndarray:
    """Return the transformation of Mitsuba's ``cube`` ``[-1, 1]^3`` to a grid's box.

    Mitsuba takes the outside of a mirrored cube for the medium, because its normals point inwards.
    The cube is symmetric, so the boundary of a mirrored grid is mirrored once more.
    """
    handedness = np.sign(np.linalg.det(to_world[:3, :3]))
    cube_to_unit = np.diag([0.5 * handedness, 0.5, 0.5, 1.0])
    cube_to_unit[:3, 3] = 0.5
    return to_world @ cube_to_unit


def _default_lines(defaults: dict[str, object]) -> str:
    return "\n".join(
        f"    <default name={quoteattr(name)} value={quoteattr(str(value))}/>"
        for name, value in defaults.items()
    )


def _text(numbers: np.ndarray) -> str:
    return " ".join(f"{number:.9g}" for number in np.ravel(numbers))


def _occupied_ends(volume: VolumeData, sigma_t: np.ndarray) -> np.ndarray:
    """Return world positions ``(n, 3)`` of the first and last nonzero voxel of each row."""
    occupied = sigma_t > 0 if sigma_t.ndim == 3 else (sigma_t > 0).any(axis=-1)
    z, y = np.nonzero(occupied.any(axis=2))
    rows = occupied[z, y]
    first = rows.argmax(axis=1)
    last = rows.shape[1] - 1 - rows[:, ::-1].argmax(axis=1)
    x, y, z = np.concatenate([first, last]), np.tile(y, 2), np.tile(z, 2)
    matrix = volume.index_to_world
    return np.stack([x, y, z], axis=1) @ matrix[:3, :3].T + matrix[:3, 3]


def _is_grey(albedo: np.ndarray) -> bool:
    return all(
        np.array_equal(part[..., 0], part[..., 1]) and np.array_equal(part[..., 0], part[..., 2])
        for part in albedo
    )


def _check_medium(volume: VolumeData, sigma_t: np.ndarray, albedo: np.ndarray) -> None:
    shape = volume.values.shape
    if sigma_t.shape not in (shape, (*shape, 3)) or albedo.shape != (*shape, 3):
        raise IrrcacheError(
            f"extinction {sigma_t.shape} and albedo {albedo.shape} do not fit the volume {shape}; "
            "bake them from it"
        )
    low, high = float(sigma_t.min()), float(sigma_t.max())
    if not (low >= 0 and np.isfinite(high)):
        raise IrrcacheError(f"extinction from {low:g} to {high:g}; it must be finite and >= 0")
    if high == 0:
        raise IrrcacheError(
            f"the whole medium is empty: all values of {volume.source!r} are 0, or lie where the "
            "transfer function is transparent; check its unit, or rescale the values"
        )
    low, high = float(albedo.min()), float(albedo.max())
    if not (low >= 0 and high <= 1):
        raise IrrcacheError(f"albedo from {low:g} to {high:g}; it must lie within 0..1")
