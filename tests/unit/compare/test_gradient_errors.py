"""Errors of gradients against a reference of two halves, and their table."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.validation.gradients.cases import Case
from mitsuba_irrcache.compare.gradients import errors, main
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.mitsuba_vol import write_vol
from tests.support.scene_xml import FOG_IN_A_BOX

SCENE = """<scene version="3.0.0">
    <default name="density" value="density.vol"/>
    <integrator type="volpath"/>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="1, 2, 5" target="0,0,0" up="0,1,0"/> </transform>
        <film type="hdrfilm"> <integer name="width" value="12"/> <integer name="height" value="12"/>
            <rfilter type="box"/> </film>
    </sensor>
    FOG
    <emitter type="constant"/>
</scene>
""".replace("FOG", FOG_IN_A_BOX)


def test_noise_of_the_reference_is_no_error():
    """Neither voxel by voxel nor over blocks, where a pattern of mean 0 is none."""
    rng = np.random.default_rng(1)
    truth = 1 + rng.random((16, 16, 16, 1))
    a, b = (truth + 0.3 * rng.standard_normal(truth.shape) for _ in range(2))
    scale = np.sqrt(np.mean(truth**2))
    signs = np.indices(truth.shape).sum(axis=0) % 2 * 2 - 1
    wrong = errors(truth + 0.2 * signs, a, b, 1.0)
    assert wrong.error == pytest.approx(0.2 / scale, rel=0.05)
    assert abs(wrong.error - 0.2 / scale) < 4 * wrong.uncertainty
    assert abs(wrong.blocks) < 0.03
    biased = errors(1.1 * truth, a, b, 1.0)
    assert biased.error == pytest.approx(0.1, rel=0.1)
    assert biased.blocks == pytest.approx(0.1, rel=0.1)
    assert np.isnan(errors(truth[0, 0, 0], *2 * [truth[0, 0, 0]], 1.0).blocks)


def test_a_reference_of_noise_is_refused():
    noise = np.random.default_rng(1).standard_normal((8, 8, 8, 1))
    with pytest.raises(IrrcacheError, match="--reference-gradients"):
        errors(noise, noise, -noise, 1.0)


def test_integrators_are_compared_on_a_scene(rgb, tmp_path, monkeypatch, capsys):
    write_vol(tmp_path / "density.vol", Case(data=8, cache=8).sigma_t())
    (tmp_path / "scene.xml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    ours = "irrcache{solver=sweep,resolution=8,cache_spp=%d}"
    main([
        "scene.xml", "-i", ours % 64, "-i", "prbvolpath", "--reference", ours % 256,
        "--reference-gradients", "1", "--spp", "16", "--budget", "0.01",
    ])  # fmt: skip
    lines = [line for line in capsys.readouterr().out.splitlines() if "±" in line]
    mine, stock = (float(line.partition("±")[0].split()[-2]) for line in lines)
    assert abs(mine) < 20 < stock
