"""Registers the plugins for every variant that is set, before or after this package is imported.

A plugin's class derives from a base class of one variant, so its file is executed anew for each.
Mitsuba 3.10 finds this module by the entry point group ``mitsuba`` and reloads it; on 3.9 a
callback does the same.
"""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

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


register()
if "_listening" not in globals():  # a reload keeps the globals, and the one callback
    mi.detail.add_variant_callback(_variant_changed)
    _listening = True
