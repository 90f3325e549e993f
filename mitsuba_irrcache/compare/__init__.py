"""Comparison of integrators on one scene: error against time, net of the reference's noise.

Integrators are known by plugin name only. Each runs in a process of its own (`worker`), which
writes images and times to the report's folder; the other modules read them from there.
"""
