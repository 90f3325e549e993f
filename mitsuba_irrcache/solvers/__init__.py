"""Solvers, which compute the values of caches.

Importing a module registers its solver; ``auto`` tries them in the order of their ``precedence``.
"""

from mitsuba_irrcache.solvers import sweep
from mitsuba_irrcache.solvers.path import solver as path

__all__ = ["path", "sweep"]
