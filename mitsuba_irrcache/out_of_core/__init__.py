"""Volumes larger than memory: swept and ray marched slab by slab, from and to files."""
