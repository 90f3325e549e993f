"""Participating media on grids: extinction, albedo, phase function, delta-M, emission."""
