"""Arithmetic, properties of plugins and other things that know nothing of rendering."""
