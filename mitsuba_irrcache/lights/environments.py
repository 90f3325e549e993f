"""Radiance of environments, and angular detail of the emitters of a scene."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.detail import Detail
from mitsuba_irrcache.core.sequences import GOLDEN_STEP, fibonacci_hemisphere, lattice_points
from mitsuba_irrcache.lights.emitters import EmitterKind, kind_of

#: Ratio of the largest to the mean radiance up to which an environment counts as smooth. Uniformly
#: distributed directions have 0.3 to 0.8 times the error of directions sampled by its luminance up
#: to a ratio of 5.5, and up to 3 times the error at a ratio of 8.4.
SMOOTH_CONTRAST = 4.0
#: Degree of the spherical harmonics that even ordinates integrate exactly. The rest of the radiance
#: of an environment causes an error; where its root mean square is MOST_DETAIL times the mean
#: radiance, 128 even ordinates have the same error in a dense ball as 512 more that are sampled.
EXACT_DEGREE, MOST_DETAIL = 3, 0.08
#: Number of directions by which that ratio is measured: uniformly distributed ones, and samples of
#: the environment.
EVEN, SAMPLES = 1 << 13, 1 << 14


def detail_of(emitters: Iterable[mi.Emitter]) -> Detail:
    """Classify how much the radiance of all ``emitters`` of a scene varies with direction."""
    found = Detail.UNIFORM
    for emitter in emitters:
        kind = kind_of(emitter)
        if kind is EmitterKind.ENVIRONMENT_MAP and is_smooth(emitter):
            found = Detail.SMOOTH
        elif kind is not EmitterKind.CONSTANT_ENVIRONMENT:
            return Detail.SHARP
    return found


def is_smooth(environment: mi.Emitter) -> bool:
    """Return whether the maximum radiance of an environment is at most `SMOOTH_CONTRAST` times its
    mean, in every channel.
    """
    texels = mi.traverse(environment).get("data")
    if texels is not None and not dr.all(dr.isfinite(texels.array)):
        return False
    _, even = even_radiance(environment)
    points = mi.Point2f(np.float32(lattice_points(SAMPLES, GOLDEN_STEP)))
    record, _ = environment.sample_direction(dr.zeros(mi.Interaction3f, SAMPLES), points)
    towards = np.array(record.d, dtype=np.float64)
    if not even.any():  # a black map samples no direction: its directions are not a number
        towards = np.where(np.isfinite(towards), towards, [[0], [0], [1]])
    sampled = environment_radiance(environment, -towards.T)
    brightest = np.maximum(even.max(axis=0), sampled.max(axis=0))
    return bool((brightest <= SMOOTH_CONTRAST * even.mean(axis=0)).all())


def exceeds_even_ordinates(environment: mi.Emitter) -> bool:
    """Return whether an environment has too much angular detail for even ordinates alone.

    That is the case if it is not smooth, or if the root mean square of the part of its radiance
    that is orthogonal to all spherical harmonics that these integrate exactly is more than
    `MOST_DETAIL` times its mean radiance in some channel.
    """
    if not is_smooth(environment):
        return True
    directions, radiance = even_radiance(environment)
    polynomials = monomials(directions, EXACT_DEGREE)
    smooth, *_ = np.linalg.lstsq(polynomials, radiance, rcond=None)
    detail = np.sqrt(np.square(radiance - polynomials @ smooth).mean(axis=0))
    return bool((detail > MOST_DETAIL * radiance.mean(axis=0)).any())


def is_uneven(environment: mi.Emitter | None) -> bool:
    """Return whether there is an environment whose radiance may vary with the direction."""
    return environment is not None and kind_of(environment) is EmitterKind.ENVIRONMENT_MAP


@cache
def powers(degree: int) -> list[tuple[int, int, int]]:
    """Return the powers of x, y and z in all monomials up to ``degree``, in the order of theirs."""
    found = product(range(degree + 1), repeat=3)
    return sorted((each for each in found if sum(each) <= degree), key=sum)


def monomials(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return the m monomials (..., m) of ``directions`` (..., 3) up to ``degree``, see `powers`."""
    found = {(0, 0, 0): np.ones(directions.shape[:-1])}
    for power in powers(degree)[1:]:
        axis = np.flatnonzero(power)[0]
        lower = tuple(n - (k == axis) for k, n in enumerate(power))
        found[power] = found[lower] * directions[..., axis]
    return np.stack([found[power] for power in powers(degree)], axis=-1)


def even_radiance(environment: mi.Emitter, count: int = EVEN) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` evenly distributed directions (n, 3) and the radiance (n, channels) along
    them.
    """
    upper, _ = fibonacci_hemisphere(count // 2)
    directions = np.concatenate([upper, -upper])
    return directions, environment_radiance(environment, directions)


def environment_radiance(environment: mi.Emitter, directions: np.ndarray) -> np.ndarray:
    """Return the radiance (n, channels) of the environment that propagates along ``directions``
    (n, 3).
    """
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    interaction.wi = mi.Vector3f(directions.T.astype(np.float32))
    channels = environment.eval(interaction)
    values = [np.broadcast_to(np.array(v, dtype=np.float64), len(directions)) for v in channels]
    return np.stack(values, axis=1)
