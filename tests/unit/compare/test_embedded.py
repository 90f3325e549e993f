"""Images of the report: what is encoded comes back, and their number is limited by their size."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_irrcache.compare import embedded
from mitsuba_irrcache.compare.reference import Reference
from mitsuba_irrcache.compare.results import Measurement, Snapshot


@pytest.mark.parametrize("shape", [(5, 7, 3), (1, 1, 1), (3, 300, 1)])
def test_images_come_back_as_half_floats(shape):
    """All values come back as half floats, negative, infinite and undefined ones included."""
    image = np.random.default_rng(1).normal(0.5, 3.0, shape).astype(np.float32)
    image.flat[0] = np.nan
    image.flat[-1] = 1e6
    back = embedded.unpack(embedded.pack(image), shape)
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(back, image.astype(np.float16))


def test_images_beyond_the_limit_are_named(tmp_path, monkeypatch):
    """The images of the longest budget are kept; those that are left out are named."""
    image = np.random.default_rng(1).random((16, 16, 3)).astype(np.float32)
    monkeypatch.setattr(Snapshot, "read", lambda self, folder: image)
    shots = [Snapshot(budget, {"image": budget}, 4) for budget in (1.0, 3.0)]
    measured = [Measurement(name, name, shots) for name in ("a", "b<script>")]
    rows = [
        {"integrator": m.integrator, "budget": b, "rmse": 0.1} for m in measured for b in (1, 3)
    ]
    truth = Reference(image, image, 4, 1.0)
    monkeypatch.setattr(embedded, "MOST_BYTES", 3.5 * len(embedded.pack(image)))
    found = embedded.images(measured, rows, truth, tmp_path, 0.0)
    assert [i["label"] for i in found.data["images"]] == ["3 s", "3 s", "reference"]
    assert [text.split(",")[1] for text in found.left_out] == [" 1 s", " 1 s"]
    monkeypatch.setattr(embedded, "MOST_BYTES", 1 << 20)
    page = embedded.html(embedded.images(measured, rows, truth, tmp_path, 0.0))
    assert page.count("<script") == 1
