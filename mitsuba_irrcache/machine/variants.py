"""Mitsuba variants that the integrator supports."""

from __future__ import annotations

from mitsuba_irrcache.errors import IrrcacheError

SUPPORTED = ("llvm_ad_rgb", "llvm_ad_mono", "cuda_ad_rgb", "cuda_ad_mono")


def require_variant(variant: str) -> None:
    """Raise IrrcacheError, with the reason, for an unsupported variant."""
    if variant in SUPPORTED:
        return
    if variant.startswith("scalar"):
        reason = "it would trace every voxel in interpreted Python"
    elif "spectral" in variant:
        reason = "the cache stores RGB or grey values, not wavelengths"
    elif "polarized" in variant:
        reason = "the cache stores no polarisation"
    else:
        reason = "it was never tested there"
    raise IrrcacheError(
        f'irrcache does not run in variant "{variant}": {reason}. '
        f"Use mi.set_variant with one of: {', '.join(SUPPORTED)}."
    )


def require_same_variant(made: str, current: str) -> None:
    """Raise IrrcacheError if the current variant is not the one that the scene was loaded in."""
    if made != current:
        raise IrrcacheError(
            f'irrcache: the scene was loaded in variant "{made}", but the current variant is '
            f'"{current}"; load the scene again, or call mi.set_variant("{made}").'
        )
