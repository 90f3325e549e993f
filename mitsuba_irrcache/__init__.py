"""Irradiance caching for participating media in Mitsuba 3.

Importing this package registers the plugin ``<integrator type="irrcache"/>`` in the current variant
and in every variant that ``mitsuba.set_variant`` selects later.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from mitsuba_irrcache.machine import llvm

llvm.prepare_llvm()  # before Dr.Jit is imported for the first time

from . import _register  # noqa: E402,F401
from .errors import CacheFileError, IrrcacheError, UnsupportedSceneError  # noqa: E402

if TYPE_CHECKING:
    from mitsuba_irrcache.cache.volume import IrradianceCache
    from mitsuba_irrcache.pipeline.progressive import render_progressive

#: The modules of these names are imported on use: without a variant, little else needs them.
_ON_USE = {
    "IrradianceCache": "mitsuba_irrcache.cache.volume",
    "render_progressive": "mitsuba_irrcache.pipeline.progressive",
}

__version__ = "0.1.0"  # pyproject.toml reads it

__all__ = [
    "CacheFileError",
    "IrradianceCache",
    "IrrcacheError",
    "UnsupportedSceneError",
    "__version__",
    "render_progressive",
]


def __getattr__(name: str) -> object:
    if name not in _ON_USE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_ON_USE[name]), name)
