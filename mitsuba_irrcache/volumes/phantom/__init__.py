"""Procedural phantoms: volumes in Hounsfield units for machines that have no scan at hand."""

from __future__ import annotations

from mitsuba_irrcache.volumes.phantom.thorax import thorax

__all__ = ["thorax"]
