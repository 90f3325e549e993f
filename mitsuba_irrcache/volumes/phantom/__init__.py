"""Procedural phantoms for use without data: a chest CT and a cloud."""

from __future__ import annotations

from mitsuba_irrcache.volumes.phantom.cloud import cloud
from mitsuba_irrcache.volumes.phantom.thorax import thorax

__all__ = ["cloud", "thorax"]
