"""``python -m mitsuba_irrcache`` is the command ``irrcache``."""

import sys

from .cli import main

sys.exit(main())
