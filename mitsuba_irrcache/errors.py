"""Errors that a user can act on: each names the thing, its value and the remedy."""

from __future__ import annotations


class IrrcacheError(ValueError):
    """Input that cannot be used, with the remedy in the message."""


class UnsupportedSceneError(IrrcacheError):
    """A scene contains something that ``irrcache`` would render wrongly; the object is named."""


class CacheFileError(IrrcacheError):
    """A cache file that is damaged, foreign, or belongs to another scene."""
