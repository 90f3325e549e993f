"""Kinds of emitters, narrow sources, solid angles, inverse-square factors of emitters nearby."""
