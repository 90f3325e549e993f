"""Irradiance caching for participating media in Mitsuba 3.

Importing this package, before or after ``mitsuba.set_variant``, makes ``<integrator
type="irrcache"/>`` available in every variant set from then on.
"""

from __future__ import annotations

import gc

# What imports make stays. To look for garbage in it takes a tenth of a second.
_collects = gc.isenabled()
gc.disable()
try:
    from . import runtime

    runtime.prepare_llvm()  # before Dr.Jit is imported for the first time

    from . import _register  # noqa: F401
    from .cache import IrradianceCache
    from .errors import CacheFileError, IrrcacheError, UnsupportedSceneError
    from .progressive import render_progressive
finally:
    if _collects:
        gc.enable()

__version__ = "0.1.0"

__all__ = [
    "CacheFileError",
    "IrradianceCache",
    "IrrcacheError",
    "UnsupportedSceneError",
    "__version__",
    "render_progressive",
]
