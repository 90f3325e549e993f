"""A window's comparison with ``volpath``: which resolution, captions, and false colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.light import Light
from mitsuba_irrcache.view.picture import Look, displayed
from mitsuba_irrcache.view.reference import ViewReference

#: What a window can compare: nothing, the two images, or the difference between them.
KINDS = ("off", "swipe", "error")
#: Their names in the panel.
CHOICES = {"off": "off", "swipe with volpath": "swipe", "error against volpath": "error"}
#: Caption until the reference has its first sample.
WAITING = "volpath: waiting for its first sample"
#: Pixels of the window per pixel of the reference and side: the first one is used until the time of
#: a pass is known, then the finest with which a pass takes at most `PASS_SECONDS`.
COARSENESS = (4, 2, 1)
PASS_SECONDS = 3.0
#: Passes after which the resolution is chosen. The time of the first one does not count, since
#: kernels may be compiled in it.
PROBE = 2
#: Sides of the blocks of pixels over which errors are averaged, and the noise that their means may
#: have, relative to the mean of the image: noise of few samples would hide all else.
BLOCKS, BLOCK_NOISE = (1, 2, 4, 8, 16), 0.05
#: Largest relative error that has a colour of its own; noise of few samples is larger.
LARGEST = 1.0
#: Colours of errors from -1 to 1, blue for too dark and red for too bright.
_STOPS = np.array(
    [(5, 48, 97), (67, 147, 195), (247, 247, 247), (214, 96, 77), (103, 0, 31)], dtype=float
)


@dataclass(frozen=True, eq=False)
class Compared:
    """The state of a comparison.

    Attributes:
        kind: one of `KINDS`.
        text: about the reference.
        reference: its pixels, uint8 (height, width, 3); None before the first sample.
        error: false colours of the error, uint8 (height, width, 3), if that is displayed.
        limit: relative error that has the strongest colour.
    """

    kind: str
    text: str
    reference: np.ndarray | None = None
    error: np.ndarray | None = None
    limit: float = 0.0


class Comparison:
    """Refine the reference of a view, and compare images with it."""

    def __init__(self, light: Light, camera: Camera, size: tuple[int, int]) -> None:
        self.light, self.camera, self.size = light, camera, size
        self._reference = ViewReference(light, camera, size, COARSENESS[0])
        self._is_probing = True
        self._first_seconds = 0.0

    def belongs_to(self, light: Light, camera: Camera, size: tuple[int, int]) -> bool:
        """Return whether this is the comparison of a view of these caches."""
        return (self.light, self.camera, self.size) == (light, camera, size)

    @property
    def has_sample(self) -> bool:
        return self._reference.samples > 0

    @property
    def is_done(self) -> bool:
        return self._reference.is_done

    def refine(self) -> bool:
        """Add one sample per pixel to a band; return whether there is anything new to show."""
        known = self._reference
        complete = known.refine()
        if complete and self._is_probing and known.samples == 1:
            self._first_seconds = known.seconds
        if complete and self._is_probing and known.samples == PROBE:
            self._is_probing = False
            seconds = (known.seconds - self._first_seconds) / (PROBE - 1)
            finest = _finest(seconds, known.coarseness)
            if finest != known.coarseness:
                self._reference = ViewReference(self.light, self.camera, self.size, finest)
        return complete or not known.samples

    def state(self, kind: str, image: np.ndarray, look: Look, backdrop: np.ndarray) -> Compared:
        """Compare an ``image``, float (height, width, 3), that is displayed like ``look``.

        ``backdrop`` is what lies behind it.
        """
        known = self._reference
        text = known.comparison(image)
        if not known.samples:
            return Compared(kind, text)
        if kind == "error":
            side = block_side(known.noise)
            error = block_means(known.signed_error(image), side)
            if side > 1:
                text += f"; means of {side * known.coarseness} x {side * known.coarseness} pixels"
            limit = min(rounded(float(np.quantile(np.abs(error), 0.98))), LARGEST)
            colours = np.kron(false_colours(error / limit), np.ones((known.coarseness,) * 2 + (1,)))
            return Compared(kind, text, None, colours.astype(np.uint8), limit)
        return Compared(kind, text, displayed(known.radiance(), look, known.reduced(backdrop)))


def described(found: Compared) -> dict:
    """Return the message about a comparison for `page/overlay.js`."""
    if found.kind == "swipe":
        captions = {"left": "irrcache", "right": found.text}
        return {"mode": "swipe", "has_image": found.reference is not None, **captions}
    difference = f"irrcache − {found.text}" if found.limit else f"no error yet; {found.text}"
    message = {"mode": found.kind, "left": difference}
    if found.limit:
        scale = {
            "low": f"−{100 * found.limit:g} %",
            "high": f"+{100 * found.limit:g} % of the mean",
        }
        colours = false_colours(np.linspace(-1, 1, 101)).round().astype(int).tolist()
        message["scale"] = scale | {"colours": colours}
    return message


def false_colours(values: np.ndarray) -> np.ndarray:
    """Return colours (..., 3) in [0, 255] of values in [-1, 1], clamped."""
    at = np.linspace(-1, 1, len(_STOPS))
    return np.stack([np.interp(values, at, channel) for channel in _STOPS.T], axis=-1)


def block_side(noise: float | None) -> int:
    """Return the side of the smallest blocks of pixels whose means are free enough of noise.

    ``noise`` is the standard deviation of a pixel, None if it is not known.
    """
    if noise is None:
        return BLOCKS[-1]
    return next((side for side in BLOCKS if noise / side <= BLOCK_NOISE), BLOCKS[-1])


def block_means(values: np.ndarray, side: int) -> np.ndarray:
    """Return an array like ``values`` (height, width) of means over blocks of pixels."""
    for axis, length in enumerate(values.shape):
        starts = np.arange(0, length, side)
        counts = np.diff(np.append(starts, length))
        sums = np.add.reduceat(values, starts, axis=axis)
        means = sums / counts.reshape(-1, *(1,) * (values.ndim - 1 - axis))
        values = np.repeat(means, counts, axis=axis)
    return values


def rounded(limit: float) -> float:
    """Return the next larger of 1, 2, 5 times a power of ten, at least 0.001."""
    limit = max(limit, 1e-3)
    ten = 10.0 ** np.floor(np.log10(limit))
    return float(next(m * ten for m in (1, 2, 5, 10) if m * ten >= limit * (1 - 1e-9)))


def _finest(seconds: float, coarseness: int) -> int:
    """Return the coarseness to use, given the time of a pass with the present one."""
    fine = [c for c in COARSENESS if seconds * (coarseness / c) ** 2 <= PASS_SECONDS]
    return min([*fine, coarseness])
