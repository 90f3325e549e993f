"""Table 1: seconds to convergence, by the paper's criterion and against an independent
reference.

    python -m experiments.paper.table1.run [--full]

Uses the recorded runs (`experiments.support.recording`), which are rendered if they do not exist.
The paper measures when a method's image differs from its own last one by an RMSE below 1e-2. That
cannot detect bias, so the time to equal error against an independent reference is given, too.
Writes output/table1/results.json.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.support import methods
from experiments.support.analysis import curve, errors, speed_up, time_to_converged
from experiments.support.options import Options, parse
from experiments.support.recording import Session
from mitsuba_irrcache.compare.results import write_json
from mitsuba_irrcache.compare.summary import Reached, time_to
from mitsuba_irrcache.io.scene_files import load_scene
from mitsuba_irrcache.pipeline.builder import CacheBuilder, CacheSettings

#: The paper's threshold.
LEVEL = 1e-2
#: Target errors against the reference.
LEVELS = (5e-2, 2e-2, 1e-2, 5e-3, 2e-3)


def run(options: Options) -> None:
    """Compute the times of all methods, and their ratios to path tracing."""
    chest = Session.of("chest", options, methods.ALL)
    found = {r.method: errors(r, chest.truth) for r in chest.recordings}
    results = {
        "horizon": options.size.horizon,
        "pixels": options.size.pixels**2,
        "voxels": cache_voxels(chest.subject.scene, chest.subject.parameters),
        "level": LEVEL,
        "converged": compared({m: time_to_converged(e, LEVEL) for m, e in found.items()}),
        "equal_error": {
            f"{level:g}": compared(
                {m: time_to(curve(m.label, e, "display"), level) for m, e in found.items()}
            )
            for level in LEVELS
        },
    }
    write_json(options.folder("table1") / "results.json", results)


def compared(times: dict[methods.Method, Reached]) -> dict[str, dict]:
    """Return rows by label: seconds, how they were found, speed-up over path tracing, and the
    paper's.
    """
    stock, paper = times[methods.PATH_TRACING], methods.PATH_TRACING.paper
    return {
        method.label: {k: v for k, v in asdict(reached).items() if v != np.inf}
        | {
            "speed_up": speed_up(stock, reached),
            "paper_seconds": method.paper,
            "paper_speed_up": paper / method.paper if method.paper else None,
        }
        for method, reached in times.items()
    }


def cache_voxels(scene_file: Path, parameters: dict[str, str]) -> dict[str, int]:
    """Return the number of cache voxels, and that of active ones."""
    builder = CacheBuilder(CacheSettings(max_depth=2, samples=8))
    scene: mi.Scene = load_scene(scene_file, parameters)
    builder.update(scene)
    return {"all": builder.cache.grid.voxel_count, "active": builder.cache.active_count}


if __name__ == "__main__":
    run(parse(__doc__))
