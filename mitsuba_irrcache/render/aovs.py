"""The image in layers: colour and illumination apart (paper, section 3), and what goes with them.

    C = int T sigma_s dt                 colour
    E = int T sigma_s Phi / (4 pi) dt    scattered light
    I = E / C                            illumination

The film carries C and E, which are linear in the light; I is formed after the film's
reconstruction, so that C I + background is the image, whatever the film's filter. (Where a filter
with negative lobes leaves no colour, E passes as it is, and I is 0.) (The paper
multiplies the averages of two images, which is right only where one of them is constant.)
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.errors import IrrcacheError

#: Images that can be asked for, with the channels that their names end in, as in Mitsuba's ``aov``.
AOVS = {
    "colour": "RGB",
    "illumination": "RGB",
    "background": "RGB",
    "transmittance": "RGB",
    "depth": "T",
    "noise": "Y",
    "bias": "Y",
}

#: Below this colour there is no illumination to speak of: E passes through unfiltered.
LEAST_COLOUR = 1e-6


@dataclass
class Layers:
    """What a camera sample, or a pixel, sees; one value or one array of pixels each.

    ``depth`` is int (-dT/dt) t dt; ``probes`` are random errors as the cache's noise makes them and
    ``bias`` the expected error of its resolution, both in radiance. Everything is linear: the mean
    of samples is the pixel.
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
        """All values in a row, as a film takes them."""
        spectra = (self.scattered, self.colour, self.background, self.transmittance)
        return [*(c for s in spectra for c in s), self.depth, *self.probes, self.bias]

    @classmethod
    def of(cls, channels: list[mi.Float]) -> Layers:
        """The inverse of `channels`."""
        n = dr.size_v(mi.Spectrum)
        spectra = [mi.Spectrum(*channels[i * n : (i + 1) * n]) for i in range(4)]
        depth, *probes, bias = channels[4 * n :]
        return cls(*spectra, depth, probes, bias)

    @classmethod
    def background_only(cls, radiance: mi.Spectrum) -> Layers:
        """What is seen where there is no medium."""
        dark, zero = dr.zeros(mi.Spectrum, dr.width(radiance)), dr.zeros(mi.Float)
        return cls(dark, dark, radiance, dr.full(mi.Spectrum, 1), zero, [], zero)

    @property
    def valid(self) -> list[mi.Bool]:
        """Where there is an illumination, for every colour channel."""
        return [c > LEAST_COLOUR for c in self.colour]

    @property
    def illumination(self) -> mi.Spectrum:
        """I = E / C, 0 where there is none: in-scattered radiance Phi / (4 pi), averaged along the
        ray as the eye does.
        """
        pairs = zip(self.scattered, self.colour, self.valid, strict=True)
        return mi.Spectrum(*(dr.select(ok, e / dr.select(ok, c, 1), 0) for e, c, ok in pairs))

    @property
    def noise(self) -> mi.Float:
        """Standard error of the luminance that comes of the cache's noise."""
        if not self.probes:
            return dr.zeros(mi.Float, dr.width(self.depth))
        return dr.sqrt(sum(dr.square(p) for p in self.probes) / len(self.probes))

    def radiance(self, illumination: mi.Spectrum | None = None) -> mi.Spectrum:
        """The image; with another ``illumination`` in place of its own."""
        if illumination is None:
            return self.scattered + self.background
        parts = zip(self.scattered, self.colour, illumination, self.valid, strict=True)
        lit = mi.Spectrum(*(dr.select(ok, c * i, e) for e, c, i, ok in parts))
        return lit + self.background

    def aov(self, kind: str) -> list[mi.Float]:
        """The channels of one of `AOVS`."""
        if kind == "depth":
            opacity = 1 - luminance(self.transmittance)
            seen = opacity > LEAST_COLOUR
            return [dr.select(seen, self.depth / dr.select(seen, opacity, 1), 0)]
        value = getattr(self, kind)
        if AOVS[kind] != "RGB":
            return [value]
        return list(value) if len(value) == 3 else [value[0]] * 3


def parse_aovs(text: str) -> dict[str, str]:
    """Name and type of each image in a list ``name:type, type, ...`` of `AOVS`."""
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
