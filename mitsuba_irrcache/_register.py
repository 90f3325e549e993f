"""Registers the plugins for every variant that is set, before or after this package is imported.

A plugin's class derives from a base class of one variant, so its file is executed anew for each.
Mitsuba 3.10 finds this module by the entry point group ``mitsuba`` and reloads it; on 3.9 a
callback does the same.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from functools import wraps

import mitsuba as mi
import mitsuba.python.util

from .errors import explained

PLUGINS = ("mitsuba_irrcache.integrators.irrcache",)


def register() -> None:
    """Executes the plugin files for the variant that is set now; without one, nothing happens."""
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
    """``mi.render`` with errors that say what went wrong.

    It calls integrators by way of ``dr.custom``, which replaces the message of what they raise by
    "error while performing a custom differentiable operation (see above)".
    """

    @wraps(render)
    def explaining(*args: object, **kwargs: object) -> object:
        try:
            return render(*args, **kwargs)
        except RuntimeError as error:
            explained(error)
            raise

    return explaining


register()
if "_listening" not in globals():  # a reload keeps the globals, and the one callback
    mi.detail.add_variant_callback(_variant_changed)
    mi.render = mitsuba.python.util.render = _with_causes(mitsuba.python.util.render)
    _listening = True
