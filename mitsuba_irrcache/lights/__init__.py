"""Emitters: which kinds there are, and the inverse-square law near small ones."""
