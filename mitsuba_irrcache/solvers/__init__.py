"""Solvers that compute the cache."""
