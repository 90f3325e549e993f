"""The float images of a comparison as data in its HTML page, with the controls to view them.

`page/images.js` displays them; it needs no server, no other file and no library. JERI, the viewer
known for such reports, is React around OpenEXR in WebAssembly, which browsers do not load from a
file on disk.
"""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import matplotlib
import numpy as np

from . import style
from .metrics import colours
from .reference import Reference
from .results import Measurement
from .tables import percent

#: Upper limit of the embedded image data in bytes; images beyond it are named instead.
MOST_BYTES = 48 << 20
PAGE = Path(__file__).with_name("page")
_ERRORS = ("radiance", "signed error", "relative error")
_TONES = ("sRGB", "Reinhard", "filmic")


@dataclass
class Images:
    """The images of a report.

    Attributes:
        data: what `page/images.js` reads.
        left_out: captions of the images beyond `MOST_BYTES`.
    """

    data: dict
    left_out: list[str] = field(default_factory=list)


def images(
    measurements: list[Measurement],
    rows: list[dict],
    reference: Reference,
    folder: Path,
    exposure: float,
) -> Images:
    """Return the images of all snapshots and of the reference.

    If they exceed `MOST_BYTES`, those of the longest budgets are kept. ``rows`` are the errors by
    `scores.score_all`.
    """
    errors = {(row["integrator"], row["budget"]): row["rmse"] for row in rows}
    truth = colours(reference.mean)
    shown = [m for m in measurements if m.snapshots]
    last = {"row": len(shown), "label": "reference", "caption": "reference", "data": pack(truth)}
    size, kept, left_out = len(last["data"]), {}, []
    every = [(s.budget, row, m, s) for row, m in enumerate(shown) for s in m.snapshots]
    for budget, row, m, snapshot in sorted(every, key=lambda e: -e[0]):
        error = percent(errors[m.integrator, budget])
        caption = f"{m.integrator}, {snapshot.total:.3g} s, RMSE {error}"
        data = pack(colours(snapshot.read(folder)))
        size += len(data)
        if size > MOST_BYTES:
            left_out.append(caption)
            continue
        label = f"{snapshot.total:.3g} s"
        kept[row, budget] = {"row": row, "label": label, "caption": caption, "data": data}
    ordered = [kept[key] for key in sorted(kept)]
    latest = [i for i, image in enumerate(ordered) if image["row"] == 0]
    return Images(
        {
            "width": truth.shape[1],
            "height": truth.shape[0],
            "channels": truth.shape[2],
            "mean": float(truth.mean()) or 1.0,
            "exposure": exposure,
            "rows": [*(m.integrator for m in shown), ""],
            "first": latest[-1] if latest else 0,
            "images": [*ordered, last],
            "colours": {"signed": _colours(style.SIGNED), "size": _colours("inferno")},
        },
        left_out,
    )


def pack(image: np.ndarray) -> str:
    """Encode an image (height, width, channel) of radiance as text.

    Half-float codes, channel by channel, as differences to the pixel on the left (modulo 2^16), the
    low bytes of all before the high ones, deflated, in base64. Values beyond the range of half
    floats, 65504, become infinite.
    """
    with np.errstate(over="ignore"):
        codes = np.moveaxis(image, -1, 0).astype("<f2").view("<u2")
    steps = np.diff(codes, axis=-1, prepend=np.zeros_like(codes[..., :1])).ravel()
    planes = np.ascontiguousarray(steps).view(np.uint8).reshape(-1, 2).T
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode()


def unpack(text: str, shape: tuple[int, int, int]) -> np.ndarray:
    """Return the image (height, width, channel), float16, that `pack` encoded."""
    height, width, channels = shape
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(2, -1)
    steps = np.ascontiguousarray(planes.T).view("<u2").reshape(channels, height, width)
    codes = np.cumsum(steps, axis=-1, dtype=np.uint16)
    return np.moveaxis(codes.view(np.float16), 0, -1)


def html(found: Images) -> str:
    """Return the controls and the data; the page needs `page/images.js` after them."""
    note = ""
    if found.left_out:
        note = (
            f'<p class="note">Left out, because the page would exceed {MOST_BYTES >> 20} MB: '
            f"{escape('; '.join(found.left_out))}. They are in the folder images/.</p>"
        )
    data = json.dumps(found.data).replace("<", "\\u003c")
    exposure = min(max(found.data["exposure"], -10), 10)
    return (
        f'<div class="images">{_controls(exposure)}'
        '<canvas data-id="canvas" tabindex="0" role="img" aria-label="the chosen images; '
        'the keys are listed below"></canvas>'
        '<div class="values" data-id="values">decoding the images ...</div>'
        f'<table class="choices" data-id="choices"></table>{_HELP}</div>{note}'
        f'<script type="application/json" id="image-data">{data}</script>'
    )


_HELP = (
    '<p class="note">Click on a time: show that image (blue). Shift and click: compare with it '
    "(red frame). Wheel: zoom, to the values of single pixels; drag: pan; double click or F: the "
    "whole image. Keys, after a click on the image: ← → and 1 to 9 change the image, space flips "
    "to the red one and back, S swipe, D side by side, E signed and R relative error, + and − "
    "exposure.</p>"
)


def _controls(exposure: float) -> str:
    return (
        '<div class="row">'
        f"{_select('show', 'quantity', _ERRORS)}"
        f"{_select('as', 'layout', ('swipe', 'side by side', 'one'))}"
        f'<span data-id="tone-controls">{_select("tone", "tone", _TONES)} '
        f"{_slider('exposure', 'exposure', -10, 10, 0.5, exposure)}"
        '<output data-id="stops"></output></span>'
        '<span data-id="error-controls" hidden="">'
        f"{_slider('scale', 'limit', -1, 3, 0.1, 1)} "
        '<label><input type="checkbox" data-id="blocks"/>averaged over 8 × 8 pixels</label></span>'
        '<button data-id="fit">whole image</button></div>'
        '<div class="row scale" data-id="scale" hidden=""><span data-id="low"></span>'
        '<canvas data-id="bar"></canvas><span data-id="high"></span></div>'
    )


def _select(label: str, name: str, options: tuple[str, ...]) -> str:
    inside = "".join(f"<option>{escape(option)}</option>" for option in options)
    return f'<label>{label}<select data-id="{name}">{inside}</select></label>'


def _slider(label: str, name: str, low: float, high: float, step: float, value: float) -> str:
    return (
        f'<label>{label}<input type="range" data-id="{name}" min="{low}" max="{high}" '
        f'step="{step}" value="{value}"/></label>'
    )


def _colours(name: str) -> list[list[int]]:
    """Return a colour map as 256 colours of integers in [0, 255]."""
    table = matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3]
    return np.rint(255 * table).astype(int).tolist()
