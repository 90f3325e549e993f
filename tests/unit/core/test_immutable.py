"""Objects that do not change after construction, and that Dr.Jit leaves alone."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_irrcache.core.immutable import Immutable
from mitsuba_irrcache.core.jit import symbolic

pytestmark = pytest.mark.usefixtures("rgb")


class Base(Immutable):
    def __init__(self, scale) -> None:
        self.scale = scale


class Derived(Base):
    def __init__(self, scale, offset) -> None:
        super().__init__(scale)
        self.offset = offset


@pytest.mark.parametrize("made", [Base(1), Derived(1, 2)], ids=["base", "derived"])
def test_attributes_can_be_set_by_constructors_only(made):
    for name in ("scale", "another"):
        with pytest.raises(AttributeError, match=name):
            setattr(made, name, 3)
    with pytest.raises(AttributeError, match="scale"):
        del made.scale
    assert made.scale == 1


def test_symbolic_loops_read_them():
    """A frozen dataclass fails here: Dr.Jit makes its fields state of the loop."""

    @symbolic
    def total(made, count):
        i, result = mi.UInt32(0), mi.Float(0)
        while i < count:
            result += made.scale * mi.Float(i)
            i += 1
        return result

    made = Derived(dr.opaque(mi.Float, 2.0), 0)
    assert total(made, dr.opaque(mi.UInt32, 4))[0] == 12
