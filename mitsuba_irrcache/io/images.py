"""Atomic writing of images: an EXR with metadata and a PNG next to it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio  # noqa: N813 (the name its documentation uses)

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.display import PLAIN, Display

#: Channel names of an image by their number.
CHANNELS = {1: ("Y",), 2: ("Y", "A"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}


def check_output(path: str | Path) -> Path:
    """Return the path of a writable EXR; raise IrrcacheError before any work is done otherwise."""
    path = Path(path)
    if path.suffix.lower() != ".exr":
        raise IrrcacheError(f'the output "{path}" must end in .exr (a PNG is written next to it).')
    if not path.parent.is_dir():
        raise IrrcacheError(f'cannot write "{path}": the folder "{path.parent}" does not exist.')
    if path.is_dir():
        raise IrrcacheError(f'cannot write "{path}": it is a folder; name a file.')
    if not os.access(path.parent, os.W_OK):
        raise IrrcacheError(f'cannot write "{path}": no permission to write to "{path.parent}".')
    return path


def further_channels(count: int, names: Sequence[str]) -> list[str]:
    """Return the names of the channels of an image after its luminance or RGB, and alpha.

    ``names`` are those of an integrator, ``aov_names()``. Mitsuba's ``aov`` names R, G, B and A of
    each integrator in it, of which the image has the channels of the film, and first of all those
    of the first integrator. Raises IrrcacheError if the ``count`` channels have other names.
    """
    endings = [name.rpartition(".")[2] for name in names]
    nested = [i for i in range(len(names)) if endings[i : i + 4] == ["R", "G", "B", "A"]]
    if nested and count <= len(names):
        shown = (count - len(names)) // len(nested) + 4  # channels of the film
        left_out = {i + k for i in nested for k in range(shown, 4)}
        left_out |= {nested[0] + k for k in range(shown)}
        names = [name for i, name in enumerate(names) if i not in left_out]
    if count - len(names) not in CHANNELS:
        raise IrrcacheError(
            f"the integrator has {count} channels, but names {len(names)} beside those of the "
            f"image ({', '.join(names)}); leave some of its aovs out."
        )
    return list(names)


def write_image(
    path: str | Path,
    image: np.ndarray,
    metadata: dict[str, object],
    further: Sequence[str] = (),
    display: Display = PLAIN,
) -> Path:
    """Write ``image`` (height, width, channel), linear radiance, to an EXR and an sRGB PNG.

    The channels are luminance or RGB, optionally alpha, followed by those named in ``further`` (see
    `further_channels`), which are stored in the EXR only. ``metadata`` is stored in its header with
    the prefix ``irrcache:``; ``display`` affects the PNG only. Returns the path of the PNG.
    """
    path = check_output(path)
    image = np.ascontiguousarray(image, dtype=np.float32)
    buffer = oiio.ImageBuf(image)
    further = further_channels(image.shape[2], further) if further else ()
    shown = image.shape[2] - len(further)
    if further:
        buffer.specmod().channelnames = (*CHANNELS[shown], *further)
    for key, value in metadata.items():
        buffer.specmod().attribute(
            f"irrcache:{key}", value if isinstance(value, float | int) else str(value)
        )
    _write(buffer, path, oiio.FLOAT)
    png = path.with_suffix(".png")
    buffer = oiio.ImageBuf(np.ascontiguousarray(display.apply(image[..., :shown])))
    _write(oiio.ImageBufAlgo.colorconvert(buffer, "linear", "sRGB"), png, oiio.UINT8)
    return png


def write_pixels(path: Path, pixels: np.ndarray) -> None:
    """Write ``pixels``, uint8 (height, width, channel), to a PNG without conversion."""
    _write(oiio.ImageBuf(np.ascontiguousarray(pixels)), path, oiio.UINT8)


def read_image(path: str | Path) -> np.ndarray:
    """Read the pixels of an image file (height, width, channel) as float32, without conversion."""
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT))


def _write(buffer: oiio.ImageBuf, path: Path, kind: oiio.BASETYPE) -> None:
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        if buffer.has_error or not buffer.write(str(temporary), kind):
            raise IrrcacheError(f'cannot write "{path}": {buffer.geterror()}')
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
