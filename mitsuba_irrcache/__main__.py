"""``python -m mitsuba_irrcache`` is the command ``irrcache``."""

from mitsuba_irrcache.cli import command

command()
