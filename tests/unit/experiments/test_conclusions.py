"""Conclusions of the experiments from measurements, on data with known results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.paper.figure2 import plot as figure2_plot
from experiments.paper.figure2 import run as figure2_run
from experiments.paper.table1 import plot as table1_plot
from experiments.paper.table1.run import compared
from experiments.robustness.mutation.run import ALL as MUTANTS
from experiments.robustness.mutation.run import PROJECT
from experiments.support import analysis, methods, scenes
from experiments.support.options import FULL, QUICK, Options, Size
from experiments.support.recording import LATE, STRIP, Recording, Session, display_error, times
from experiments.support.store import Store, read_json
from experiments.support.tiles import crop
from experiments.validation.others import run as others_run
from mitsuba_irrcache.compare.results import Measurement, Snapshot
from mitsuba_irrcache.compare.summary import Reached

RNG = np.random.default_rng(1)


def own_errors(seconds, errors):
    """Return the errors against the last image, as its own reference."""
    return {"seconds": list(seconds), "own": [*errors, 0.0]}


def test_time_to_converged_on_a_power_law():
    """0.1 / sqrt(t) is 0.01 at t = 100, wherever the snapshots are."""
    seconds = [3.0, 50.0, 130.0, 300.0]
    errors = own_errors(seconds, [0.1 / t**0.5 for t in seconds[:-1]])
    assert analysis.time_to_converged(errors, 0.01).seconds == pytest.approx(100)


@pytest.mark.parametrize("errors", [[], [0.1], [0.1, 0.07]])
def test_the_last_image_does_not_converge_to_itself(errors):
    """The last image's error of zero against itself does not count as convergence.

    Nothing is extrapolated from it.
    """
    seconds = [2.0 ** (k + 1) for k in range(len(errors) + 1)]
    reached = analysis.time_to_converged(own_errors(seconds, errors), 0.01)
    assert reached.how == "never"


def test_speed_up():
    stock, other = Reached(70.11, "measured"), Reached(20.38, "measured")
    assert analysis.speed_up(stock, other) == pytest.approx(3.44, abs=0.005)
    assert analysis.speed_up(stock, Reached(np.inf, "never")) is None
    assert analysis.speed_up(Reached(np.inf, "never"), other) is None
    assert analysis.speed_up(Reached(1.0, "at most"), other) is None  # not determined by these data


def test_the_paper_s_own_ratios_stand_beside_ours():
    rows = compared({m: Reached(m.paper, "measured") for m in methods.PAPER})
    assert [row["speed_up"] for row in rows.values()] == pytest.approx([1, 3.44, 5.12], abs=0.005)
    for row in rows.values():
        assert row["speed_up"] == pytest.approx(row["paper_speed_up"])


def images(noise_x: float, noise_y: float, bias: float = 0.0):
    """Return two images with noise, and two halves of a reference with more noise."""
    shape = (64, 64, 3)
    x, y, a, b = (RNG.normal(0, s, shape) for s in (noise_x, noise_y, 0.3, 0.3))
    return x + bias, y, a, b


def test_difference_of_squares_of_equal_errors_is_noise():
    found = [analysis.difference_of_squares(*images(0.1, 0.1)) for _ in range(200)]
    z = np.array([difference / error for difference, error in found])
    assert abs(z.mean()) < 4 / np.sqrt(len(z))
    assert z.std() == pytest.approx(1, rel=0.2)


def test_difference_of_squares_sees_bias():
    difference, error = analysis.difference_of_squares(*images(0.1, 0.1, bias=0.2))
    assert difference == pytest.approx(0.04, abs=4 * error)
    assert difference > analysis.NOISE * error


@pytest.mark.parametrize(
    ("errors", "difference", "worse", "close"),
    [
        ((1.0, 2.0, 1.09), 0.1, False, True),  # as good as none, within noise
        ((1.0, 2.0, 1.2), 4.0, True, False),  # worse than none: the filter should have faded out
        ((2.0, 1.0, 1.05), -4.0, False, True),  # as good as the fixed one
        ((2.0, 1.0, 1.5), -4.0, False, False),  # better than none, but the fixed one is far better
    ],
)
def test_verdict_on_fading(errors, difference, worse, close):
    verdict = analysis.judge(*errors, difference, uncertainty=1.0)
    assert (verdict.worse, verdict.close) == (worse, close)


def test_memory_is_split_into_components():
    """Memory is split into a base and bytes per voxel and per pixel, for realistic magnitudes."""
    rows = [
        {"voxels": n**3, "pixels": m**2, "bytes": 3e8 + 112 * n**3 + 40 * m**2}
        for n, m in ((48, 128), (96, 128), (144, 128), (48, 512), (48, 1024))
    ]
    assert analysis.fit_memory(rows) == pytest.approx((3e8, 112, 40), rel=1e-6)


def test_orders():
    steps = [2.0, 1.0, 0.5]
    assert analysis.orders(steps, [s**3 for s in steps]) == pytest.approx([3, 3])


@pytest.mark.parametrize("size", [QUICK, FULL])
def test_snapshots_are_dense_and_include_figure_3(size):
    found = np.array(times(size.horizon))
    assert found[-1] == size.horizon
    assert {t for t in STRIP if t <= size.horizon} <= set(found)
    assert (np.diff(found) > 0).all()
    assert (found[1:] / found[:-1]).max() < 1.5


def test_latest_snapshot_in_time():
    """A method has no image before its first one; a slightly late snapshot still counts."""
    snapshots = [Snapshot(t, {"image": t}, 1) for t in (5.0, 1.0)]
    recording = Recording(methods.CACHE, Measurement("irrcache", "x", snapshots), Path())
    assert recording.at(0.5) is None
    assert recording.at(1.01 / LATE).total == 1
    assert recording.at(4.0).total == 1
    assert recording.at(100.0).total == 5


def test_store_computes_once(tmp_path):
    path, calls = tmp_path / "results.json", []

    def compute():
        calls.append(1)
        return {"calls": len(calls)}

    for force in (False, False, True):
        Store(path, force).row("a", compute)
    assert read_json(path) == {"a": {"calls": 2}}


def test_crop_is_what_was_asked_for():
    image = np.arange(100 * 200).reshape(100, 200, 1)
    assert crop(image, (0.5, 0.5), 0.2).shape == (20, 20, 1)
    np.testing.assert_array_equal(crop(image, (0.5, 0.5), 0.2), image[40:60, 90:110])
    assert crop(image, (0.0, 1.0), 0.2).shape == (20, 20, 1)  # moved inside


def test_full_size_has_folders_of_its_own(tmp_path):
    assert Options(QUICK, tmp_path).folder("a") != Options(FULL, tmp_path).folder("a")


def test_phantoms_replace_missing_data(monkeypatch, tmp_path):
    monkeypatch.setattr(scenes, "DATA", tmp_path)
    for name in ("chest", "head", "abdomen"):
        assert scenes.SOURCES[scenes.available(name)].arguments[0] == "phantom"
    assert scenes.available("phantom") == "phantom"


def test_bounded_times_are_shown_as_bounds():
    """If the first image is good enough already, the speed-up is shown as a lower bound."""
    row = compared(
        {methods.PATH_TRACING: Reached(60.0, "measured"), methods.CACHE: Reached(5.0, "at most")}
    )
    table = table1_plot.equal_error({"converged": row, "equal_error": {"0.01": row}})
    assert table.rows == [["0.01", "60 s (1 ×)", "≤ 5 s (≥ 12 ×)"]]


def test_figure_from_scratch(rgb, monkeypatch, tmp_path):
    """Phantom, reference, recorded run, errors and figure work from scratch.

    The second time nothing is rendered.
    """
    monkeypatch.setattr(scenes, "DATA", tmp_path)
    monkeypatch.setattr(methods, "ALL", (methods.PATH_TRACING,))
    options = Options(Size(16, 16, 0.4, 0.4, 0.2), tmp_path)
    figure2_run.run(options)
    errors = read_json(tmp_path / "figure2" / "results.json")["path tracing"]
    assert errors["seconds"] == sorted(errors["seconds"])
    assert errors["own"][-1] == 0
    # How much errors decrease depends on the machine: these are the errors of the recorded images,
    # and far below those of a black image.
    session = Session.of("chest", options, methods.ALL)
    (recording,), black = session.recordings, np.zeros((16, 16, 3))
    shown = session.picked(recording, 1e3)
    assert shown["display"] == pytest.approx(errors["display"][-1])
    assert shown["display"] < 0.1 * display_error(black, session.truth)
    section = figure2_plot.plot(options)
    assert section.parts[0].path.stat().st_size > 0
    monkeypatch.setattr("experiments.support.recording.run_job", None)
    figure2_run.run(options)
    assert read_json(tmp_path / "figure2" / "results.json")["path tracing"] == errors


def test_the_z_test_of_others_references():
    """The Z-test of other references accepts the stated noise, and rejects a few standard
    errors.
    """
    target, variance = np.ones((48, 48, 3)), np.full((48, 48, 3), 0.25)
    image = target + RNG.normal(0, 0.5 / others_run.SUITE_SPP**0.5, target.shape)
    found = others_run.z_test(image, target, variance)
    assert found["z"] == pytest.approx(1, abs=0.05) and found["passed"] > 0.9975
    assert others_run.z_test(image + 0.4, target, variance)["passed"] < 0.5


def test_scenes_of_others_are_skipped_without_data(tmp_path, monkeypatch, capsys):
    absent = {name: others_run.of_the_suite(name, 6) for name in ("hetero", "homo")}
    monkeypatch.setattr(others_run, "SCENES", absent)
    others_run.run(Options(output=tmp_path))
    assert capsys.readouterr().out.count("skipped") == 2


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda m: m.name)
def test_mutants_fit_the_library(mutant):
    """Each mutant replaces text that occurs exactly once, and names existing tests."""
    text = (PROJECT / "mitsuba_irrcache" / mutant.file).read_text(encoding="utf-8")
    assert text.count(mutant.old) == 1 and mutant.new != mutant.old
    assert all((PROJECT / test).is_file() for test in mutant.tests)
