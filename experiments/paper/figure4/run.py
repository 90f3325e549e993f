"""Figure 4: three volumes, three methods.

    python -m experiments.paper.figure4.run [--full] [--force]

Records head and abdomen (`--force`: anew), takes the chest from its recorded runs, and writes
output/figure4/results.json.
"""

from __future__ import annotations

from experiments.support import methods
from experiments.support.options import Options, parse
from experiments.support.recording import Session
from experiments.support.scenes import SOURCES, available
from mitsuba_irrcache.compare.results import write_json

VOLUMES = ("head", "chest", "abdomen")


def run(options: Options) -> None:
    """Select the images of all methods after the same time."""
    rows = []
    for volume in VOLUMES:
        force = options.force and volume != "chest"
        session = Session.of(volume, options, methods.PAPER, force)
        rows.append(
            {
                "volume": volume,
                "about": SOURCES[available(volume)].about,
                "reference": str(session.picture),
                "methods": [session.picked(r, options.size.others) for r in session.recordings],
            }
        )
    results = {"seconds": options.size.others, "rows": rows}
    write_json(options.folder("figure4") / "results.json", results)


if __name__ == "__main__":
    run(parse(__doc__))
