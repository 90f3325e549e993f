"""Names of the channels of images."""

from __future__ import annotations

import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.images import further_channels


def nested(*names: str) -> list[str]:
    """Return the names of integrators in Mitsuba's ``aov``."""
    return [f"{name}.{channel}" for name in names for channel in "RGBA"]


@pytest.mark.parametrize(
    ("count", "names", "expected"),
    [
        (3, [], []),
        (4, ["a"], ["a"]),
        (6, ["a.R", "a.G", "a.B"], ["a.R", "a.G", "a.B"]),
        # The names of one integrator in another are those of the film.
        (4, [*nested("i"), "d.T"], ["d.T"]),
        (5, [*nested("i"), "d.T"], ["d.T"]),
        (2, [*nested("i"), "d.T"], ["d.T"]),
        (7, [*nested("i", "j"), "d.T"], ["j.R", "j.G", "j.B", "d.T"]),
        (9, [*nested("i", "j"), "d.T"], [*nested("j"), "d.T"]),
        (5, [*nested("i"), "i.own", "d.T"], ["i.own", "d.T"]),
    ],
)
def test_channels_after_those_of_the_film(count, names, expected):
    assert further_channels(count, names) == expected


def test_channels_that_do_not_fit_are_named():
    with pytest.raises(IrrcacheError, match=r"2 channels, but names 3 .*\(a, b, c\)"):
        further_channels(2, ["a", "b", "c"])
