"""Errors of the tone-mapped image: sRGB in [0, 1], colour difference, FLIP, OpenImageIO.

Except for `display_rmse` they compare with one reference image and include its noise, unlike the
errors in `metrics`.
"""

from __future__ import annotations

import warnings

import numpy as np
import OpenImageIO as oiio  # noqa: N813 (the name its documentation uses)

from .metrics import net_rmse


def display(image: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """Return sRGB values in [0, 1] of linear radiance times 2^``exposure``.

    The result is float32 (height, width, 3); a grey image is repeated in all channels.
    """
    clipped = np.clip(image * 2.0**exposure, 0, 1).astype(np.float32)
    srgb = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)
    return np.broadcast_to(srgb, (*image.shape[:2], 3)).astype(np.float32)


def display_rmse(image: np.ndarray, a: np.ndarray, b: np.ndarray, exposure: float = 0.0) -> float:
    """Return the net RMSE of sRGB values in [0, 1], the measure of the paper."""
    return net_rmse(*(np.float64(display(x, exposure)) for x in (image, a, b)))


def ciede2000(image: np.ndarray, reference: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """Return the CIEDE2000 difference of each pixel (height, width); 1 is just noticeable."""
    with warnings.catch_warnings():  # colour-science warns of each missing optional package
        warnings.simplefilter("ignore")
        import colour

        labs = [
            colour.XYZ_to_Lab(colour.sRGB_to_XYZ(display(x, exposure))) for x in (image, reference)
        ]
        return np.asarray(colour.delta_E(*labs, method="CIE 2000"))


def flip(image: np.ndarray, reference: np.ndarray, exposure: float = 0.0) -> float | None:
    """Return the mean FLIP (perceptual difference, 0 to 1) at 67 pixels per degree.

    None if the package flip-evaluator is not installed.
    """
    try:
        import flip_evaluator
    except ImportError:
        return None
    shown = [np.ascontiguousarray(display(x, exposure)) for x in (reference, image)]
    return float(flip_evaluator.evaluate(*shown, "LDR", applyMagma=False)[1])


def openimageio(image: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Compare in linear radiance with OpenImageIO: mean, RMS and maximum error, and PSNR in dB."""
    buffers = [oiio.ImageBuf(np.ascontiguousarray(x, np.float32)) for x in (image, reference)]
    result = oiio.ImageBufAlgo.compare(*buffers, 0.0, 0.0)
    return {
        "oiio_mean": result.meanerror,
        "oiio_rms": result.rms_error,
        "oiio_max": result.maxerror,
        "oiio_psnr": result.PSNR,
    }
