"""Load scene files with parameters, optionally replacing the integrator."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from xml.etree import ElementTree

import mitsuba as mi

from mitsuba_irrcache.core.bounds import correct_mesh_bounds, lost_extent
from mitsuba_irrcache.errors import IrrcacheError, suggestion
from mitsuba_irrcache.io.scene_xml import scene_element
from mitsuba_irrcache.io.zarr_chunks import is_zarr

#: Properties that an integrator inherits from one that it replaces, if it has them: those common to
#: all volumetric path integrators, and the emission of media, which belongs to the scene.
SHARED_PROPERTIES = ("max_depth", "rr_depth", "hide_emitters", "emission", "emission_scale")
#: Properties that name what an integrator writes. Files with these names that exist already are
#: read only where they belong to the same scene and settings.
WRITTEN = ("cache_file", "irradiance_file", "work_folder")

#: A list item: text without commas, except inside quotes.
_ITEM = r"""(?:[^,"']|"[^"]*"|'[^']*')+"""


def load_scene(
    path: str | Path,
    parameters: dict[str, str] | None = None,
    integrator: str | None = None,
    properties: dict[str, object] | None = None,
    folder: str | Path = "",
) -> mi.Scene:
    """Load a scene XML with ``$parameters``, optionally replacing its integrator.

    ``integrator`` is a specification such as ``irrcache{step=0.5}``. The `SHARED_PROPERTIES` of the
    scene's own integrator are preserved unless the specification sets them or the new plugin does
    not support them. ``properties`` are set in addition to those that the integrator has.
    ``folder`` is that of relative names of files that are not beside the scene, and of those that
    the integrator writes; "": the working folder. Raises IrrcacheError if the file is missing.
    Meshes are merged as Mitsuba does by default, unless that loses their extent (`core.bounds`).
    """
    with parsed(path, parameters, folder) as (config, state):

        def prepare(state: mi.parser.ParserState) -> None:
            if integrator is not None:
                replace_integrator(state, integrator)
            for key, value in (properties or {}).items():
                _integrator_node(state).props[key] = value
            _place_written_files(state, folder)

        def parse() -> mi.parser.ParserState:
            return mi.parser.parse_file(config, str(path), **(parameters or {}))

        return _instantiated(config, state, parse, prepare)


def _instantiated(
    config: mi.parser.ParserConfig,
    state: mi.parser.ParserState,
    parse: Callable[[], mi.parser.ParserState],
    prepare: Callable[[mi.parser.ParserState], None],
) -> mi.Scene:
    """Return the scene of a parsed ``state`` that ``prepare`` modifies. Where merged meshes lose
    their extent, ``parse`` a new state, and return its scene without merging.
    """
    for merge in (True, False):
        config.merge_meshes = merge
        own = state if merge else parse()
        mi.parser.transform_all(config, own)
        prepare(own)
        scene = mi.parser.instantiate(config, own)
        scene = scene[0] if isinstance(scene, list) else scene
        if not isinstance(scene, mi.Scene):
            break
        correct_mesh_bounds(scene)
        if not lost_extent(scene):
            break
    return scene


@contextmanager
def parsed(
    path: str | Path, parameters: dict[str, str] | None = None, folder: str | Path = ""
) -> Iterator[tuple[mi.parser.ParserConfig, mi.parser.ParserState]]:
    """Parse a scene XML, and search for files within this context as `load_scene` does: in the
    scene's ``<path>`` folders, beside it, and in ``folder``.
    """
    path = check_scene_file(path)
    config = mi.parser.ParserConfig(mi.variant())
    with _explained(path), _search_path(folder, path.parent):
        yield config, mi.parser.parse_file(config, str(path), **(parameters or {}))


def _place_written_files(state: mi.parser.ParserState, folder: str | Path) -> None:
    """Make relative names of files that integrators write those of files in ``folder``."""
    for node in state.nodes:
        if node.type != mi.ObjectType.Integrator:
            continue
        for key in WRITTEN:
            name = node.props.get(key, None)
            if isinstance(name, str) and name:
                node.props[key] = str(Path(folder) / name)


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Add the most similar name to Mitsuba's errors about names that it does not know."""
    try:
        yield
    except RuntimeError as error:
        meant = _meant(str(error), path)
        if not meant:
            raise
        raise RuntimeError(f"{str(error).rstrip()}{meant}") from None


def _meant(message: str, path: Path) -> str:
    """Return a suggestion for the unknown plugin, property or parameter in an error message."""
    plugin = re.search(r'Plugin "(\w+)" not found', message)
    if plugin is not None:
        return suggestion(plugin[1], _plugin_names())
    unused = re.search(r"unused parameters:\s*- \$(\w+)=(\S*)", message)
    if unused is not None:
        return _about_parameter(unused[1], unused[2], path)
    unreferenced = re.search(r'unreferenced propert.*of type "\w+":\s*- \w+ "(\w+)"', message)
    if unreferenced is not None and "integrator plugin" in message:
        return suggestion(unreferenced[1], SHARED_PROPERTIES)
    return ""


def _about_parameter(name: str, value: str, path: Path) -> str:
    """Explain that a scene file has no such parameter."""
    declared = re.findall(r'\$\{?(\w+)|<default\s+name="(\w+)"', path.read_text("utf-8"))
    names = sorted({name for pair in declared for name in pair if name})
    meant = suggestion(name, names)
    if meant:
        return meant
    known = ", ".join(f"${known}" for known in names) or "none"
    return (
        f"\nA scene has the parameters that its file declares, here: {known}. For a property of "
        f"the integrator give -i 'irrcache{{{name}={value}}}'."
    )


def _plugin_names() -> list[str]:
    """Return the names of Mitsuba's plugins, which are files of its package, and ours."""
    folder = Path(mi.__file__).parent / "plugins"
    return ["irrcache", *(file.stem for file in folder.glob("*.*"))]


def check_scene_file(path: str | Path) -> Path:
    """Return the path of a readable scene file; raise IrrcacheError for anything else."""
    path = Path(path)
    try:
        found, folder, readable = path.is_file(), path.is_dir(), os.access(path, os.R_OK)
    except (OSError, ValueError) as error:  # a name that is too long or contains NUL
        raise IrrcacheError(
            f'"{str(path)[:80]!s}" is not a valid name of a scene file: {error}.'
        ) from None
    if folder:
        inside = sorted(p.name for p in path.glob("*.xml"))[:5]
        there = f", for example {path / inside[0]}" if inside else ""
        raise IrrcacheError(f'the scene "{path}" is a folder; name an XML file{there}.')
    if not found:
        raise IrrcacheError(f'there is no scene file "{path}".')
    if not readable:
        raise IrrcacheError(f'no permission to read the scene file "{path}".')
    if not path.stat().st_size:
        raise IrrcacheError(f'the scene file "{path}" is empty.')
    return path


def scene_text(
    path: str | Path, parameters: dict[str, str] | None = None, integrator: str | None = None
) -> str:
    """Return the XML of a scene with all $parameters substituted, all includes inlined, and names
    of files in its ``<path>`` folders relative to its own.

    ``integrator`` replaces the scene's integrator as in `load_scene`.
    """
    folder = Path(path).resolve().parent
    with parsed(path, parameters) as (_, state):
        if integrator is not None:
            replace_integrator(state, integrator)
        for node in state.nodes:
            for key in node.props.keys():
                found = None if key in WRITTEN else _in_path(node.props[key], folder)
                if found is not None:
                    node.props[key] = os.path.relpath(found, folder)
        return ElementTree.tostring(scene_element(state), encoding="unicode")


def _in_path(name: object, folder: Path) -> Path | None:
    """Return the file or Zarr folder of this name in the ``<path>`` folders of a parsed scene,
    which precede its own ``folder``; None if there is none.
    """
    for entry in mi.file_resolver() if isinstance(name, str) and name else ():
        if Path(str(entry)) == folder:
            return None
        found = Path(str(entry)) / name
        if os.path.isfile(found) or (os.path.isdir(found) and is_zarr(found)):
            return found
    return None


def filled(text: str, integrator: str, parameters: dict[str, str] | None = None) -> str:
    """Apply the transformations of `scene_text` to an XML string."""
    config = mi.parser.ParserConfig(mi.variant())
    state = mi.parser.parse_string(config, text, **(parameters or {}))
    replace_integrator(state, integrator)
    return ElementTree.tostring(scene_element(state), encoding="unicode")


def scene_of_text(
    text: str, folder: str | Path, grids: dict[str, mi.VolumeGrid] | None = None
) -> mi.Scene:
    """Load a scene from an XML string whose file names are relative to ``folder``.

    Volumes whose file name is a key of ``grids`` use that grid instead of the file.
    """
    config = mi.parser.ParserConfig(mi.variant())

    def parse() -> mi.parser.ParserState:
        state = mi.parser.parse_string(config, text)
        for node in state.nodes:
            name = node.props.get("filename", None)
            if node.type == mi.ObjectType.Volume and name in (grids or {}):
                del node.props["filename"]
                node.props["grid"] = grids[name]
        return state

    with _search_path(Path(folder)):
        return _instantiated(config, parse(), parse, lambda state: None)


def integrator_of(path: str | Path, parameters: dict[str, str] | None = None) -> str:
    """Return the integrator plugin named in a scene file, or "path", Mitsuba's default."""
    with parsed(path, parameters) as (_, state):
        node = _integrator_node(state)
        return "path" if node is None else node.props.plugin_name()


def loses_emission(path: str | Path, parameters: dict[str, str] | None, integrator: str) -> bool:
    """Return whether media of a scene emit, but would not with another integrator."""
    with parsed(path, parameters) as (_, state):
        node = _integrator_node(state)
        emits = node is not None and "emission" in node.props
        if not emits or node.props.get("emission_scale", 1.0) == 0:
            return False
        replace_integrator(state, integrator)
        return "emission" not in node.props


def parse_integrator(specification: str) -> tuple[str, dict[str, object]]:
    """Split ``name`` or ``name{key=value,...}`` into the plugin's name and its properties.

    Values are converted to booleans (true, false), integers, floats or strings; values that contain
    commas must be quoted.
    """
    match = re.fullmatch(r"\s*([A-Za-z_]\w*)\s*(?:\{(.*)\})?\s*", specification, re.DOTALL)
    if match is None:
        raise IrrcacheError(
            f'cannot read the integrator "{specification}"; write a name, or '
            f"name{{key=value,key=value}}."
        )
    name, body = match.groups()
    properties: dict[str, object] = {}
    for item in filter(None, map(str.strip, re.findall(_ITEM, body or ""))):
        key, equals, value = item.partition("=")
        if not equals or not key.strip():
            raise IrrcacheError(
                f'cannot read "{item}" in the integrator "{specification}"; write key=value.'
            )
        properties[key.strip()] = _literal(value.strip())
    return name, properties


def unknown_properties(specification: str) -> list[str]:
    """Return the properties in ``name{key=value,...}`` that the plugin does not query.

    The list is empty if the plugin cannot be constructed with these properties.
    """
    name, properties = parse_integrator(specification)
    return _unqueried(name, properties)


def _unqueried(name: str, properties: dict[str, object]) -> list[str]:
    trial = mi.Properties(name)
    for key, value in properties.items():
        trial[key] = value
    with suppress(Exception):  # loading the scene reports the error with its location in the file
        mi.PluginManager.instance().create_object(trial)
        return trial.unqueried()
    return []


def parse_parameters(definitions: list[str]) -> dict[str, str]:
    """Parse the ``$parameters`` given by options ``-D name=value``."""
    result = {}
    for item in definitions:
        key, equals, value = item.partition("=")
        if not equals or not key:
            raise IrrcacheError(f'cannot read -D "{item}"; write -D name=value.')
        result[key] = value
    return result


def describe_integrator(name: str, properties: dict[str, object]) -> str:
    """Format a plugin's name and properties as `parse_integrator` reads them."""
    return f"{name}{{{','.join(f'{key}={_quoted(value)}' for key, value in properties.items())}}}"


def _quoted(value: object) -> str:
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return f"'{text}'" if "," in text else text


def _literal(text: str) -> object:
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text.strip("'\"")


def _integrator_node(state: mi.parser.ParserState) -> mi.parser.SceneNode | None:
    """Return the scene's outermost integrator, which comes first in file order."""
    return next((n for n in state.nodes if n.type == mi.ObjectType.Integrator), None)


def _add_integrator(state: mi.parser.ParserState) -> mi.parser.SceneNode:
    """Add a node for the integrator of a scene that names none."""
    node = mi.parser.SceneNode()
    node.type = mi.ObjectType.Integrator
    state.nodes.append(node)
    number = len(state.nodes) - 1
    state.root.props["integrator"] = mi.Properties.ResolvedReference(number)
    return state.nodes[number]


def replace_integrator(state: mi.parser.ParserState, specification: str) -> None:
    """Replace the integrator of a parsed scene as `load_scene` does."""
    name, properties = parse_integrator(specification)
    node = _integrator_node(state) or _add_integrator(state)
    inherited = {k: node.props[k] for k in SHARED_PROPERTIES if k in node.props}
    for key in list(node.props.keys()):
        del node.props[key]
    node.props.set_plugin_name(name)
    unqueried = _unqueried(name, inherited | properties)
    inherited = {k: v for k, v in inherited.items() if k not in unqueried}
    for key, value in (inherited | properties).items():
        node.props[key] = value


@contextmanager
def _search_path(*folders: str | Path) -> Iterator[None]:
    """Make Mitsuba search for files in these folders, too, the last one first."""
    saved = mi.file_resolver()
    resolver = mi.FileResolver(saved)
    for folder in folders:
        resolver.prepend(str(Path(folder).resolve()))
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(saved)


def sensor_count(scene: mi.Scene) -> int:
    """Return the number of sensors of a scene; raise IrrcacheError if it is 0."""
    count = len(scene.sensors())
    if not count:
        raise IrrcacheError("the scene has no sensor; add a <sensor> to it.")
    return count


def check_sensor(number: int, scene: mi.Scene) -> None:
    """Raise IrrcacheError if the scene has no sensor of this ``number``, the value of --sensor."""
    count = sensor_count(scene)
    if not 0 <= number < count:
        raise IrrcacheError(
            f"--sensor is {number}, but the scene has {count} sensor(s), counted from 0."
        )


def has_cache(scene: mi.Scene) -> bool:
    """Return whether the scene's integrator builds a cache before rendering."""
    method = getattr(scene.integrator(), "prepare", None)
    # Mitsuba's differentiable integrators have an unrelated method of this name.
    return callable(method) and "scene" in inspect.signature(method).parameters


def key_of(params: mi.SceneParameters, name: str) -> str:
    """Return the key in ``params`` that ``name`` abbreviates: the key itself, the end of only one
    key, such as ``g`` or ``phase_function.g``, or a component of it between dots that occurs in
    only one key of an array, such as ``sigma_t``, ``albedo``, ``emission`` or the id of an emitter.

    Raises IrrcacheError if no key, or more than one, matches.
    """
    if name in params.keys():
        return name

    def is_meant(key: str) -> bool:
        is_array = key.endswith((".data", ".value"))
        return key.endswith(f".{name}") or (is_array and f".{name}." in f".{key}")

    found = [key for key in params.keys() if is_meant(key)]
    if len(found) != 1:
        listed = ", ".join(f'"{key}"' for key in found) or "none"
        raise IrrcacheError(
            f'"{name}" must be a key of mi.traverse(scene), the end of exactly one, or stand in '
            f'exactly one that ends in "data" or "value"; found: {listed}.'
        )
    return found[0]
