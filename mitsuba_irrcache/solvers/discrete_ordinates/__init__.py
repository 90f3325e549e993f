"""Discrete ordinates (S_N) along long characteristics, with source iteration."""
