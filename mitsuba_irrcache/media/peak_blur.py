"""Radiance behind a medium, blurred by the forward peak of its phase function.

delta-M (`delta_m`) treats scattering into the forward peak as unscattered, so the radiance L behind
the medium is multiplied by T', the transmittance of the scaled extinction. What the peak scatters,
(T' - T) L with the transmittance T of the original extinction, in fact comes from directions around
that of the ray. It matters at edges of bright surroundings, such as the horizon between a sky and
dark ground: the radiance that the peak scatters is

    (T' - T) int b(w . w') L(w') dw',

where b has the Legendre moments [exp(-D (1 - q_l)) - exp(-D)] / [1 - exp(-D)] of one or more
scattering events (see `aureole`), D = ln(T' / T), and q_l are the moments of the peak. They are 1
for the degrees l that the moments of the cache represent, so b has negative parts. Where all of its
parts have added up to 1, within 30 to 60 degrees, the integral is truncated.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.media.aureole import MAX_DEPTH, PEAK_MOMENTS, series_window

#: Number of directions by which the integral is estimated for each camera ray.
DIRECTIONS = 8
#: Numbers of depths D and of angles in the table, and of intervals of the angle by which these are
#: found.
DEPTHS, ANGLES, INTERVALS = 32, 256, 1024
#: Angles between which the integral is truncated; about that of ``hg``.
NARROWEST, WIDEST, BLUR_RADIUS = np.deg2rad(30), np.deg2rad(60), np.deg2rad(45)


class PeakBlur:
    """Sampling of the angular distribution b of radiance that a forward peak scatters."""

    # docs/primer, eq. (5.14)

    def __init__(self, moments: np.ndarray) -> None:
        """Tabulate the angles; ``moments`` are the `PEAK_MOMENTS` moments q_0 = 1, q_1, ..."""
        borders = np.linspace(0, WIDEST, INTERVALS + 1)
        middle = 0.5 * (borders[1:] + borders[:-1])
        polynomials = np.polynomial.legendre.legvander(np.cos(middle), PEAK_MOMENTS - 1)
        coefficients = (2 * np.arange(PEAK_MOMENTS) + 1) * series_window()
        depths = np.maximum(MAX_DEPTH * np.linspace(0, 1, DEPTHS) ** 2, 1e-6)[:, None]
        events = np.exp(-depths) * np.expm1(depths * moments) / -np.expm1(-depths)
        masses = (coefficients * events) @ polynomials.T
        masses *= 0.5 * np.sin(middle) * (borders[1] - borders[0])
        tables = [_sampling_table(borders, own) for own in masses]
        self._borders, self._weights = (
            mi.Float(np.concatenate(part).astype(np.float32)) for part in zip(*tables, strict=True)
        )

    def deflected(
        self, direction: mi.Vector3f, depth: mi.Float, u: mi.Point2f
    ) -> list[tuple[mi.Vector3f, mi.Float]]:
        """Sample `DIRECTIONS` directions around ``direction``, where ``depth`` is D.

        Returns them and their weights: the integral of b times a function, minus its value in
        ``direction``, is the mean of the weighted differences of the function.
        """
        frame, found = mi.Frame3f(direction), []
        place = dr.sqrt(dr.clip(depth * (1 / MAX_DEPTH), 0, 1)) * (DEPTHS - 1)
        row = mi.UInt32(dr.round(place))
        for k in range(DIRECTIONS):
            x = dr.minimum((u.x + k) * (ANGLES / DIRECTIONS), ANGLES * (1 - 1e-6))
            slot = mi.UInt32(x)
            at = row * (ANGLES + 1) + slot
            ends = [dr.gather(mi.Float, self._borders, at + i) for i in range(2)]
            sine, cosine = dr.sincos(dr.lerp(*ends, x - mi.Float(slot)))
            turn = dr.sincos(dr.two_pi * (u.y + k / DIRECTIONS))
            local = mi.Vector3f(sine * turn[1], sine * turn[0], cosine)
            weight = dr.gather(mi.Float, self._weights, row * ANGLES + slot)
            found.append((frame.to_world(local), weight))
        return found


def _sampling_table(borders: np.ndarray, masses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide the angles of one depth into `ANGLES` slots with equal integrals of the magnitude.

    ``masses`` are the integrals between the ``borders``. Returns the borders of the slots, and the
    weight of each.
    """
    sums = np.cumsum(masses)
    first = np.searchsorted(borders[1:], NARROWEST)
    count = first + int(np.abs(sums[first:] - 1).argmin()) + 1
    magnitudes = np.concatenate([[0], np.cumsum(np.abs(masses[:count]))])
    slots = np.interp(np.linspace(0, magnitudes[-1], ANGLES + 1), magnitudes, borders[: count + 1])
    signed = np.interp(slots, borders[: count + 1], np.concatenate([[0], sums[:count]]))
    return slots, np.diff(signed) * ANGLES
