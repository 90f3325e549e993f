"""Crop boxes, time steps, and the colours and resolution of comparisons."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("viser")

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.appearance import WHOLE, Appearance, cropped
from mitsuba_irrcache.view.comparison import _finest, false_colours, rounded
from mitsuba_irrcache.view.crop_panel import checked_box
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.options import MissingItemError, picked
from mitsuba_irrcache.volumes.transfer import load_preset


def test_crop_boxes_keep_whole_voxels():
    """Voxels that the box touches are kept; the axes are x, y, z for arrays (z, y, x)."""
    values = np.ones((4, 5, 10), np.float32)
    assert cropped(values, WHOLE) is values
    found = cropped(values, ((0.0, 0.25), (0.5, 1.0), (0.3, 0.7)))
    z, y, x = (np.unique(axis) for axis in np.nonzero(found))
    assert (z.tolist(), y.tolist(), x.tolist()) == ([1, 2], [2, 3, 4], [0, 1, 2])
    for wrong in (((0, 100),) * 2, ((50, 20),) * 3, ((0, 101),) * 3, ((0, 50, 100),) * 3):
        with pytest.raises(IrrcacheError):
            checked_box(wrong)


def test_empty_boxes_are_refused():
    """A box without matter is refused, naming the box."""
    values = np.full((4, 4, 4), -1000, np.int16)
    values[:, :, 3] = 1000
    appearance = Appearance(VolumeData(values, unit="HU"), load_preset("ct-bone"), "ct-bone")
    assert appearance.grids(appearance.mapping)
    appearance.box = ((0.0, 0.5), (0.0, 1.0), (0.0, 1.0))
    with pytest.raises(IrrcacheError, match="crop box"):
        appearance.grids(appearance.mapping)


def test_missing_time_steps_tell_how_many_there_are():
    with pytest.raises(MissingItemError, match="give 0 to 4") as caught:
        picked("a.tif", "frame", 5, 1 << 30)
    assert caught.value.count == 5


def test_errors_have_colours_and_round_limits():
    """Too dark is blue and too bright is red; limits are 1, 2 or 5 times a power of ten."""
    dark, none, bright = false_colours(np.array([-3.0, 0.0, 3.0]))
    assert dark[2] > 2 * dark[0] and bright[0] > 2 * bright[2] and np.ptp(none) == 0
    assert [rounded(v) for v in (0, 0.011, 0.02, 0.3, 0.7, 12)] == pytest.approx(
        [0.001, 0.02, 0.02, 0.5, 1, 20]
    )


def test_references_are_as_fine_as_time_allows():
    """A pass of 4 x 4 pixels that took this long is followed by passes of at most 3 s."""
    assert [_finest(seconds, 4) for seconds in (0.1, 0.5, 2.0, 60.0)] == [1, 2, 4, 4]
