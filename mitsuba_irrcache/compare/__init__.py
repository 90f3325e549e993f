"""Comparing integrators on one scene: error against time, with a reference whose noise drops out.

Integrators are known by plugin name only. Every integrator runs in a process of its own (`worker`),
which leaves images and times in the report's folder; the rest reads those.
"""
