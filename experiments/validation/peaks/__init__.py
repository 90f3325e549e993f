"""Errors of media with a sharp forward peak, towards narrow sources and in shadows."""
