"""Saving a view: images, caches, and a scene that renders the same image."""

from __future__ import annotations

import re
from pathlib import Path

from mitsuba_irrcache import __version__
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.images import write_image, write_pixels
from mitsuba_irrcache.view.picture import Samples
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.window import SAMPLES, View

#: Layers in the EXR besides the image.
SAVED_AOVS = ("colour", "illumination", "background", "transmittance", "depth", "noise", "bias")
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


def keep(
    session: Session, view: View, folder: Path, name: str, with_cache: bool = False
) -> list[Path]:
    """Write ``name``.png (the displayed image), .exr (radiance and layers) and .xml.

    The XML is a scene of which ``irrcache render`` makes the same image. With ``with_cache`` the
    caches are written too. Returns the files. Blocks until they are written, while the session goes
    on displaying images.
    """
    path = Path(folder) / checked_name(name)
    if not path.parent.is_dir():
        raise IrrcacheError(f'cannot write to "{folder}": there is no such folder.')
    with session.reserved():
        samples = _samples(session, view, layered=True)
        plain = _samples(session, view, layered=False) if not view.look.layered else samples
    exr, png, xml = (path.with_name(f"{name}.{kind}") for kind in ("exr", "png", "xml"))

    def write() -> list[Path]:
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
        return [exr, png, *caches.values(), *_write_scene(session, view, xml, samples, caches)]

    return session.call(write)


def _samples(session: Session, view: View, layered: bool) -> Samples:
    """Return samples of the view, at least as many as an image at rest has.

    The displayed samples are used if they suffice. Otherwise samples are added one by one, so that
    other views can be displayed in between.
    """

    def begin() -> Samples:
        seen = session.light.seen(layered, layered)
        return session.complete(seen, view) or Samples(seen, view.camera, view.size)

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
    session: Session, view: View, xml: Path, samples: Samples, caches: dict[str, Path]
) -> list[Path]:
    light = session.light
    properties = {"cache_spp": ("integer", str(max(light.samples, 0)))}
    if caches:
        properties["cache_file"] = ("string", str(xml.with_suffix(".cache").resolve()))
    if view.look.filtered:
        properties["filter"] = ("string", "bilateral")
    inside = samples.seen.medium_at(view.camera.position) is not None
    note = f"irrcache view: {view.look.kind}, exposure {view.look.exposure:g}, {view.look.tone}"
    return session.document.save(xml, view.camera, view.size, inside, properties, note)
