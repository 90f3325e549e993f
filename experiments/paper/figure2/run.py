"""Figure 2: error against time, for the paper's methods and two controls.

    python -m experiments.paper.figure2.run [--full] [--force]

Records the runs on the chest that figures 1 to 4 and table 1 share (`--force`: anew), and writes
their errors to output/figure2/results.json.
"""

from __future__ import annotations

from experiments.support import methods
from experiments.support.analysis import errors
from experiments.support.options import Options, parse
from experiments.support.recording import Session
from mitsuba_irrcache.compare.results import write_json


def run(options: Options) -> None:
    """Compute the errors of every snapshot of every method."""
    chest = Session.of("chest", options, methods.ALL, options.force)
    curves = {r.method.label: errors(r, chest.truth) for r in chest.recordings}
    write_json(options.folder("figure2") / "results.json", curves)


if __name__ == "__main__":
    run(parse(__doc__))
