"""Emitter plugins in Python of kinds that Mitsuba does not have."""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi


@cache
def register_beam(variant: str) -> str:
    """Register an infinitely distant emitter along -y whose irradiance varies across the beam, for
    the current ``variant``; return its name.

    The irradiance is 5 where x > 0.2, and 1 elsewhere.
    """

    class Beam(mi.Emitter):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            flags = mi.EmitterFlags
            self.m_flags = +flags.Infinite | +flags.DeltaDirection | +flags.SpatiallyVarying

        def sample_direction(self, it, sample, active=True):
            record = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
            record.d, record.dist, record.delta = mi.Vector3f(0, 1, 0), mi.Float(100), mi.Bool(True)
            record.p, record.n, record.pdf = it.p + 100 * record.d, -record.d, mi.Float(1)
            record.emitter = mi.EmitterPtr(self)
            return record, dr.select(active, mi.Spectrum(dr.select(it.p.x > 0.2, 5.0, 1.0)), 0)

        def eval_direction(self, it, ds, active=True):
            return mi.Spectrum(0)

        def pdf_direction(self, it, ds, active=True):
            return mi.Float(0)

        def eval(self, si, active=True):
            return mi.Spectrum(0)

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return "Beam[]"

    mi.register_emitter("test_beam", lambda props: Beam(props))
    return "test_beam"
