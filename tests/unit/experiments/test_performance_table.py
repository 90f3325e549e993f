"""The table of experiments/performance/error_against_time: best settings, defaults, volume
errors.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.performance.error_against_time import run
from experiments.support.store import Store

RIVALS = [
    {"integrator": "volpath{rr_depth=5}", "variance": 0.04, "seconds_per_sample": 1.0},
    {"integrator": "volpath{rr_depth=20}", "variance": 0.01, "seconds_per_sample": 2.0},
]
FAST = {"integrator": "irrcache{resolution=32}", "spp": 1, "at_most": 0.009, "cold": 0.1}
EXACT = {"integrator": "irrcache{resolution=96}", "spp": 4, "at_most": 0.003, "cold": 1.0}
DEFAULT = {"integrator": "irrcache{}", "spp": 64, "at_most": 0.002, "cold": 4.0}
POINTS = [point | {"moved": point["cold"] / 10} for point in (FAST, EXACT, DEFAULT)]


@pytest.fixture
def case(tmp_path) -> dict:
    """Write a case as run.py does; processes take a second longer than their work."""
    about = run.Case("cloud", -1, 64, "llvm_ad_mono", Path("scene.xml"), {})
    stock, own = Store(tmp_path / "stock.json"), Store(tmp_path / "irrcache.json")
    stock.rows[f"{about.key} process volpath{{rr_depth=20}} spp 1"] = {"seconds": 1.0}
    for point in POINTS:
        key = f"{about.key} process {point['integrator']} spp {point['spp']}"
        own.rows[key] = {"seconds": 1.0 + point["cold"]}
    reached = [run.reach(about, e, RIVALS, POINTS, stock, own) for e in (0.01, 0.004, 0.001)]
    default = run.reach(about, POINTS[-1]["at_most"], RIVALS, POINTS[-1:], stock, own)
    targets = [*reached, default | {"defaults": True}]
    return {"name": "cloud", "depth": -1, "mean": 0.8, "volume": 0.2, "targets": targets}


def columns(case: dict) -> dict[str, list[str]]:
    table = run.table([case])
    assert all(len(row) == len(table.head) for row in table.rows)
    return dict(zip(table.head, zip(*table.rows, strict=True), strict=True))


def test_the_fastest_setting_that_reaches_an_error_counts(case):
    found = columns(case)
    assert found["setting with a cold cache"] == (
        "irrcache{resolution=32} spp 1", "irrcache{resolution=96} spp 4", "—", "defaults",
    )  # fmt: skip
    assert set(found["stock"]) == {"volpath{rr_depth=20}"}


def test_defaults_have_a_row_of_their_own_error(case):
    """Default settings have a row with their own error.

    The stock integrator needs 0.02 / 0.002^2 = 5000 s to this error; ours takes 4 s.
    """
    found = columns(case)
    assert found["RMSE"][-1] == "0.002"
    assert found["s"][-1] == "5000"
    assert found["cold cache"][-1] == "4 s (1.25e+03 x)"
    assert found["camera moved"][-1] == "0.4 s (1.25e+04 x)"
    assert found["new process"][-1] == "5 s (1e+03 x)"


def test_errors_of_the_volume_alone(case):
    """Errors of the volume are relative to the scattered radiance.

    In an image of mean 0.8, 0.2 is scattered: they are four times those of the image.
    """
    assert columns(case)["of the volume"] == ("5 %", "2 %", "0.5 %", "1 %")
    assert run.of_the_volume(0.01, {"mean": 0.8, "volume": 0.0}) == "—"
    assert run.of_the_volume(0.01, {"mean": 0.8}) == "—"  # from results without it


def test_the_table_says_how_settings_were_chosen(case):
    assert "reference at hand" in run.table([case]).note
    assert "defaults" in run.table([case]).note
