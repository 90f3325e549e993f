"""Components of the image: colour and illumination (paper, section 3), and further AOVs.

    C = int T sigma_s dt                 colour
    E = int T sigma_s Phi / (4 pi) dt    scattered radiance
    I = E / C                            illumination

The film stores C and E, which are linear in the radiance; I is computed after the film's
reconstruction, so that C I + background is the image for every reconstruction filter. (Where a
filter with negative lobes makes C vanish, E is used unchanged and I is 0. The paper multiplies the
averages of two images, which is correct only if one of them is constant.)
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.errors import IrrcacheError

#: Supported AOVs and the suffixes of their channels, as in Mitsuba's ``aov``.
AOVS = {
    "colour": "RGB",
    "illumination": "RGB",
    "background": "RGB",
    "transmittance": "RGB",
    "depth": "T",
    "noise": "Y",
    "bias": "Y",
}

#: Minimum colour for which the illumination is defined; below it, E is used unfiltered.
LEAST_COLOUR = 1e-6


@dataclass
class Layers:
    """Components of a camera sample or pixel; each is one value or an array over pixels.

    ``depth`` is int (-dT/dt) t dt; ``probes`` are random errors distributed like the cache's noise,
    and ``bias`` is the expected discretisation error, both in radiance. All components are linear,
    so that the mean over samples is the value of the pixel.
    """

    # docs/primer, eq. (5.6)

    scattered: mi.Spectrum
    colour: mi.Spectrum
    background: mi.Spectrum
    transmittance: mi.Spectrum
    depth: mi.Float
    probes: list
    bias: mi.Float

    def channels(self) -> list[mi.Float]:
        """Return all values as a list, in the order of the film's channels."""
        spectra = (self.scattered, self.colour, self.background, self.transmittance)
        return [*(c for s in spectra for c in s), self.depth, *self.probes, self.bias]

    @classmethod
    def of(cls, channels: list[mi.Float]) -> Layers:
        """Return the inverse of `channels`."""
        n = dr.size_v(mi.Spectrum)
        spectra = [mi.Spectrum(*channels[i * n : (i + 1) * n]) for i in range(4)]
        depth, *probes, bias = channels[4 * n :]
        return cls(*spectra, depth, probes, bias)

    @classmethod
    def background_only(cls, radiance: mi.Spectrum) -> Layers:
        """Return the components of rays that do not intersect a medium."""
        dark, zero = dr.zeros(mi.Spectrum, dr.width(radiance)), dr.zeros(mi.Float)
        return cls(dark, dark, radiance, dr.full(mi.Spectrum, 1), zero, [], zero)

    @property
    def valid(self) -> list[mi.Bool]:
        """Return for each colour channel whether the illumination is defined."""
        return [c > LEAST_COLOUR for c in self.colour]

    @property
    def illumination(self) -> mi.Spectrum:
        """Return I = E / C, the weighted mean of Phi / (4 pi) along the ray; 0 where undefined."""
        pairs = zip(self.scattered, self.colour, self.valid, strict=True)
        return mi.Spectrum(*(dr.select(ok, e / dr.select(ok, c, 1), 0) for e, c, ok in pairs))

    @property
    def noise(self) -> mi.Float:
        """Return the standard error of the luminance caused by the noise of the cache."""
        if not self.probes:
            return dr.zeros(mi.Float, dr.width(self.depth))
        return dr.sqrt(sum(dr.square(p) for p in self.probes) / len(self.probes))

    def radiance(self, illumination: mi.Spectrum | None = None) -> mi.Spectrum:
        """Compose the image, optionally with another ``illumination``."""
        if illumination is None:
            return self.scattered + self.background
        parts = zip(self.scattered, self.colour, illumination, self.valid, strict=True)
        scattered = mi.Spectrum(*(dr.select(ok, c * i, e) for e, c, i, ok in parts))
        return scattered + self.background

    def aov(self, kind: str) -> list[mi.Float]:
        """Return the channels of one of `AOVS`."""
        if kind == "depth":
            opacity = 1 - luminance(self.transmittance)
            visible = opacity > LEAST_COLOUR
            return [dr.select(visible, self.depth / dr.select(visible, opacity, 1), 0)]
        value = getattr(self, kind)
        if AOVS[kind] != "RGB":
            return [value]
        return list(value) if len(value) == 3 else [value[0]] * 3


def parse_aovs(text: str) -> dict[str, str]:
    """Parse a list ``name:type, type, ...`` into a dictionary from names to types of `AOVS`."""
    found: dict[str, str] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, _, kind = (part.strip() for part in item.rpartition(":"))
        name = name or kind
        if kind not in AOVS:
            raise IrrcacheError(
                f'irrcache: aovs names the type "{kind}"; it must be one of: {", ".join(AOVS)}.'
            )
        if name in found:
            raise IrrcacheError(f'irrcache: aovs names "{name}" twice; write other:{kind}.')
        found[name] = kind
    return found
