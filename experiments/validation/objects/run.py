"""Errors of surfaces that reach into a medium, with both solvers.

    python -m experiments.validation.objects.run [--only TEXT] [--seconds S] [--force] [-o output]
        [--document FILE]

Every case of `cases` is rendered at default settings and with the solver ``path``, and compared
with volpath as in `experiments.validation.lamps.run`, whose columns the table has.

Rows and references are saved in output/objects; ``--force`` discards the rows. No data are needed.
"""

from __future__ import annotations

from experiments.validation.lamps.run import tabulate
from experiments.validation.objects.cases import CASES, build

#: Settings of the renderings that are compared.
SETTINGS = {"defaults": {}, "path": {"solver": "path"}}


if __name__ == "__main__":
    tabulate(__doc__, "objects", CASES, build, SETTINGS)
