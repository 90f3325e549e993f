"""Signed distances (mm, negative inside) to the solids of an anatomical phantom.

Every solid has ``bounds()``, the corners ``(lower, upper)`` of an axis-aligned bounding box, and
``distance(x, y, z, edge)`` for coordinates in mm that broadcast against each other. ``edge`` is the
width in mm over which a surface is blended; only solids thinner than that need it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from mitsuba_irrcache.volumes.phantom.splines import Curve, monotone, smooth

Bounds = tuple[np.ndarray, np.ndarray]


class Solid(Protocol):
    """The interface of the solids that a canvas can paint."""

    def bounds(self) -> Bounds:
        """Return the corners of a bounding box in mm."""

    def distance(self, x: np.ndarray, y: np.ndarray, z: np.ndarray, edge: float) -> np.ndarray:
        """Return the signed distance in mm."""


def _unit(vector: Sequence[float]) -> np.ndarray:
    vector = np.asarray(vector, dtype=np.float64)
    return vector / np.linalg.norm(vector)


def _along(axis: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the scalar product with ``axis`` in float32, scaling the coordinate axes first."""
    axis = axis.astype(np.float32)
    return (axis[2] * z + axis[1] * y) + axis[0] * x


@dataclass(frozen=True)
class Segment:
    """A bar with rounded edges: a capsule whose radius changes linearly, or a flat ribbon.

    ``half_width`` widens the bar to both sides along ``side`` (orthogonalised against its axis).
    """

    start: np.ndarray
    end: np.ndarray
    start_radius: float
    end_radius: float
    half_width: float = 0.0
    side: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def bounds(self) -> Bounds:
        reach = max(self.start_radius, self.end_radius) + self.half_width
        return np.minimum(self.start, self.end) - reach, np.maximum(self.start, self.end) + reach

    def distance(self, x: np.ndarray, y: np.ndarray, z: np.ndarray, edge: float) -> np.ndarray:
        axis = self.end - self.start
        length = float(np.linalg.norm(axis))
        axis = axis / length
        x, y, z = (c - np.float32(s) for c, s in zip((x, y, z), self.start, strict=True))
        along = _along(axis, x, y, z)
        nearest = np.clip(along, 0, length)
        squared = (z * z + y * y) + x * x + nearest * (nearest - 2 * along)
        if self.half_width > 0:
            side = np.asarray(self.side, dtype=np.float64)
            across = _along(_unit(side - (side @ axis) * axis), x, y, z)
            sideways = np.clip(across, -self.half_width, self.half_width)
            squared += sideways * (sideways - 2 * across)
        radius = self.start_radius + nearest * ((self.end_radius - self.start_radius) / length)
        return self._conserve(np.sqrt(np.maximum(squared, 0)), radius, edge)

    def _conserve(self, to_axis: np.ndarray, radius: np.ndarray, edge: float) -> np.ndarray:
        """Scale the distance so that a bar thinner than ``edge`` keeps its cross-section.

        Such a bar is drawn with radius ``edge / 2`` and its coverage ``1/2 - distance / edge`` is
        scaled by the ratio of the cross-sections, which is again a linear function of distance.
        """
        drawn = np.maximum(radius, edge / 2)
        share = radius / drawn
        if self.half_width == 0:
            share *= share
        return share * (to_axis - drawn) + (1 - share) * (edge / 2)


def chain(
    points: Sequence[Sequence[float]],
    radii: float | Sequence[float],
    half_width: float = 0.0,
    side: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> list[Segment]:
    """Return segments through ``points`` (n, 3) with one radius or one per point, mm."""
    points = np.asarray(points, dtype=np.float64)
    radii = np.broadcast_to(np.asarray(radii, dtype=np.float64), len(points))
    return [
        Segment(points[i], points[i + 1], radii[i], radii[i + 1], half_width, side)
        for i in range(len(points) - 1)
    ]


def smooth_curve(points: Sequence[Sequence[float]], count: int, reach: float = 1.0) -> np.ndarray:
    """Return ``count`` points on the first part ``reach`` of the spline through ``points``."""
    points = np.asarray(points, dtype=np.float64)
    chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
    position = np.concatenate([[0.0], np.cumsum(chords)])
    return smooth(position, points)(np.linspace(0, reach * position[-1], count))


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid; ``long_axis`` is the direction of its first radius, z of the last."""

    centre: tuple[float, float, float]
    radii: tuple[float, float, float]
    long_axis: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def _axes(self) -> np.ndarray:
        first = _unit(self.long_axis)
        second = _unit(np.cross([0.0, 0.0, 1.0], first))
        return np.stack([first, second, np.cross(first, second)])

    def bounds(self) -> Bounds:
        reach = np.sqrt(np.sum((self._axes() * np.asarray(self.radii)[:, None]) ** 2, axis=0))
        return np.asarray(self.centre) - reach, np.asarray(self.centre) + reach

    def distance(self, x: np.ndarray, y: np.ndarray, z: np.ndarray, edge: float) -> np.ndarray:
        """Return ``f / |grad f|`` of ``f = k (k - 1)``: exact distance for a sphere."""
        x, y, z = (c - np.float32(s) for c, s in zip((x, y, z), self.centre, strict=True))
        level, slope = np.float32(0), np.float32(1e-12)
        for axis, radius in zip(self._axes(), self.radii, strict=True):
            squared = _along(axis / radius, x, y, z) ** 2
            level = level + squared
            slope = slope + squared / np.float32(radius**2)
        level = np.sqrt(level)
        return level * (level - 1) / np.sqrt(slope)


@dataclass(frozen=True)
class Drum:
    """An upright elliptic cylinder with a waist, as a vertebral body; ``axis`` points upwards."""

    centre: np.ndarray
    radii: tuple[float, float]
    half_height: float
    axis: np.ndarray
    waist: float = 0.0

    def bounds(self) -> Bounds:
        reach = np.hypot(max(self.radii), self.half_height)
        return self.centre - reach, self.centre + reach

    def distance(self, x: np.ndarray, y: np.ndarray, z: np.ndarray, edge: float) -> np.ndarray:
        x, y, z = (c - np.float32(s) for c, s in zip((x, y, z), self.centre, strict=True))
        up = _unit(self.axis)
        height = _along(up, x, y, z)
        depth = _along(np.cross(up, [1.0, 0.0, 0.0]), x, y, z)
        level = np.sqrt((x / self.radii[0]) ** 2 + (depth / self.radii[1]) ** 2)
        narrowing = 1 - self.waist * (1 - np.minimum((height / self.half_height) ** 2, 1))
        return np.maximum(
            (level - narrowing) * np.float32(min(self.radii)), np.abs(height) - self.half_height
        )


@dataclass(frozen=True)
class Trunk:
    """A body with superelliptic cross-sections ``|x/a|^n + |y/b|^n = 1`` that vary with z.

    ``profile`` has rows ``(z, half width, y of the widest place, y of the front, y of the back)``;
    front and back have separate half depths. Outside the table its first and last row are used.
    """

    profile: np.ndarray
    exponent: float = 2.5
    _curves: Curve = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rows = np.asarray(self.profile, dtype=np.float64)
        object.__setattr__(self, "_curves", monotone(rows[:, 0], rows[:, 1:]))

    def inset(self, thickness: float) -> Trunk:
        """Return the trunk within this one, ``thickness`` mm below its sides."""
        rows = np.array(self.profile, dtype=np.float64)
        rows[:, [1, 4]] -= thickness
        rows[:, 3] += thickness
        return Trunk(rows, self.exponent)

    def bounds(self) -> Bounds:
        """Return the corners of a box around all sections; its height is that of the table."""
        rows = np.asarray(self.profile, dtype=np.float64)
        width = rows[:, 1].max()
        lower = np.array([-width, rows[:, 3].min(), rows[0, 0]])
        return lower, np.array([width, rows[:, 4].max(), rows[-1, 0]])

    def section(self, z: np.ndarray) -> np.ndarray:
        """Return half width and y of widest place, front and back at ``z``, (..., 4) in mm."""
        ends = np.asarray(self.profile)[[0, -1], 0]
        return self._curves(np.clip(z, *ends))

    def on_surface(self, angle: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return points (n, 3) at ``angle`` (0: back, pi/2: +x, pi: front) and height ``z``."""
        width, centre, front, back = np.moveaxis(self.section(z), -1, 0)
        sine, cosine = np.sin(angle), np.cos(angle)
        power = 2 / self.exponent
        depth = np.where(cosine > 0, back - centre, centre - front)
        x = width * np.sign(sine) * np.abs(sine) ** power
        y = centre + depth * np.sign(cosine) * np.abs(cosine) ** power
        return np.stack([x, y, z], axis=-1)

    def distance(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return ``(f - 1) / |grad f|`` with ``f = (|x/a|^n + |y/b|^n)^(1/n)``.

        All but the last lines work on one (z, x) or (z, y) plane when given an open grid.
        """
        n = self.exponent
        width, centre, front, back = np.moveaxis(self.section(z).astype(np.float32), -1, 0)
        width_slope, _, front_slope, back_slope = np.moveaxis(self._slope(z), -1, 0)
        y = y - centre
        depth = np.where(y > 0, back - centre, centre - front)
        depth_slope = np.where(y > 0, back_slope, -front_slope)
        u, v = np.abs(x) / width, np.abs(y) / depth
        sideways, forwards = u ** (n - 1) / width, v ** (n - 1) / depth
        upwards = sideways * u * width_slope + forwards * v * depth_slope
        power = np.maximum(u**n + v**n, np.float32(1e-6))
        level = power ** np.float32(1 / n)
        slope = np.sqrt(sideways**2 + forwards**2 + upwards**2)
        return (level - 1) * power / (level * np.maximum(slope, np.float32(1e-9)))

    def _slope(self, z: np.ndarray) -> np.ndarray:
        low, high = np.asarray(self.profile)[[0, -1], 0]
        within = ((z >= low) & (z <= high))[..., None]
        return np.where(within, self._curves.slope(np.clip(z, low, high)), 0).astype(np.float32)
