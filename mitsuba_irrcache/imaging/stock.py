"""Mitsuba's own integrators, for scenes without a visible medium, and where they are faster."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_irrcache.pipeline.defaults import choose_stock


class StockIntegrators:
    """Chooses, loads and keeps Mitsuba's integrators.

    ``properties``, such as ``max_depth``, are passed to all of them.
    """

    def __init__(self, **properties: object) -> None:
        self._properties = properties
        self._loaded: dict[str, mi.Integrator] = {}
        self._chosen = "volpath"

    def choose(self, scene: mi.Scene) -> str:
        """Choose the integrator for a scene; return the reason."""
        self._chosen, reason = choose_stock(scene)
        return reason

    @property
    def name(self) -> str:
        """Name of the integrator for the latest scene."""
        return self._chosen

    @property
    def chosen(self) -> mi.Integrator:
        """The integrator for the latest scene."""
        if self._chosen not in self._loaded:
            self._loaded[self._chosen] = mi.load_dict({"type": self._chosen} | self._properties)
        return self._loaded[self._chosen]

    def cancel(self) -> None:
        """Cancel the current rendering of all loaded integrators, in any thread."""
        for integrator in self._loaded.values():
            integrator.cancel()
