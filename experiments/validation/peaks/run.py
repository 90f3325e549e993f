"""Errors of media with a sharp forward peak, towards narrow sources and in shadows.

    python -m experiments.validation.peaks.run [--only TEXT] [--seconds S] [--force] [-o output]
        [--document FILE]

Every case of `cases` is rendered at default settings, and compared with volpath as in
`experiments.validation.lamps.run`, whose columns the table has.

Rows and references are saved in output/peaks; ``--force`` discards the rows. No data are needed.
"""

from __future__ import annotations

from experiments.validation.lamps.run import tabulate
from experiments.validation.peaks.cases import CASES, build

if __name__ == "__main__":
    tabulate(__doc__, "peaks", CASES, build, {"defaults": {}})
