"""Paths between surfaces, of which all segments are stored."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.gradients.paths import MarchedMedia, TracedPaths

pytestmark = pytest.mark.usefixtures("rgb")


def test_directions_to_environments_that_are_black_above_are_finite():
    """Mitsuba divides 0 by 0 for random numbers of 0, and derivatives were not finite."""
    texels = np.zeros((64, 128, 3), np.float32)
    texels[32:] = 0.3
    scene = mi.load_dict({"type": "scene", "sky": {"type": "envmap", "bitmap": mi.Bitmap(texels)}})
    origin, sample = dr.zeros(mi.Interaction3f, 1), mi.Point2f(0.3, 0)
    record, *_ = scene.sample_emitter_direction(origin, sample, False)
    assert not dr.all(dr.isfinite(record.d.x))
    paths = TracedPaths(scene, MarchedMedia([]))
    record, radiance, *_ = paths._emitter(origin, sample, mi.Bool(True))
    assert dr.all(dr.all(dr.isfinite(record.d)) & dr.all(dr.isfinite(radiance)))
