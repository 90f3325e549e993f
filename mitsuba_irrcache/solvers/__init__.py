"""Solvers fill an ``IrradianceCache``; each may be run again to refine it."""
