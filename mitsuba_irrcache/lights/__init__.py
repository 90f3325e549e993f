"""Emitters: their classification, and the inverse-square factor of nearby small ones."""
