"""Participating media on grids: extinction, albedo, phase function, emission."""
