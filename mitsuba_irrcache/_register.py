"""Register the plugins in every Mitsuba variant.

A plugin derives from a base class that differs between variants, so its file is executed once for
each variant. Mitsuba 3.10 imports and reloads this module through the entry point group
``mitsuba``; for Mitsuba 3.9 a variant callback does the same.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from functools import wraps

import mitsuba as mi
import mitsuba.python.util

from .errors import add_cause

PLUGINS = ("mitsuba_irrcache.integrators.irrcache",)


def register() -> None:
    """Execute the plugin files for the current variant; do nothing if no variant is set."""
    if mi.variant() is None:
        return
    for name in PLUGINS:
        if name in sys.modules:
            importlib.reload(sys.modules[name])
        else:
            importlib.import_module(name)


def _variant_changed(old: str | None, new: str) -> None:
    register()


def _with_causes(render: Callable) -> Callable:
    """Wrap ``mi.render`` so that its exceptions state the original cause.

    ``mi.render`` calls integrators through ``dr.custom``, which replaces the message of any
    exception by "error while performing a custom differentiable operation (see above)".
    """

    @wraps(render)
    def render_with_cause(*args: object, **kwargs: object) -> object:
        try:
            return render(*args, **kwargs)
        except RuntimeError as error:
            add_cause(error)
            raise

    return render_with_cause


register()
if (
    "_listening" not in globals()
):  # reloading a module keeps its globals: register the callback only once
    mi.detail.add_variant_callback(_variant_changed)
    mi.render = mitsuba.python.util.render = _with_causes(mitsuba.python.util.render)
    _listening = True
