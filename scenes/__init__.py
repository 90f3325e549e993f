"""Scenes that come with the package."""

from __future__ import annotations

from pathlib import Path

from mitsuba_irrcache.errors import IrrcacheError

_FOLDER = Path(__file__).parent


def scene_path(name: str) -> str:
    """Return the path of a scene's XML, for ``mi.load_file``.

    Args:
        name: ``"cloud"``, a ball of fog under a white sky and a sun.

    Raises:
        IrrcacheError: the package has no scene of this name; the message lists those it has.
    """
    known = {path.stem: str(path) for path in _FOLDER.glob("*.xml")}
    if name not in known:
        names = ", ".join(f'"{there}"' for there in sorted(known))
        raise IrrcacheError(f'scene_path: there is no scene "{name}"; the package has {names}.')
    return known[name]
