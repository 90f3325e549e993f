"""Comparing integrators: metrics that a noisy reference does not distort, and references kept on
disk.
"""
