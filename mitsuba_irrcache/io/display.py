"""Display of linear radiance: exposure, tone curve, and a colour behind transparent pixels."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

#: Tone curves of radiance above 0, as NumPy arrays or as arrays of Dr.Jit; all are followed by the
#: sRGB transfer function.
TONES: dict[str, Callable] = {
    "sRGB": lambda c: c,
    "Reinhard": lambda c: c / (1 + c),
    # K. Narkowicz's fit of ACES, with a toe and a shoulder
    "filmic": lambda c: c * (2.51 * c + 0.03) / (c * (2.43 * c + 0.59) + 0.14),
}


@dataclass(frozen=True)
class Display:
    """How an image is displayed.

    Attributes:
        exposure: in stops.
        tone: one of `TONES`.
        background: linear RGB in [0, 1] of what is behind the image, where it is transparent,
            which exposure and tone do not change; None to leave it transparent.
    """

    exposure: float = 0.0
    tone: str = "sRGB"
    background: tuple[float, float, float] | None = None

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Return an ``image`` (height, width, channel) as it is displayed, linear, not clipped.

        Channels are luminance or RGB, premultiplied by alpha if there is one. With a background,
        there are three in the result.
        """
        colours = image.shape[2] - (image.shape[2] in (2, 4))
        shown = TONES[self.tone](np.maximum(image[..., :colours], 0) * 2.0**self.exposure)
        alpha = image[..., colours:]
        if self.background is None:
            return np.concatenate([shown, alpha], axis=-1)
        behind = np.asarray(self.background, dtype=image.dtype)
        return shown + (1 - alpha) * behind if alpha.size else shown + 0 * behind


#: The radiance itself, as sRGB.
PLAIN = Display()


def linear(value: float) -> float:
    """Return the linear value of an sRGB one in [0, 1]."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def hex_of(colour: tuple[float, float, float]) -> str:
    """Return the #rrggbb of a linear colour in [0, 1]."""
    curved = [12.92 * c if c <= 0.0031308 else 1.055 * c ** (1 / 2.4) - 0.055 for c in colour]
    return "#" + "".join(f"{round(255 * c):02x}" for c in curved)


def linear_colour(text: str) -> tuple[float, float, float]:
    """Return the linear RGB values of a CSS colour name, or of #rrggbb; raise ValueError."""
    text = text.strip().lower()
    if not re.fullmatch("#[0-9a-f]{6}", text):
        text = _hex_of_name(text)
    return tuple(linear(int(text[i : i + 2], 16) / 255) for i in (1, 3, 5))


def _hex_of_name(name: str) -> str:
    """Return the #rrggbb of a colour name of CSS."""
    # Loaded where it is needed: it takes a second.
    from colour.notation import RGB_to_HEX, keyword_to_RGB_CSSColor3

    try:
        return str(RGB_to_HEX(keyword_to_RGB_CSSColor3(name)))
    except (AssertionError, KeyError):
        raise ValueError(name) from None
