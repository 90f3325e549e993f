"""Saving a view: images, caches, and a scene that renders the same image."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from mitsuba_irrcache import __version__
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.display import hex_of
from mitsuba_irrcache.io.images import write_image, write_pixels
from mitsuba_irrcache.view.document import sensor_of
from mitsuba_irrcache.view.picture import Look, Samples
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.window import SAMPLES, View

#: Layers in the EXR besides the image.
SAVED_AOVS = ("colour", "illumination", "background", "transmittance", "depth", "noise", "bias")
#: How often an image is rendered if the scene is changed while it is saved.
ATTEMPTS = 10
#: Pattern of accepted file names: no folders, no hidden files.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}")


def checked_name(name: str) -> str:
    """Return a file name that cannot lead out of its folder; raise IrrcacheError for others."""
    if not NAME.fullmatch(name):
        raise IrrcacheError(
            f"{name!r} is no name for a file: use letters, digits, dots, - and _, up to 80, a "
            "letter or digit first."
        )
    return name


def save_view(
    session: Session, view: View, folder: Path, name: str, with_cache: bool = False
) -> list[Path]:
    """Write ``name``.png (the displayed image), .exr (radiance and layers) and ``name``-scene.xml.

    The scene's `render_command` makes the same image, under names of its own. With ``with_cache``
    the caches are written too. Returns the files. Blocks until they are written, while the session
    goes on displaying images.
    """
    path = Path(folder) / checked_name(name)
    if not path.parent.is_dir():
        raise IrrcacheError(f'cannot write to "{folder}": there is no such folder.')
    exr, png = (path.with_name(f"{name}.{kind}") for kind in ("exr", "png"))

    def write(samples: Samples, plain: Samples) -> list[Path]:
        if session.has_edit:
            return []
        light = session.light
        image, names = samples.channels(SAVED_AOVS, view.look.filtered)
        about = {
            "version": __version__,
            "samples per voxel": light.samples,
            "spp": samples.count,
            "shown": f"{view.look.kind}, exposure {view.look.exposure:g}, {view.look.tone}",
        }
        write_image(exr, image, about, names)
        write_pixels(png, plain.picture(view.look, session.extent(view.camera)))
        caches = _write_caches(session, path) if with_cache else {}
        return [exr, png, *caches.values(), *_write_scene(session, view, path, samples, caches)]

    without = replace(view, look=replace(view.look, slices=None))
    is_same = view.look.layered and view.look.slices is None
    for _ in range(ATTEMPTS):  # again if the scene is changed meanwhile
        with session.reserved():
            samples = _samples(session, without, layered=True)
            plain = samples if is_same else _samples(session, view, layered=view.look.layered)
            files = session.call(lambda s=samples, p=plain: write(s, p))
        if files:
            return files
    raise IrrcacheError("the scene was changed again and again while it was saved; save it later.")


def scene_name(name: str) -> str:
    """Return the name of a saved scene; images that are rendered of it replace none of the view."""
    return f"{name}-scene.xml"


def render_command(name: str, look: Look) -> str:
    """Return the command that renders the saved scene of a view as it is displayed."""
    words = ["irrcache render", scene_name(name)]
    if look.exposure:
        words.append(f"--exposure {look.exposure:g}")
    if look.tone != Look().tone:
        words.append(f"--tone {look.tone}")
    if any(look.background):
        words.append(f"--background '{hex_of(look.background)}'")
    return " ".join(words)


def _samples(session: Session, view: View, layered: bool) -> Samples:
    """Return samples of the view, at least as many as an image at rest has.

    The displayed samples are used if they suffice. Otherwise samples are added one by one, so that
    other views can be displayed in between.
    """

    def begin() -> Samples:
        seen, slices = session.light.snapshot(layered, layered), view.look.slices
        known = session.complete(seen, view)
        return known or Samples(seen, view.camera, view.size, slices=slices)

    samples = session.call(begin)
    while samples.count < SAMPLES:
        session.call(lambda: samples.advance(SAMPLES))
    return samples


def _write_caches(session: Session, path: Path) -> dict[str, Path]:
    """Write the caches of all media under names derived from the integrator's ``cache_file``."""
    light, files = session.light, {}
    for part in light.parts:
        if part.is_dark or not part.cache.samples:
            continue
        several = f".{part.name}" if part.name and len(light.parts) > 1 else ""
        files[part.name] = path.with_name(f"{path.name}{several}.cache")
        part.save_as(light.scene, files[part.name])
    return files


def _write_scene(
    session: Session, view: View, path: Path, samples: Samples, caches: dict[str, Path]
) -> list[Path]:
    light, xml = session.light, path.with_name(scene_name(path.name))
    properties = {"cache_spp": ("integer", str(max(light.samples, 0)))}
    if caches:
        properties["cache_file"] = ("string", str(path.with_name(f"{path.name}.cache").resolve()))
    if view.look.filtered:
        properties["filter"] = ("string", "bilateral")
    inside = samples.seen.medium_at(view.camera.position) is not None
    look = view.look
    note = f"irrcache view: {look.kind}, exposure {look.exposure:g}, {look.tone}"
    sensor = sensor_of(view.camera, view.size, with_alpha=any(look.background))
    return session.document.save(xml, sensor, inside, properties, note)
