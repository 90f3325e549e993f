"""Errors of the picture that a display shows: sRGB in [0, 1], colour difference, FLIP, OpenImageIO.

Unlike those in `metrics` they need one reference image and include its noise, but for
`display_rmse`.
"""

from __future__ import annotations

import warnings

import numpy as np
import OpenImageIO as oiio  # noqa: N813 (the name its documentation uses)

from .metrics import net_rmse


def display(image: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """The picture on a display: sRGB values in [0, 1] of linear radiance times 2^``exposure``.

    Returns (height, width, 3), float32; a grey image is repeated.
    """
    clipped = np.clip(image * 2.0**exposure, 0, 1).astype(np.float32)
    srgb = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)
    return np.broadcast_to(srgb, (*image.shape[:2], 3)).astype(np.float32)


def display_rmse(image: np.ndarray, a: np.ndarray, b: np.ndarray, exposure: float = 0.0) -> float:
    """RMSE of the displayed pictures in [0, 1], the paper's measure, net of the reference's
    noise.
    """
    return net_rmse(*(np.float64(display(x, exposure)) for x in (image, a, b)))


def ciede2000(image: np.ndarray, reference: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """CIEDE2000 colour difference of every pixel (height, width); about 1 is just noticeable."""
    with warnings.catch_warnings():  # colour-science warns of each optional package it lacks
        warnings.simplefilter("ignore")
        import colour

        labs = [
            colour.XYZ_to_Lab(colour.sRGB_to_XYZ(display(x, exposure))) for x in (image, reference)
        ]
        return np.asarray(colour.delta_E(*labs, method="CIE 2000"))


def flip(image: np.ndarray, reference: np.ndarray, exposure: float = 0.0) -> float | None:
    """Mean FLIP (NVIDIA's difference between alternating pictures, 0 to 1) at 67 pixels per degree.

    None where the package flip-evaluator is not installed.
    """
    try:
        import flip_evaluator
    except ImportError:
        return None
    shown = [np.ascontiguousarray(display(x, exposure)) for x in (reference, image)]
    return float(flip_evaluator.evaluate(*shown, "LDR", applyMagma=False)[1])


def openimageio(image: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """OpenImageIO's comparison in linear radiance: mean, RMS and largest error, and PSNR in dB."""
    buffers = [oiio.ImageBuf(np.ascontiguousarray(x, np.float32)) for x in (image, reference)]
    result = oiio.ImageBufAlgo.compare(*buffers, 0.0, 0.0)
    return {
        "oiio_mean": result.meanerror,
        "oiio_rms": result.rms_error,
        "oiio_max": result.maxerror,
        "oiio_psnr": result.PSNR,
    }
