"""Crop boxes, time steps, and the colours and resolution of comparisons."""

from __future__ import annotations

import argparse

import numpy as np
import pytest

pytest.importorskip("viser")

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view import command
from mitsuba_irrcache.view.appearance import WHOLE, Appearance, coarse_appearance, cropped
from mitsuba_irrcache.view.comparison import (
    CHOICES,
    _finest,
    block_means,
    block_side,
    false_colours,
    rounded,
)
from mitsuba_irrcache.view.comparison import KINDS as COMPARISONS
from mitsuba_irrcache.view.crop_panel import checked_box
from mitsuba_irrcache.view.picture import CAPTIONS, KINDS
from mitsuba_irrcache.volumes.colours import Colours
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.options import MissingItemError, picked
from mitsuba_irrcache.volumes.scene import ALBEDO_FILE, EMISSION_FILE, SIGMA_T_FILE
from mitsuba_irrcache.volumes.transfer import DensityMapping, load_preset


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


@pytest.mark.parametrize("use", ["albedo", "emission", "extinction"])
def test_colours_of_a_file_are_those_of_the_medium(use):
    """The crop box cuts what is coloured, too."""
    rng = np.random.default_rng(0)
    density = rng.uniform(0.1, 1, (4, 5, 6)).astype(np.float32)
    rgb = rng.uniform(0.1, 1, (4, 5, 6, 3)).astype(np.float32)
    mapping = DensityMapping(2.0, (0.5, 0.6, 0.7))
    appearance = Appearance(VolumeData(density), mapping, colours=Colours(use, rgb))
    grids = appearance.grids(mapping)
    sigma_t = 2 * rgb if use == "extinction" else 2 * density
    albedo = rgb if use == "albedo" else np.broadcast_to(np.float32(mapping.albedo), rgb.shape)
    np.testing.assert_allclose(grids[SIGMA_T_FILE], sigma_t)
    np.testing.assert_allclose(grids[ALBEDO_FILE], albedo)
    assert (EMISSION_FILE in grids) == (use == "emission")
    appearance.box = ((0.0, 0.5), (0.0, 1.0), (0.0, 1.0))
    for name in {SIGMA_T_FILE, EMISSION_FILE} & set(grids):
        cut = appearance.grids(mapping)[name]
        np.testing.assert_array_equal(cut[:, :, :3], grids[name][:, :, :3])
        assert not cut[:, :, 3:].any()


def test_coarse_volumes_lie_where_the_whole_ones_do():
    """Voxels of a coarse volume are voxels of the whole one, at their places."""
    z, y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in (200, 60, 130)), indexing="ij")
    volume = VolumeData(
        1 + z * 1e-3, spacing=(1, 2, 3), origin=(5, 6, 7), direction=np.eye(3)[[1, 0, 2]]
    )
    colours = Colours("albedo", np.stack([x, y, z], axis=-1))
    coarse = coarse_appearance(volume, DensityMapping(), colours=colours)
    assert max(coarse.volume.size) < 80
    assert coarse.colours.values.shape == (*coarse.volume.values.shape, 3)
    for index in np.ndindex(2, 2, 2):
        place = coarse.volume.index_to_world @ [*index, 1]
        found = coarse.colours.values[index[::-1]]
        np.testing.assert_allclose(volume.index_to_world @ [*found, 1], place)
    low, high = (coarse.volume.to_world @ [*corner, 1] for corner in ((0,) * 3, (1,) * 3))
    step = 2 * np.max(coarse.volume.spacing)
    np.testing.assert_allclose(low, volume.to_world @ [0, 0, 0, 1], atol=step)
    np.testing.assert_allclose(high, volume.to_world @ [1, 1, 1, 1], atol=step)


def test_missing_time_steps_tell_how_many_there_are():
    with pytest.raises(MissingItemError, match="give 0 to 4") as caught:
        picked("a.tif", "frame", 5, 1 << 30)
    assert caught.value.count == 5


def test_every_kind_is_named_and_explained():
    """In the panel, and over images of what is no radiance."""
    assert tuple(CHOICES.values()) == COMPARISONS
    assert set(CAPTIONS) == set(KINDS) - {"image"}


def test_the_viewer_begins_with_the_first_of_several_time_steps(tmp_path):
    """All of them are offered by a slider; channels have to be chosen."""
    tifffile = pytest.importorskip("tifffile")
    values = np.random.default_rng(0).random((3, 4, 5, 6)).astype(np.float32)
    tifffile.imwrite(tmp_path / "a.tif", values, imagej=True, metadata={"axes": "TZYX"})
    np.save(tmp_path / "a.npy", values.transpose(1, 2, 3, 0))
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    args = parser.parse_args([str(tmp_path / "a.tif"), "--density"])
    np.testing.assert_array_equal(command._read(args)[0].values, values[0])
    steps = command._time_steps(args)
    assert (steps.count, steps.first) == (3, 0)
    np.testing.assert_array_equal(steps.read(2)[0].values, values[2])
    with pytest.raises(IrrcacheError, match="3 channels"):
        command._read(parser.parse_args([str(tmp_path / "a.npy"), "--density"]))


def test_errors_have_colours_and_round_limits():
    """Too dark is blue and too bright is red; limits are 1, 2 or 5 times a power of ten."""
    dark, none, bright = false_colours(np.array([-3.0, 0.0, 3.0]))
    assert dark[2] > 2 * dark[0] and bright[0] > 2 * bright[2] and np.ptp(none) == 0
    assert [rounded(v) for v in (0, 0.011, 0.02, 0.3, 0.7, 12)] == pytest.approx(
        [0.001, 0.02, 0.02, 0.5, 1, 20]
    )


def test_noisy_errors_are_means_over_blocks():
    """The side of blocks follows from the noise; blocks at the edges are smaller."""
    sides = [block_side(noise) for noise in (0.01, 0.05, 0.09, 0.3, 100.0, None)]
    assert sides == [1, 1, 2, 8, 16, 16]
    values = np.random.default_rng(0).normal(size=(7, 10))
    np.testing.assert_array_equal(block_means(values, 1), values)
    found = block_means(values, 4)
    np.testing.assert_allclose(found[:4, 4:8], values[:4, 4:8].mean())
    np.testing.assert_allclose(found[4:, 8:], values[4:, 8:].mean())


def test_references_are_as_fine_as_time_allows():
    """A pass of 4 x 4 pixels that took this long is followed by passes of at most 3 s."""
    assert [_finest(seconds, 4) for seconds in (0.1, 0.5, 2.0, 60.0)] == [1, 2, 4, 4]
