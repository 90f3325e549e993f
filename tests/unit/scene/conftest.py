"""Fixtures for tests of descriptions of scenes."""

from __future__ import annotations

import mitsuba as mi
import pytest


@pytest.fixture
def logged(monkeypatch) -> list[str]:
    """Record what is logged."""
    texts: list[str] = []
    monkeypatch.setattr(mi, "Log", lambda _, text: texts.append(text))
    return texts
