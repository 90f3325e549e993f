"""Scenes that come with the package."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent


def scene_path(name: str) -> str:
    """Return the path of a scene's XML, for ``mi.load_file``.

    Args:
        name: ``"cloud"``, a ball of fog under a white sky and a sun.

    Raises:
        FileNotFoundError: the package has no scene of this name; the message lists those it has.
    """
    path = FOLDER / f"{name}.xml"
    if path.name not in (there := {p.name for p in FOLDER.glob("*.xml")}):
        names = ", ".join(sorted(f'"{n.removesuffix(".xml")}"' for n in there))
        raise FileNotFoundError(f'there is no scene "{name}"; the package has {names}.')
    return str(path)
