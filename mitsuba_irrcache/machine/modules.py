"""Python modules that register third-party plugins, as commands name them by ``--import``."""

from __future__ import annotations

import importlib
from collections.abc import Iterable

from mitsuba_irrcache.errors import IrrcacheError, original_message


def import_modules(modules: Iterable[str]) -> None:
    """Import modules by their names; raise IrrcacheError for one that cannot be imported."""
    for module in modules:
        if not all(part.isidentifier() for part in module.split(".")):
            raise IrrcacheError(
                f'--import is "{module}", which is no name of a module; write my_plugins for a '
                "file my_plugins.py whose folder is in PYTHONPATH."
            )
        try:
            importlib.import_module(module)
        except Exception as error:
            is_missing = isinstance(error, ModuleNotFoundError) and error.name
            if is_missing and f"{module}.".startswith(f"{error.name}."):
                raise IrrcacheError(
                    f'--import {module}: there is no module "{error.name}"; its folder has to be '
                    "in PYTHONPATH."
                ) from error
            raise IrrcacheError(
                f"--import {module}: {type(error).__name__}: "
                f"{original_message(error).rstrip('.')}; correct the module, or what it needs."
            ) from error
