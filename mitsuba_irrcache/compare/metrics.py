"""Errors of an image against a reference that consists of two independent halves a and b.

The halves' noise is independent of the image and of each other, so its expectation vanishes in
products such as (x - a)(x - b). Images are arrays (height, width, channel) of linear radiance.
"""

from __future__ import annotations

import numpy as np


def colours(image: np.ndarray) -> np.ndarray:
    """Return the colour channels of an image (height, width, channel), without alpha and AOVs."""
    return image[..., : 3 if image.shape[-1] >= 3 else 1]


def net_mse(image: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Return the mean square error without the reference's noise, mean((x - a)(x - b)).

    The second value is the standard error of this estimate for independent pixels.
    """
    products = np.multiply(image - a, image - b, dtype=np.float64)
    return float(products.mean()), float(products.std() / np.sqrt(products.size))


def net_rmse(image: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Return the RMSE without the reference's noise, sqrt(mean((x - a)(x - b)))."""
    return root(net_mse(image, a, b)[0])


def relative_mse(image: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean of (x - a)(x - b) / (r^2 + 0.01 mean(r)^2), where r = (a + b) / 2.

    Errors in dark pixels have the same weight as errors in bright ones.
    """
    r = 0.5 * (np.asarray(a, dtype=np.float64) + b)
    floor = 0.01 * r.mean() ** 2 or 1.0
    return float(np.mean((image - a) * (image - b) / (r**2 + floor)))


def mean_error(image: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean signed error: the bias, to which noise does not contribute in expectation."""
    return float(np.mean(image - 0.5 * (a + b), dtype=np.float64))


def mean_error_uncertainty(image: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Return the standard error of `mean_error`.

    It is estimated from the spread of the means over about 64 blocks, because the errors of nearby
    pixels may be correlated, for example by a cache or a filter.
    """
    size = max(1, min(image.shape[:2]) // 8)
    means = block_means(image - 0.5 * (a + b), size).mean(axis=-1)
    return float(means.std() / np.sqrt(means.size))


def block_error(image: np.ndarray, a: np.ndarray, b: np.ndarray, size: int = 8) -> float:
    """Return the net RMSE of means over blocks of ``size`` x ``size`` pixels.

    It measures blotches and bands. NaN for an image smaller than a block.
    """
    if min(image.shape[:2]) < size:
        return float("nan")
    return root(np.mean(block_means(image - a, size) * block_means(image - b, size)))


def discretisation_error(x: np.ndarray, y: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Return the error common to two independent runs x and y, without their noise."""
    return root(np.mean((x - a) * (y - b), dtype=np.float64))


def noise(x: np.ndarray, y: np.ndarray) -> float:
    """Return the standard deviation of one run, estimated from two independent ones."""
    return root(0.5 * np.mean((x - y) ** 2, dtype=np.float64))


def block_means(image: np.ndarray, size: int) -> np.ndarray:
    """Return means over blocks; incomplete blocks at the right and bottom are ignored."""
    height, width = (n // size for n in image.shape[:2])
    cropped = np.asarray(image, dtype=np.float64)[: height * size, : width * size]
    return cropped.reshape(height, size, width, size, -1).mean(axis=(1, 3))


def root(value: float) -> float:
    """Return the square root with the sign of x: the estimate of a small square may be negative."""
    return float(np.copysign(np.sqrt(abs(value)), value))
