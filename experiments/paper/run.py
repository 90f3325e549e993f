"""``make paper``: all experiments of the paper, and one page with their results.

    python -m experiments.paper.run [--full] [--force]

Computes missing results and writes the self-contained output/paper/paper.html.
"""

from __future__ import annotations

import time
from importlib import import_module

from experiments.paper.figure4.run import VOLUMES
from experiments.support import methods
from experiments.support.analysis import NOISE
from experiments.support.options import Options, parse
from experiments.support.recording import Session
from experiments.support.scenes import SOURCES, available
from experiments.support.store import read_json
from mitsuba_irrcache.compare.report import write_report
from mitsuba_irrcache.compare.results import Measurement
from mitsuba_irrcache.machine import doctor
from mitsuba_irrcache.machine.versions import installed_version

#: In the order of the page. Estimated minutes at the quick size on two idle cores: figure 2 takes
#: 10 (a reference, and five methods on the chest, which figures 1 and 3 and table 1 only read),
#: figure 4 takes 7 (two more references, six runs), memory 2, quadrature 2, resolution 3, fading 2.
EXPERIMENTS = (
    "figure1", "figure2", "figure3", "figure4", "table1",
    "memory", "quadrature", "resolution", "fading",
)  # fmt: skip
#: The others read its recorded runs: computed first, so that ``--force`` renews them once.
RECORDED_BY = "figure2"


def run(options: Options) -> None:
    """Run and plot all experiments and write the page."""
    folder = options.folder("paper")
    spent = {}
    for name in sorted(EXPERIMENTS, key=lambda name: name != RECORDED_BY):
        started = time.perf_counter()
        print(f"== {name}", flush=True)
        import_module(f"experiments.paper.{name}.run").run(options)
        spent[name] = time.perf_counter() - started
    sections = [
        import_module(f"experiments.paper.{name}.plot").plot(options) for name in EXPERIMENTS
    ]
    page = folder / "paper.html"
    title = "Irradiance caching for volumetric data: the paper's experiments"
    write_report(page, title, findings(options), sections, failures(options), facts(options, spent))
    print(f"\npage           {page}")


def findings(options: Options) -> list[str]:
    """Return the conclusions as sentences."""
    table = read_json(options.folder("table1") / "results.json")
    said = []
    for label, row in table["converged"].items():
        if row["speed_up"] and row["paper_seconds"] and label != methods.PATH_TRACING.label:
            bound = "at least " if row["how"] == "at most" else ""
            said.append(
                f"By the paper's criterion “{label}” converges {bound}{row['speed_up']:.2f} times "
                f"sooner than path tracing; the paper has {row['paper_speed_up']:.2f}."
            )
    rows = read_json(options.folder("fading") / "results.json")["chest"]["rows"]
    worse, far = sum(row["worse"] for row in rows), sum(not row["close"] for row in rows)
    said.append(
        f"At {worse} of {len(rows)} numbers of samples the fading filter is worse than none beyond "
        f"{NOISE:g} standard errors, and at {far} more than 10 % above the better of none and "
        "fixed strength."
    )
    return said


def failures(options: Options) -> list[Measurement]:
    """Return the recorded runs that failed."""
    recorded = {volume: methods.PAPER for volume in VOLUMES} | {"chest": methods.ALL}
    return [m for v, own in recorded.items() for m in Session.of(v, options, own).failed]


def facts(options: Options, spent: dict[str, float]) -> dict[str, str]:
    """Return what was run, on what, and how long it took."""
    system, size = doctor.examine_system(), options.size
    volumes = (SOURCES[available(name)].about for name in VOLUMES)
    return {
        "image": f"{size.pixels} × {size.pixels} pixels",
        "volumes": f"{', '.join(volumes)}; {size.longest} voxels along the longest side",
        "light": "single scattering, a white sky of radiance 1 that is seen, half the extinction "
        "of the presets",
        "horizon": f"{size.horizon:g} s on the chest, {size.others:g} s on the others",
        "software": f"Mitsuba {installed_version('mitsuba')}, Dr.Jit {installed_version('drjit')}",
        "machine": f"{system['processor']}, {system['cores']} cores",
        "seconds of this run": ", ".join(f"{name} {s:.0f}" for name, s in spent.items()),
        "date": time.strftime("%Y-%m-%d %H:%M"),
    }


if __name__ == "__main__":
    run(parse(__doc__))
