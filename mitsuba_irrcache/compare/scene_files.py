"""The files of a scene: its XML files and every file that they name."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path

import mitsuba as mi


def scene_files(path: Path, parameters: dict[str, str]) -> list[Path]:
    """Return the scene's XML files and all files that its objects name, sorted.

    Names are resolved as Mitsuba does: beside the scene and in its ``<path>`` folders.
    """
    saved = mi.file_resolver()
    resolver = mi.FileResolver(saved)
    resolver.prepend(str(path.parent.resolve()))
    mi.set_file_resolver(resolver)
    try:
        config = mi.parser.ParserConfig(mi.variant())
        state = mi.parser.parse_file(config, str(path), **parameters)
        names = [
            value
            for node in state.nodes
            for key in node.props.keys()
            if isinstance(value := node.props[key], str) and value
        ]
        found = [Path(str(resolver.resolve(name))) for name in names]
    finally:
        mi.set_file_resolver(saved)
    files = {Path(str(file)).resolve() for file in state.files}
    return sorted(files | {file.resolve() for file in found if _is_file(file)})


def scene_digest(path: Path, parameters: dict[str, str]) -> str:
    """Return the SHA-256 of the contents of `scene_files` and of the parameters.

    The folders of the files do not matter.
    """
    sha = hashlib.sha256(repr(sorted(parameters.items())).encode())
    for file in scene_files(path, parameters):
        sha.update(hashlib.sha256(file.name.encode()).digest() + _digest(file))
    return sha.hexdigest()


def _digest(file: Path) -> bytes:
    """Compute the SHA-256 of a file, once for as long as it is not written to."""
    state = file.stat()
    return _digest_of(file, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=4096)
def _digest_of(file: Path, size: int, modified: int) -> bytes:
    sha = hashlib.sha256()
    with open(file, "rb") as stream:
        while block := stream.read(1 << 20):
            sha.update(block)
    return sha.digest()


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a string that is not a file name, for instance because it is too long
        return False
