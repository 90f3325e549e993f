"""The inputs of a scene: its XML files, and every file that they or its integrator read."""

from __future__ import annotations

import glob
import hashlib
from functools import lru_cache
from pathlib import Path

import mitsuba as mi

from mitsuba_irrcache.io.files import file_digest
from mitsuba_irrcache.io.scene_files import WRITTEN, parsed, replace_integrator
from mitsuba_irrcache.io.zarr_chunks import is_zarr


def scene_inputs(
    path: Path, parameters: dict[str, str], integrator: str | None = None, folder: str | Path = ""
) -> tuple[list[Path], list[str]]:
    """Return all that a scene reads; the arguments are those of `load_scene`.

    These are its XML files, with the files and Zarr folders that its objects name, sorted, and the
    contents of spectra. What integrators write does not count.
    """
    spectra = []
    with parsed(path, parameters, folder) as (_, state):
        if integrator is not None:
            replace_integrator(state, integrator)
        files = {Path(str(file)).resolve() for file in state.files}
        for node in state.nodes:
            written = WRITTEN if node.type == mi.ObjectType.Integrator else ()
            for key in node.props.keys():
                value = node.props[key]
                if hasattr(value, "wavelengths"):  # the parser has read it, and keeps no file name
                    spectra.append(f"{key} {list(value.wavelengths)} {list(value.values)}")
                elif isinstance(value, str) and value and key not in written:
                    file = Path(str(mi.file_resolver().resolve(value)))
                    files |= {file.resolve()} if _is_input(file) else set()
    return sorted(files), spectra


def scene_digest(
    path: Path, parameters: dict[str, str], integrator: str | None = None, folder: str | Path = ""
) -> str:
    """Return the SHA-256 of the contents of `scene_inputs` and of the parameters.

    The folders of the files do not matter.
    """
    sha = hashlib.sha256(repr(sorted(parameters.items())).encode())
    files, spectra = scene_inputs(path, parameters, integrator, folder)
    for file in files:
        sha.update(hashlib.sha256(file.name.encode()).digest() + _digest(file))
    sha.update("".join(spectra).encode())
    return sha.hexdigest()


def cache_digests(
    path: Path, parameters: dict[str, str], integrator: str | None = None, folder: str | Path = ""
) -> dict[str, str]:
    """Return the SHA-256 of those files that a scene's integrators name as ``cache_file``, and that
    exist, by name. With several media these are the files of all of them.
    """
    with parsed(path, parameters, folder) as (_, state):
        if integrator is not None:
            replace_integrator(state, integrator)
        integrators = [node for node in state.nodes if node.type == mi.ObjectType.Integrator]
        names = {str(node.props.get("cache_file", "")) for node in integrators} - {""}
    found = {}
    for name in map(Path, names):
        of_media = f"{glob.escape(name.stem)}.*{glob.escape(name.suffix)}"
        for file in {Path(folder) / name, *(Path(folder) / name).parent.glob(of_media)}:
            if file.is_file():
                found[str(name.parent / file.name)] = _digest(file).hex()
    return found


def _digest(file: Path) -> bytes:
    """Compute the SHA-256 of a file, or of all files of a folder, each once for as long as it is
    not written to.
    """
    if not file.is_dir():
        state = file.stat()
        return _digest_of(file, state.st_size, state.st_mtime_ns)
    sha = hashlib.sha256()
    for part in sorted(file.rglob("*")):
        if part.is_file():
            sha.update(hashlib.sha256(str(part.relative_to(file)).encode()).digest())
            sha.update(_digest(part))
    return sha.digest()


@lru_cache(maxsize=1 << 16)
def _digest_of(file: Path, size: int, modified: int) -> bytes:
    return file_digest(file)


def _is_input(path: Path) -> bool:
    """Return whether a string of a scene names a file, or a folder that is read like one."""
    try:
        return path.is_file() or is_zarr(path)
    except OSError:  # a string that is not a file name, for instance because it is too long
        return False
