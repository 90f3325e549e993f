"""``python -m mitsuba_irrcache`` is the command ``irrcache``."""

import sys

from .cli import command

sys.exit(command())
