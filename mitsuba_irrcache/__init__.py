"""Irradiance caching for participating media in Mitsuba 3.

Importing this package registers the plugin ``<integrator type="irrcache"/>`` in the current variant
and in every variant that ``mitsuba.set_variant`` selects later.
"""

from __future__ import annotations

from mitsuba_irrcache.machine import llvm

llvm.prepare_llvm()  # before Dr.Jit is imported for the first time

from mitsuba_irrcache.cache.volume import IrradianceCache  # noqa: E402
from mitsuba_irrcache.pipeline.progressive import render_progressive  # noqa: E402

from . import _register  # noqa: E402,F401
from .errors import CacheFileError, IrrcacheError, UnsupportedSceneError  # noqa: E402

__version__ = "0.1.0"  # pyproject.toml reads it

__all__ = [
    "CacheFileError",
    "IrradianceCache",
    "IrrcacheError",
    "UnsupportedSceneError",
    "__version__",
    "render_progressive",
]
