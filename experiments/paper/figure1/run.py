"""Figure 1: images of all methods after the same time, and the reference.

    python -m experiments.paper.figure1.run [--full] [--force]

Takes the images from the recorded runs (`experiments.support.recording`), which are rendered if
they do not exist, and writes output/figure1/results.json.
"""

from __future__ import annotations

from experiments.support import methods
from experiments.support.options import Options, parse
from experiments.support.recording import Session
from mitsuba_irrcache.compare.results import write_json

#: The paper shows 100 of 300 seconds.
SHARE = 1 / 3


def run(options: Options) -> None:
    """Select the images and compute their errors."""
    chest = Session.of("chest", options, methods.PAPER)
    seconds = SHARE * options.size.horizon
    results = {
        "seconds": seconds,
        "reference": str(chest.picture),
        "methods": [chest.picked(recording, seconds) for recording in chest.recordings],
    }
    write_json(options.folder("figure1") / "results.json", results)


if __name__ == "__main__":
    run(parse(__doc__))
