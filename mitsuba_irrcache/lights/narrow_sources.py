"""Narrow sources: suns, points, lamps and bright spots of environments, whose direction is known.

Spherical harmonics of low order cannot represent their radiance (see `cache/angular`).
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.sequences import GOLDEN_STEP, lattice_points
from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.lights.emitters import (
    EmitterKind,
    emits_in_one_direction,
    illuminating,
    kind_of,
)

#: Maximum sine of the angular radius of a lamp that is treated as narrow.
MAX_LAMP_SINE = 0.95
#: Angular radius [rad] of sources without extent.
MIN_ANGULAR_RADIUS = 0.005
#: Bright spots of an environment: minimum and maximum angular radius.
MIN_SPOT_RADIUS, MAX_SPOT_RADIUS = float(np.deg2rad(4)), float(np.deg2rad(12))
#: Their minimum share of the total irradiance (1/820 if it is uniform), and maximum number.
MIN_SPOT_SHARE, MAX_SPOTS = 0.02, 4
#: Share of the energy within the maximum radius that the radius of a spot must enclose. Energy
#: outside of it is sampled by few ordinates only, and may still exceed that of the remaining
#: environment.
ENCLOSED_ENERGY = 0.9995
#: Ratio of the sampling density of an environment to the uniform density above which it counts as
#: bright, also outside of spots.
BRIGHT = 8.0
#: Maximum root mean square radius of spots that are treated as points.
MAX_POINT_RADIUS = float(np.deg2rad(1))
#: Number of environment samples used to find spots.
SPOT_SAMPLES = 1 << 16
#: Maximum number of narrow lamps, and surface samples that determine the extent of each.
MAX_LAMPS, LAMP_SAMPLES = 8, 1024
#: Lower bound of distances and squared distances, to avoid division by 0.
TINY = 1e-30


class Source:
    """A narrow source at the position ``place``, or, if ``far``, in the direction ``place``.

    ``size`` is its radius, or its angular radius [rad] if ``far``. ``spread`` is the covariance
    (3, 3) of the points of a lamp (an area emitter), or the mean square angle [rad^2] of a spot;
    None for sources that are treated as points.
    """

    def __init__(
        self, place: np.ndarray, size: float, far: bool, spread: np.ndarray | float | None = None
    ) -> None:
        self.far = far
        #: whether its extent has to be taken into account
        self.wide = spread is not None
        self._direction, self._cosine = np.array(place), np.cos(size)
        #: whether its radiance is excluded from the moments L_lm
        self.sharp = far or not size
        self.place = mi.Vector3f(*(dr.opaque(mi.Float, float(v)) for v in place))
        self._size = dr.opaque(mi.Float, float(np.cos(size) if far else size))
        if self.wide and far:
            self._variance = dr.opaque(mi.Float, float(spread))
        elif self.wide:
            rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in spread]
            self._covariance = [mi.Vector3f(*row) for row in rows]

    def seen_from(self, p: mi.Point3f) -> tuple[mi.Vector3f, mi.Float]:
        """Return the direction to the source, and the cosine of its angular radius.

        The cosine is 2 at points where the source is not narrow.
        """
        return (self.place, self._size) if self.far else _seen(self.place, self._size, p)

    def distance(self, p: mi.Point3f) -> mi.Float:
        """Return the distance from ``p`` to the centre of the source, infinite if it is ``far``."""
        return mi.Float(dr.inf) if self.far else dr.norm(self.place - mi.Vector3f(p))

    def variance(self, p: mi.Point3f) -> mi.Float:
        """Return the mean square angle [rad^2] between the centre of the source and its points, as
        seen from ``p``.
        """
        if self.far:
            return self._variance
        offset = self.place - mi.Vector3f(p)
        inverse = dr.rcp(dr.maximum(dr.squared_norm(offset), TINY))
        along_view = sum(
            w * dr.dot(row, offset) for w, row in zip(offset, self._covariance, strict=True)
        )
        total = sum(row[i] for i, row in enumerate(self._covariance))
        return dr.maximum(total - along_view * inverse, 0) * inverse

    def is_same(self, other: Source) -> bool:
        """Return whether ``other`` is at the same position, or in the same direction."""
        return self.far == other.far and np.array_equal(self._direction, other._direction)

    @property
    def is_spot(self) -> bool:
        """Whether it is a bright spot of an environment, which has an extent."""
        return self.far and self._cosine < np.cos(MIN_ANGULAR_RADIUS) - 1e-6

    def covers(self, directions: np.ndarray) -> np.ndarray:
        """Return whether ``directions`` (..., 3) point to this source.

        False for all unless it is ``far``.
        """
        return (directions @ self._direction >= self._cosine) & self.far


class SourceTable:
    """The values of several sources in arrays, for kernels that do not depend on their number."""

    def __init__(self, sources: Sequence[Source]) -> None:
        #: number of sources
        self.count = len(sources)
        self._place = mi.Vector3f(np.float32([s._direction for s in sources]).reshape(-1, 3).T)
        self._size = mi.Float([s._size[0] for s in sources])
        self._far = mi.Bool([s.far for s in sources])

    def seen_from(self, p: mi.Point3f, number: mi.UInt32) -> tuple[mi.Vector3f, mi.Float]:
        """Return the same as `Source.seen_from`, of the source with this ``number``."""
        place, size = (
            dr.gather(mi.Vector3f, self._place, number),
            dr.gather(mi.Float, self._size, number),
        )
        towards, cosine = _seen(place, size, p)
        far = dr.gather(mi.Bool, self._far, number)
        return dr.select(far, place, towards), dr.select(far, size, cosine)


def _seen(place: mi.Vector3f, radius: mi.Float, p: mi.Point3f) -> tuple[mi.Vector3f, mi.Float]:
    """Return the direction from ``p`` to a sphere around ``place``, and the cosine of its angular
    radius; 2 where it is not narrow.
    """
    offset = place - mi.Vector3f(p)
    distance = dr.maximum(dr.norm(offset), TINY)
    sine = dr.maximum(radius / distance, MIN_ANGULAR_RADIUS)
    cosine = dr.select(sine < MAX_LAMP_SINE, dr.sqrt(1 - dr.square(sine)), 2)
    return offset / distance, cosine


def sources_of(
    scene: mi.Scene, known: Sequence[mi.Emitter] = ()
) -> tuple[list[Source], list[Source]]:
    """Find the narrow sources of a scene.

    Returns two lists: the sources of emitters other than ``known``, and those of the ``known``
    emitters, whose irradiance camera rays evaluate in closed form. Raises UnsupportedSceneError for
    emitters of unknown kinds, which may be narrow and which moments would then represent wrongly,
    unless they have a single direction.
    """
    found, others, lamps = [], [], []
    for emitter in illuminating(scene):
        kind, parts = kind_of(emitter), others if emitter in known else found
        if emits_in_one_direction(emitter):
            parts.append(Source(_sampled(emitter).d.numpy().ravel(), MIN_ANGULAR_RADIUS, far=True))
        elif kind.is_point_like:
            parts.append(Source(_sampled(emitter).p.numpy().ravel(), 0.0, far=False))
        elif kind.is_environment:
            found += spots_of(emitter)[0]
        elif kind is not EmitterKind.AREA:
            raise UnsupportedSceneError(
                f'irrcache: emitter "{emitter.id()}" ({emitter.class_name()}) is of a kind '
                f"({kind.value}) that media with anisotropic phase functions do not support. Make "
                'the phase function isotropic, or render this scene with "volpath".'
            )
    for shape in scene.shapes():
        if shape.is_emitter():
            (others if shape.emitter() in known else lamps).append(_lamp(shape))
    return found + lamps[:MAX_LAMPS], others


def _lamp(shape: mi.Shape) -> Source:
    box, rng = shape.bbox(), np.random.default_rng(LAMP_SAMPLES)
    radius = 0.5 * float(np.linalg.norm(np.array(box.max) - np.array(box.min)))
    points = shape.sample_position(0.0, mi.Point2f(np.float32(rng.random((2, LAMP_SAMPLES))))).p
    covariance = np.cov(np.array(points, dtype=np.float64))
    return Source(np.array(box.center()).ravel(), radius, False, covariance)


def _sampled(emitter: mi.Emitter) -> mi.DirectionSample3f:
    record, _ = emitter.sample_direction(dr.zeros(mi.Interaction3f, 1), mi.Point2f(0.5))
    return record


def spots_of(environment: mi.Emitter) -> tuple[list[Source], np.ndarray]:
    """Find bright spots of an environment: circles that contain a large share of its irradiance.

    Returns the n spots, and an array (2 + n, channels) of irradiances: from directions outside of
    all spots that are not bright (see `is_bright`), from each spot, and from bright directions
    outside of all spots.
    """
    rng = np.random.default_rng(3)
    points = lattice_points(SPOT_SAMPLES, GOLDEN_STEP)
    samples = mi.Point2f(np.float32((points + rng.random((2, 1))) % 1))
    record, colours = environment.sample_direction(
        dr.zeros(mi.Interaction3f, SPOT_SAMPLES), samples
    )
    directions = np.array(record.d, dtype=np.float64)
    colours = np.stack([np.broadcast_to(np.array(c), SPOT_SAMPLES) for c in colours])
    irradiance = colours.mean(axis=0)
    finite = np.isfinite(irradiance).all() and np.isfinite(directions).all()
    if not finite or directions.shape != (3, SPOT_SAMPLES):
        return [], np.full((2, len(colours)), np.nan)
    total, found, numbers = irradiance.sum(), [], np.zeros(SPOT_SAMPLES, int)
    while len(found) < MAX_SPOTS:
        centre = _brightest(directions, irradiance)
        own = centre @ directions >= np.cos(MIN_SPOT_RADIUS)
        if not irradiance[own].sum() > MIN_SPOT_SHARE * total:
            break
        size, variance = _extent(np.arccos(np.clip(centre @ directions, -1, 1)), irradiance)
        found.append(
            Source(centre, size, True, variance if variance > MAX_POINT_RADIUS**2 else None)
        )
        own = (irradiance > 0) & (centre @ directions >= np.cos(size))
        irradiance, numbers[own] = np.where(own, 0, irradiance), len(found)
    numbers[(numbers == 0) & is_bright(np.array(record.pdf))] = 1 + len(found)
    shares = [colours[:, numbers == k].sum(axis=1) for k in range(2 + len(found))]
    return found, np.array(shares, dtype=np.float64) / SPOT_SAMPLES


def is_bright(density: np.ndarray) -> np.ndarray:
    """Return whether an environment is bright where it is sampled with ``density`` [1/sr]."""
    return density > BRIGHT / (4 * np.pi)


def _extent(angles: np.ndarray, irradiance: np.ndarray) -> tuple[float, float]:
    """Return angular radius [rad] and mean square angle [rad^2] of a spot.

    ``irradiance`` are samples at these ``angles`` from the centre of the spot.

    The radiance around the spot is subtracted as background.
    """
    circle = 1 - np.cos(MAX_SPOT_RADIUS)
    around = (angles > MAX_SPOT_RADIUS) & (angles < 1.5 * MAX_SPOT_RADIUS)
    background = irradiance[around].sum() / (
        np.cos(MAX_SPOT_RADIUS) - np.cos(1.5 * MAX_SPOT_RADIUS)
    )
    order = np.argsort(angles)
    order = order[angles[order] <= MAX_SPOT_RADIUS]
    own = np.cumsum(irradiance[order]) - background * (1 - np.cos(angles[order]))
    encloses = own >= ENCLOSED_ENERGY * (irradiance[order].sum() - background * circle)
    size = float(angles[order][encloses.argmax()]) if encloses.any() else MIN_SPOT_RADIUS
    size = max(MIN_SPOT_RADIUS, size)
    within = angles <= size
    return size, float((irradiance[within] * angles[within] ** 2).sum() / irradiance[within].sum())


def _brightest(directions: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """Return the direction around which the most irradiance is concentrated."""
    z = np.minimum((directions[2] + 1) * 18, 35).astype(int)
    turn = (np.arctan2(directions[1], directions[0]) / (2 * np.pi) % 1 * 72).astype(int) % 72
    cell = z * 72 + turn
    sums = np.bincount(cell, irradiance)
    own = cell == sums.argmax()
    for _ in range(4):
        mean = directions[:, own] @ irradiance[own]
        if not np.linalg.norm(mean) > 0:
            break
        centre = mean / np.linalg.norm(mean)
        own = centre @ directions >= np.cos(MIN_SPOT_RADIUS)
    else:
        return centre
    return np.array([0.0, 0.0, 1.0])
