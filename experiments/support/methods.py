"""The methods of the paper, and two controls."""

from __future__ import annotations

from dataclasses import dataclass

from mitsuba_irrcache.io.scene_files import describe_integrator, parse_integrator


@dataclass(frozen=True)
class Method:
    """A method of the comparison.

    Attributes:
        name: for file names.
        label: for figures and tables.
        integrator: plugin with properties.
        paper: seconds to convergence in the paper's table 1, if given there.
    """

    name: str
    label: str
    integrator: str
    paper: float | None = None


#: Its best setting: Russian roulette off, as it costs more variance than it saves time.
STOCK = "volpath{rr_depth=1000}"

# The paper's names are SP-ES, MO and MO + BF.
PATH_TRACING = Method("path-tracing", "path tracing", STOCK, 70.11)
CACHE = Method("cache", "cache", "irrcache{solver=path}", 20.38)
FADING = Method("fading", "cache + filter", "irrcache{solver=path,filter=bilateral}", 13.70)
FIXED = Method("fixed", "cache + fixed filter", "irrcache{solver=path,filter=fixed}")
FILTERED = Method(
    "filtered-path-tracing", "path tracing + filter", "volpath{rr_depth=1000,filter=bilateral}"
)

PAPER = (PATH_TRACING, CACHE, FADING)
ALL = (*PAPER, FIXED, FILTERED)


def specify(integrator: str, **properties: object) -> str:
    """Return the specification ``name{key=value,...}`` with added or replaced properties."""
    name, given = parse_integrator(integrator)
    return describe_integrator(name, given | properties)
