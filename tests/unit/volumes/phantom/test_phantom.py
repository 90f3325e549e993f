from __future__ import annotations

import hashlib
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

ndimage = pytest.importorskip("scipy.ndimage", reason="phantoms need the extra 'volumes'")

from mitsuba_irrcache.errors import IrrcacheError  # noqa: E402
from mitsuba_irrcache.volumes.phantom import (  # noqa: E402
    anatomy,
    cloud,
    organs,
    skeleton,
    thorax,
)
from mitsuba_irrcache.volumes.phantom.canvas import Canvas, Tissue  # noqa: E402
from mitsuba_irrcache.volumes.phantom.cloud import (  # noqa: E402
    BYTES_PER_VOXEL as CLOUD_BYTES_PER_VOXEL,
)
from mitsuba_irrcache.volumes.phantom.distance import Drum, Ellipsoid, Segment  # noqa: E402
from mitsuba_irrcache.volumes.phantom.thorax import BYTES_PER_VOXEL  # noqa: E402
from mitsuba_irrcache.volumes.phantom.vessels import MURRAY_EXPONENT, vessel_tree  # noqa: E402

SIZE = np.array([380.0, 240.0, 330.0])

# Voxels of 2.5 mm and of 5/3 mm: both are averaged to 5 mm where they are compared.
COARSE, FINE = (132, 96, 152), (198, 144, 228)

# Position (LPS, mm), radius in mm of the ball that is averaged, and the expected HU.
PLACES = {
    "air beside the patient": ((-180, -100, 20), 8, (-1000, -1000)),
    "trachea": ((0, -4, 290), 4, (-1024, -850)),
    "right lung": ((-85, 10, 190), 14, (-900, -780)),
    "left lung": ((90, 30, 150), 14, (-900, -780)),
    "gas in the stomach": ((70, -46, 78), 5, (-1024, -850)),
    "subcutaneous fat": ((0, -96, 40), 3, (-140, -40)),
    "muscle of the back": ((40, 70, 12), 4, (20, 80)),
    "liver": ((-75, 0, 55), 14, (90, 120)),
    "left ventricle": ((42, -41, 123), 10, (180, 240)),
    "descending aorta": ((24, 34, 160), 6, (180, 240)),
    "body of T8": ((0, 53, 157), 6, (220, 450)),
}


@pytest.fixture(scope="module")
def coarse():
    return thorax(COARSE)


@pytest.fixture(scope="module")
def fine():
    return thorax(FINE)


def axes(volume):
    """Return the open grid of the voxel centres in mm, from the volume's own placement."""
    matrix = volume.index_to_world
    x, y, z = (matrix[i, i] * np.arange(n) + matrix[i, 3] for i, n in enumerate(volume.size))
    return x[None, None, :], y[None, :, None], z[:, None, None]


def mean_about(volume, place, radius):
    x, y, z = axes(volume)
    squared = (x - place[0]) ** 2 + (y - place[1]) ** 2 + (z - place[2]) ** 2
    return float(volume.values[squared <= radius**2].mean())


def blocked(volume, factor):
    z, y, x = (n // factor for n in volume.values.shape)
    return volume.values.reshape(z, factor, y, factor, x, factor).mean(axis=(1, 3, 5))


def lungs(volume):
    """Return masks of the two largest connected parts of lung, the patient's right one first."""
    tissue = (volume.values > -960) & (volume.values < -650)
    labels, count = ndimage.label(ndimage.binary_erosion(tissue))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    largest = np.argsort(sizes)[::-1][:2] + 1
    pieces = [ndimage.binary_dilation(labels == i) & tissue for i in largest]
    return sorted(pieces, key=lambda mask: ndimage.center_of_mass(mask)[2])


def test_equal_shapes_give_equal_volumes():
    digests = {hashlib.sha256(thorax((67, 41, 53)).values.tobytes()).hexdigest() for _ in range(2)}
    assert len(digests) == 1


@pytest.mark.parametrize("shape", [(8, 8, 8), (31, 17, 101), (128, 64, 96), (9, 211, 10)])
def test_shape_and_placement(shape):
    volume = thorax(shape)
    assert volume.values.shape == shape
    assert volume.values.dtype == np.int16
    assert volume.unit == "HU"
    np.testing.assert_allclose(volume.physical_size, SIZE)
    corners = volume.to_world @ np.array([[0, 0, 0, 1], [1, 1, 1, 1]]).T
    np.testing.assert_allclose(corners[:3, 0], anatomy.LOWER, atol=1e-9)
    np.testing.assert_allclose(corners[:3, 1], anatomy.UPPER, atol=1e-9)


@pytest.mark.parametrize("name", PLACES)
def test_tissue_is_at_its_anatomical_position(name, coarse, fine):
    place, radius, (low, high) = PLACES[name]
    means = [mean_about(volume, place, radius) for volume in (coarse, fine)]
    assert all(low <= mean <= high for mean in means)
    assert means[0] == pytest.approx(means[1], abs=25)


def test_resolutions_agree_up_to_blur(coarse, fine):
    difference = np.abs(blocked(coarse, 2) - blocked(fine, 3))
    assert difference.mean() < 5
    assert np.abs(blocked(coarse, 2).mean() - blocked(fine, 3).mean()) < 1


def test_coarse_volume_is_the_mean_of_a_fine_one(coarse):
    half = thorax(tuple(n // 2 for n in COARSE))
    assert np.abs(half.values - blocked(coarse, 2)).max() <= 1


def test_amount_of_bone_hardly_depends_on_resolution(coarse, fine):
    def excess(volume):
        return np.clip(volume.values.astype(np.float64) - 260, 0, None).mean()

    shares = [(volume.values > 260).mean() for volume in (coarse, fine)]
    assert shares[0] == pytest.approx(shares[1], rel=0.1)
    assert excess(coarse) == pytest.approx(excess(fine), rel=0.15)
    # The box is 30 litres; the bones of a thorax with its shoulder girdle are one or two.
    assert 0.02 < shares[1] < 0.08


def test_patient_is_surrounded_by_air_and_not_cut_at_the_sides(fine):
    values = fine.values
    for face in (values[:, 0], values[:, -1], values[:, :, 0], values[:, :, -1]):
        assert np.all(face == -1000)


def test_two_lungs_of_adult_volume_the_right_one_larger(fine):
    right, left = (mask.sum() * np.prod(fine.spacing) / 1e6 for mask in lungs(fine))
    assert 2.5 < right + left < 6.5  # litres
    assert 1.0 < right / left < 1.6


def test_heart_points_to_the_left_and_forwards(fine):
    x, y, z = np.broadcast_arrays(*axes(fine))
    blood = (fine.values > 180) & (fine.values < 245) & (y < 0)
    apex = blood & (z > 95) & (z < 115)
    base = blood & (z > 150) & (z < 170)
    assert x[apex].mean() > x[base].mean() + 20
    assert y[apex].mean() < y[base].mean() - 10


def test_liver_is_on_the_right(fine):
    liver = mean_about(fine, (-85, 0, 80), 8)
    assert liver > 80
    assert mean_about(fine, (85, 0, 95), 8) < liver - 100


def test_skeleton_is_symmetric_and_the_viscera_are_not(fine):
    bone = ndimage.gaussian_filter((fine.values > 400).astype(np.float32), 1)
    soft = ndimage.gaussian_filter(np.clip(fine.values, -200, 250).astype(np.float32), 1)
    chest = (slice(40, 120), slice(20, 100), slice(40, -40))
    mirrored = np.corrcoef(bone.ravel(), bone[..., ::-1].ravel())[0, 1]
    assert mirrored > 0.97
    assert np.corrcoef(soft[chest].ravel(), soft[..., ::-1][chest].ravel())[0, 1] < 0.9


@pytest.mark.parametrize("rib", skeleton.RIBS, ids=lambda rib: f"rib {rib.number}")
def test_ribs_run_between_pleura_and_skin(rib):
    course = skeleton.rib_course(rib, anatomy.LEFT)
    x, y, z = course[14:].T
    above_pleura = organs.PLEURA.distance(x, y, z)
    assert above_pleura.min() > rib.radius
    below_skin = -anatomy.TORSO.distance(x, y, z)
    assert below_skin.min() > rib.radius + 4
    assert course[-1, 2] < course[0, 2]


def test_ribs_do_not_touch():
    points = [skeleton.rib_course(rib, anatomy.LEFT, 60) for rib in skeleton.RIBS]
    for upper, lower in pairwise(points):
        # Centre lines stay further apart than a rib is high.
        gaps = np.linalg.norm(upper[:, None] - lower[None], axis=-1).min(axis=1)
        assert gaps.min() > 2 * (3.2 + 3.0)


def test_cartilages_reach_the_sternum():
    bars = skeleton._sternum()
    for rib in skeleton.RIBS[:7]:
        x, y, z = np.reshape(rib.joint, (3, 1))
        assert min(bar.distance(x, y, z, 0.1)[0] for bar in bars) < 4


def test_vessels_follow_murrays_law():
    points = np.random.default_rng(1).uniform(-50, 50, (200, 3))
    tree = vessel_tree((0.0, 0.0, 60.0), points)
    leaving = {}
    for segment in tree:
        leaving.setdefault(tuple(segment.start), []).append(segment.end_radius)
    assert {tuple(segment.end) for segment in tree} == {tuple(point) for point in points}
    for segment in tree:
        branches = leaving.get(tuple(segment.end))
        if branches:
            total = np.sum(np.power(branches, MURRAY_EXPONENT))
            assert segment.end_radius**MURRAY_EXPONENT == pytest.approx(total, rel=1e-6)


finite = st.floats(-20, 20, width=32)
vector = st.tuples(finite, finite, finite)


@settings(max_examples=60, deadline=None)
@given(start=vector, end=vector, point=vector, radius=st.floats(1, 5))
def test_distance_to_a_capsule_is_the_nearest_point_of_its_axis(start, end, point, radius):
    start, end = np.array(start), np.array([end[0], end[1], end[2] + 45])
    axis_points = start + np.linspace(0, 1, 20001)[:, None] * (end - start)
    expected = np.linalg.norm(axis_points - point, axis=1).min() - radius
    x, y, z = np.array(point, dtype=np.float32)[:, None]
    capsule = Segment(start, end, radius, radius)
    assert capsule.distance(x, y, z, 0.1)[0] == pytest.approx(expected, abs=0.02)


@settings(max_examples=60, deadline=None)
@given(direction=vector.filter(lambda v: np.linalg.norm(v) > 1), where=st.floats(0.9, 1.1))
def test_solids_change_sign_at_their_surface(direction, where):
    radii = np.array([30.0, 20.0, 10.0])
    unit = np.array(direction) / np.linalg.norm(direction)
    surface = unit / np.linalg.norm(unit / radii)
    x, y, z = (surface * where)[:, None].astype(np.float32)
    distance = Ellipsoid((0, 0, 0), tuple(radii)).distance(x, y, z, 1.0)[0]
    assert distance == pytest.approx(0, abs=1e-4) or np.sign(distance) == np.sign(where - 1)
    assert abs(distance) <= np.linalg.norm(surface) * abs(where - 1) * 1.2 + 1e-4


def test_drum_has_its_height_and_radius():
    drum = Drum(np.array([1.0, 2.0, 3.0]), (10.0, 5.0), 4.0, np.array([0.0, 0.0, 1.0]))
    x, y, z = np.array([[11.0, 2, 3], [1, 7, 3], [1, 2, 7], [1, 2, -1]], dtype=np.float32).T
    np.testing.assert_allclose(drum.distance(x, y, z, 1.0), 0, atol=1e-5)


@pytest.mark.parametrize("radius", [0.2, 0.5, 1.0, 2.0, 4.0])
def test_a_thin_bar_preserves_its_cross_section(radius):
    canvas = Canvas((40, 40, 40), (-40, -40, -40), (40, 40, 40), Tissue(0))
    bar = Segment(np.array([-30.0, 0.3, 0.6]), np.array([30.0, -0.4, 0.9]), radius, radius)
    canvas.paint_solids([bar], Tissue(1))
    painted = canvas.values[:, :, 10:30].sum() * 2.0**3
    assert painted == pytest.approx(np.pi * radius**2 * 40, rel=0.4)


@pytest.mark.parametrize(
    "shape",
    [(7, 64, 64), (64, 64), (64, 64, 64, 64), (64, 64, 64.5), (64, "64", 64), 64, (-9,) * 3],
)
def test_invalid_shapes_are_refused(shape):
    with pytest.raises(IrrcacheError, match=r"shape is .*three integers .* at least 8"):
        thorax(shape)


def test_shapes_larger_than_memory_are_refused():
    with pytest.raises(IrrcacheError, match=rf"{BYTES_PER_VOXEL * 10**15} bytes.*smaller shape"):
        thorax((100_000, 100_000, 100_000))
    with pytest.raises(IrrcacheError, match="memory_limit"):
        thorax((64, 64, 64), memory_limit=10**6)


def test_memory_stays_within_the_estimate():
    tracemalloc.start()
    try:
        thorax(COARSE)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < BYTES_PER_VOXEL * np.prod(COARSE)


# The cloud


@pytest.fixture(scope="module")
def cumulus():
    return cloud()


def test_equal_shapes_give_equal_clouds():
    digests = {hashlib.sha256(cloud((37, 41, 53)).values.tobytes()).hexdigest() for _ in range(2)}
    assert len(digests) == 1


@pytest.mark.parametrize("shape", [(32, 32, 32), (33, 64, 48), (64, 40, 96), (300, 32, 35)])
def test_cloud_is_centred_with_empty_borders(shape):
    volume = cloud(shape)
    assert volume.values.shape == shape
    assert volume.values.dtype == np.float32
    assert volume.values.min() == 0 and 0.9 < volume.values.max() <= 1
    inner = volume.values[2:-2, 2:-2, 2:-2]
    assert np.count_nonzero(inner) == np.count_nonzero(volume.values)
    np.testing.assert_allclose(volume.physical_size, 2 * np.array(shape[::-1]) / max(shape))
    corners = volume.to_world @ np.array([[0, 0, 0, 1], [1, 1, 1, 1]]).T
    np.testing.assert_allclose(corners[:3].sum(axis=1), 0, atol=1e-12)


def test_cloud_is_the_same_at_every_resolution(cumulus):
    half = cloud((64, 64, 64))
    # Densities averaged over blocks of 1/32 of the side; they reach 1.
    difference = np.abs(blocked(half, 2) - blocked(cumulus, 4))
    assert difference.mean() < 0.004
    assert difference.max() < 0.1
    assert half.values.mean() == pytest.approx(cumulus.values.mean(), rel=0.002)


def test_cloud_is_mostly_empty_and_neither_binary_nor_blurry(cumulus):
    values = cumulus.values
    assert 0.6 < (values == 0).mean() < 0.75
    # Across an edge, relative to the density behind it: the ramp as a share of the side.
    behind = ndimage.maximum_filter(values, 11)
    edge = (values > 0.25 * behind) & (values < 0.75 * behind) & (behind > 0.3)
    slope = np.sqrt(sum(part**2 for part in np.gradient(values)))[edge] / behind[edge]
    assert 0.03 < 1 / np.median(slope) / len(values) < 0.06


def test_cloud_is_flat_below_and_round_above(cumulus):
    places = np.indices(cumulus.values.shape)[0]
    occupied = cumulus.values > 0.1
    columns = occupied.any(axis=0)
    below = np.where(occupied, places, len(places)).min(axis=0)[columns]
    above = np.where(occupied, places, -1).max(axis=0)[columns]
    # Half of the columns begin at nearly the same height; they end at very different ones.
    assert np.subtract(*np.percentile(below, [60, 10])) < len(cumulus.values) / 16
    assert np.subtract(*np.percentile(above, [60, 10])) > len(cumulus.values) / 6


@pytest.mark.parametrize("shape", [(31, 64, 64), (64, 64), (64, 64, 64.5), 64, (-64,) * 3])
def test_cloud_of_an_invalid_shape_is_refused(shape):
    with pytest.raises(IrrcacheError, match=r"shape is .*three integers .* at least 32"):
        cloud(shape)


def test_cloud_larger_than_memory_is_refused():
    with pytest.raises(IrrcacheError, match=r"bytes.*smaller shape"):
        cloud((100_000, 100_000, 100_000))


def test_cloud_memory_stays_within_the_estimate():
    shape = (128, 160, 192)
    tracemalloc.start()
    try:
        cloud(shape)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < CLOUD_BYTES_PER_VOXEL * np.prod(shape)
