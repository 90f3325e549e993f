"""Figure 3: a detail of the chest as each method converges.

    python -m experiments.paper.figure3.run [--full]

Takes the images from the recorded runs (`experiments.support.recording`), which are rendered if
they do not exist, and writes output/figure3/results.json.
"""

from __future__ import annotations

from experiments.support import methods
from experiments.support.options import Options, parse
from experiments.support.recording import Session, strip_times
from mitsuba_irrcache.compare.results import write_json


def run(options: Options) -> None:
    """Select the images of every method and time."""
    chest = Session.of("chest", options, methods.PAPER)
    wanted = strip_times(options.size.horizon)
    results = {
        "times": wanted,
        "reference": str(chest.picture),
        "methods": {
            recording.method.label: [chest.picked(recording, t) for t in wanted]
            for recording in chest.recordings
        },
    }
    write_json(options.folder("figure3") / "results.json", results)


if __name__ == "__main__":
    run(parse(__doc__))
