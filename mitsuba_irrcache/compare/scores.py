"""The errors of every snapshot against the reference, one row each."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from . import metrics, perceptual
from .reference import Reference
from .results import Measurement, Snapshot

#: Heading, unit (% of the mean radiance of the reference, or none) and meaning of each error.
METRICS = {
    "rmse": ("RMSE", "%", "root mean square error, net of the reference's noise"),
    "bias": ("mean error", "%", "mean signed error: the bias, since noise averages out"),
    "relative_mse": ("relative MSE", "", "squared error over squared radiance, pixel by pixel"),
    "display_rmse": ("display RMSE", "", "of the sRGB picture in [0, 1], as in the paper"),
    "block_rmse": ("blocks 8 × 8", "%", "net RMSE of block means: blotches, streaks and bands"),
    "ciede2000": ("CIEDE2000", "", "mean colour difference; about 1 is just noticeable"),
    "ciede2000_95": ("CIEDE2000, 95 %", "", "the colour difference that 5 % of pixels exceed"),
    "flip": ("FLIP", "", "perceived difference when alternating the images, 0 to 1"),
    "oiio_rms": ("OIIO RMS", "", "OpenImageIO's RMS error, with the reference's noise"),
    "oiio_max": ("OIIO max", "", "OpenImageIO's largest error"),
    "oiio_psnr": ("OIIO PSNR", " dB", "OpenImageIO's peak signal to noise ratio"),
}


def score_all(
    measurements: list[Measurement], reference: Reference, folder: Path, exposure: float
) -> list[dict]:
    """Return one row per snapshot of the report in ``folder``.

    Its columns are the integrator, the budget, the seconds and the errors of `METRICS`.
    """
    rows = []
    for measurement in measurements:
        for snapshot in measurement.snapshots:
            errors = score(snapshot.read(folder), reference, exposure)
            rows.append(_row(measurement, snapshot) | errors)
    return rows


def score(image: np.ndarray, reference: Reference, exposure: float = 0.0) -> dict:
    """Compute the errors of an image (height, width, channel) of linear radiance.

    "rmse", "bias", "block_rmse" and their uncertainties are in units of the mean radiance of the
    reference. Values that are not finite count as 0; "invalid" is their share.
    """
    x, a, b = (np.float64(metrics.colours(i)) for i in (image, reference.a, reference.b))
    finite = np.isfinite(x)
    x = np.where(finite, x, 0)
    r = 0.5 * (a + b)
    mean = float(r.mean()) or 1.0
    _, uncertainty = metrics.net_mse(x, a, b)
    difference = perceptual.ciede2000(x, r, exposure)
    return {
        "rmse": metrics.net_rmse(x, a, b) / mean,
        "rmse_resolved": float(np.sqrt(2 * uncertainty)) / mean,
        "bias": metrics.mean_error(x, a, b) / mean,
        "bias_uncertainty": metrics.mean_error_uncertainty(x, a, b) / mean,
        "relative_mse": metrics.relative_mse(x, a, b),
        "display_rmse": perceptual.display_rmse(x, a, b, exposure),
        "block_rmse": metrics.block_error(x, a, b) / mean,
        "ciede2000": float(difference.mean()),
        "ciede2000_95": float(np.quantile(difference, 0.95)),
        "flip": perceptual.flip(x, r, exposure),
        "invalid": float(1 - finite.mean()),
    } | perceptual.openimageio(x, r)


def reference_noise(reference: Reference) -> float:
    """Return the standard error of the reference in units of its mean radiance."""
    a, b = metrics.colours(reference.a), metrics.colours(reference.b)
    return metrics.noise(a, b) / np.sqrt(2) / (float(np.mean(0.5 * (a + b))) or 1.0)


def _row(measurement: Measurement, snapshot: Snapshot) -> dict:
    return {
        "integrator": measurement.integrator,
        "budget": snapshot.budget,
        "seconds": snapshot.total,
        **{f"seconds_{stage}": value for stage, value in snapshot.seconds.items()},
        "spp": snapshot.spp,
        "note": snapshot.note,
        "estimate": snapshot.estimate,
        "image": snapshot.image,
    }
