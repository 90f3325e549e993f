"""AOVs: their names, their storage on a film, and the reconstruction of the image."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.render.aovs import AOVS, LEAST_COLOUR, Layers, parse_aovs

PIXELS = 7


@pytest.fixture(params=["rgb", "mono"])
def variant(request):
    """Run the test in each variant."""
    request.getfixturevalue(request.param)


def array(values) -> mi.Float:
    return mi.Float(np.float32(values))


def random_layers(probes: int = 4) -> Layers:
    """Return layers of `PIXELS` pixels with distinct values."""
    rng = np.random.default_rng(1)

    def spectrum() -> mi.Spectrum:
        return mi.Spectrum(*(array(rng.uniform(0.1, 1, PIXELS)) for _ in mi.Spectrum(0)))

    spectra = [spectrum() for _ in range(4)]
    scalars = [array(rng.uniform(0.1, 1, PIXELS)) for _ in range(probes + 2)]
    return Layers(*spectra, scalars[0], scalars[1:-1], scalars[-1])


def numbers(values) -> np.ndarray:
    """Convert to (channel, pixel), float64."""
    return np.array([np.array(v, dtype=np.float64) for v in values])


# Names


def test_a_list_of_images_keeps_its_order_and_names():
    """A list of AOVs preserves its order and names.

    Names are stripped, and a type without a name serves as its own name.
    """
    found = parse_aovs(" light : illumination,colour, a:b:noise ,, depth")
    expected = [
        ("light", "illumination"),
        ("colour", "colour"),
        ("a:b", "noise"),
        ("depth", "depth"),
    ]
    assert list(found.items()) == expected
    assert parse_aovs("") == parse_aovs(" , ") == {}
    assert parse_aovs("one:noise,two:noise") == {"one": "noise", "two": "noise"}


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("x:albedo", '"albedo"'),
        ("Colour", '"Colour"'),
        ("x:colour:", '""'),
        ("colour,noise,colour", '"colour" twice'),
        ("light:colour,light:noise", '"light" twice'),
    ],
)
def test_invalid_lists_are_refused(text, named):
    """Invalid lists are refused; the message names the entry and, for a wrong type, the valid
    ones.
    """
    with pytest.raises(IrrcacheError, match=named) as caught:
        parse_aovs(text)
    if "twice" not in named:
        assert all(kind in str(caught.value) for kind in AOVS)


# Channels


@pytest.mark.parametrize("probes", [0, 4])
def test_layers_survive_a_round_trip_through_channels(variant, probes):
    """Layers written to channels and read again are identical; all values are distinct."""
    layers = random_layers(probes)
    channels = layers.channels()
    assert len(channels) == 4 * len(mi.Spectrum(0)) + 2 + probes
    assert len(np.unique(numbers(channels))) == len(channels) * PIXELS
    again = Layers.of(channels)
    for name in ("scattered", "colour", "background", "transmittance", "probes"):
        mine, theirs = numbers(getattr(again, name)), numbers(getattr(layers, name))
        np.testing.assert_array_equal(mine, theirs, name)
    for name in ("depth", "bias"):
        mine, theirs = (np.array(getattr(of, name)) for of in (again, layers))
        np.testing.assert_array_equal(mine, theirs, name)


def test_images_have_the_channels_of_their_names(variant):
    """Each AOV has as many channels as `AOVS` declares, in each variant."""
    for layers in (Layers.background_only(mi.Spectrum(0.5)), random_layers()):
        for kind, names in AOVS.items():
            assert len(layers.aov(kind)) == len(names), kind


def test_colours_keep_the_order_of_their_channels(rgb):
    """RGB channels have the film's order, and are not converted to luminance."""
    layers = random_layers()
    for kind in (kind for kind, names in AOVS.items() if names == "RGB"):
        expected = numbers(getattr(layers, kind))
        np.testing.assert_array_equal(numbers(layers.aov(kind)), expected, kind)


# Values


def test_colour_times_illumination_plus_background_is_the_image(variant):
    """Colour times illumination plus background is the image, also in pixels without colour."""
    layers = random_layers()
    layers.colour = layers.colour * dr.select(dr.arange(mi.UInt32, PIXELS) % 3 == 0, mi.Float(0), 1)
    expected = numbers(layers.scattered) + numbers(layers.background)
    np.testing.assert_array_equal(numbers(layers.radiance()), expected.astype(np.float32))
    again = numbers(layers.radiance(layers.illumination))
    np.testing.assert_allclose(again, expected, rtol=3e-7)


def test_another_illumination_replaces_its_own_only(variant):
    """Replacing the illumination by its double doubles the scattered radiance only.

    The background is unchanged, and so is E in pixels without colour.
    """
    layers = random_layers()
    dark = np.arange(PIXELS) % 3 == 0
    layers.colour = layers.colour * array(~dark)
    light, background = numbers(layers.scattered), numbers(layers.background)
    doubled = numbers(layers.radiance(2 * layers.illumination))
    np.testing.assert_allclose(doubled, np.where(dark, 1, 2) * light + background, rtol=3e-7)


def test_illumination_is_zero_without_colour(rgb):
    """The illumination is 0 where the colour is not safely positive, channel by channel.

    Reconstruction filters with negative lobes give colours that are tiny, 0 or negative.
    """
    layers = random_layers()
    values = np.array([1.0, 2 * LEAST_COLOUR, LEAST_COLOUR, 1e-30, 0.0, -0.0, -0.3], np.float32)
    layers.colour.y = array(values)
    safe = np.float32(values) > np.float32(LEAST_COLOUR)
    assert safe.tolist() == [True, True, False, False, False, False, False]
    valid = np.array([np.array(v) for v in layers.valid])
    np.testing.assert_array_equal(valid[1], safe)
    assert valid[0].all() and valid[2].all()
    illumination = numbers(layers.illumination)
    assert np.isfinite(illumination).all()
    expected = np.where(safe, numbers(layers.scattered)[1] / np.where(safe, values, 1), 0)
    np.testing.assert_allclose(illumination[1], expected, rtol=3e-7)


def test_depth_is_weighted_by_opacity(variant):
    """Depth is int (-dT/dt) t dt divided by the opacity 1 - T, and 0 where the opacity is 0.

    A half transparent object at 3 has depth 3, not 1.5.
    """
    layers = random_layers()
    opacity = np.linspace(0, 1, PIXELS)
    clear = array(1 - opacity)
    layers.transmittance = mi.Spectrum(*(clear for _ in mi.Spectrum(0)))
    layers.depth = array(3 * opacity)
    (depth,) = numbers(layers.aov("depth"))
    np.testing.assert_allclose(depth, np.where(opacity > 0, 3, 0), rtol=1e-5)


def test_noise_is_the_root_mean_square_of_the_probes(variant):
    """``noise`` is the root mean square of the probes, and an image of zeros without probes."""
    layers = random_layers()
    expected = np.sqrt((numbers(layers.probes) ** 2).mean(axis=0))
    np.testing.assert_allclose(np.array(layers.noise), expected, rtol=1e-6)
    layers.probes = []
    np.testing.assert_array_equal(np.array(layers.noise), np.zeros(PIXELS))
