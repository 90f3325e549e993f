"""``python -m mitsuba_irrcache`` is the command ``irrcache``."""

from .cli import command

command()
