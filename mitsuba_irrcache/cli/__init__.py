"""The command ``irrcache``."""

from mitsuba_irrcache.cli.main import command

__all__ = ["command"]
