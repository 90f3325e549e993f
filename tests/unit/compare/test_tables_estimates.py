"""The table of errors that integrators estimate themselves."""

from __future__ import annotations

from mitsuba_irrcache.compare.tables import estimates_table

TRUE = {"seconds": 2.0, "rmse": 0.004, "rmse_resolved": 0.001}


def test_estimates_are_beside_true_errors():
    rows = [
        TRUE | {"integrator": "a", "estimate": 0.005},
        TRUE | {"integrator": "volpath", "estimate": None},
        TRUE | {"integrator": "b", "estimate": 0.02, "rmse": 0.0},
    ]
    (table,) = estimates_table(rows)
    assert table.rows == [["a", "2 s", "0.5 %", "0.4 %"], ["b", "2 s", "2 %", "< 0.1 %"]]
    assert not estimates_table(rows[1:2])
