"""Register the plugins in every Mitsuba variant.

A plugin derives from a base class that differs between variants, so its file is executed once for
each variant. Mitsuba 3.10 imports and reloads this module through the entry point group
``mitsuba``; for Mitsuba 3.9 a variant callback does the same.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable
from functools import wraps

import drjit as dr
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


def _wrapped(render: Callable) -> Callable:
    """Wrap ``mi.render`` so that its exceptions state the original cause.

    Images through which derivatives are propagated share one adjoint solve (`_shared`).

    ``mi.render`` calls integrators through ``dr.custom``, which replaces the message of any
    exception by "error while performing a custom differentiable operation (see above)".
    """
    signature = inspect.signature(render)

    @wraps(render)
    def render_with_cause(*args: object, **kwargs: object) -> object:
        try:
            shared = _shared(signature.bind(*args, **kwargs).arguments)
            return render(*args, **kwargs) if shared is None else shared()
        except RuntimeError as error:
            add_cause(error)
            raise

    return render_with_cause


def _shared(arguments: dict) -> Callable | None:
    """Return a function that renders by ``render_shared`` of our integrator.

    None if these ``arguments`` of ``mi.render`` are for another integrator, or if no parameter
    carries gradients.
    """
    params = arguments.get("params")
    if not isinstance(params, mi.SceneParameters):
        return None
    integrator = arguments.pop("integrator", None) or arguments["scene"].integrator()
    seeds = arguments.get("seed", 0), arguments.get("seed_grad", 0)
    if not hasattr(integrator, "render_shared") or (seeds[1] and seeds[0] == seeds[1]):
        return None
    if not any(map(dr.grad_enabled, dict(params).values())):
        return None
    return lambda: integrator.render_shared(**arguments)


register()
if (
    "_listening" not in globals()
):  # reloading a module keeps its globals: register the callback only once
    mi.detail.add_variant_callback(_variant_changed)
    mi.render = mitsuba.python.util.render = _wrapped(mitsuba.python.util.render)
    _listening = True
