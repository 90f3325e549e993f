"""Errors and times at default settings, in smooth light and in light with detail."""
