"""Fixture for tests that load whole scenes."""

from __future__ import annotations

import gc

import pytest


@pytest.fixture(autouse=True)
def _without_earlier_scenes():
    """Delete the objects of earlier scenes, whose methods would be compiled into every kernel."""
    gc.collect()
