"""Mitsuba variants that the integrator can run in."""

from __future__ import annotations

from mitsuba_irrcache.errors import IrrcacheError

SUPPORTED = ("llvm_ad_rgb", "llvm_ad_mono", "cuda_ad_rgb", "cuda_ad_mono")


def require_variant(variant: str) -> None:
    """Raises IrrcacheError, with the reason, for a variant that would be wrong or endless."""
    if variant in SUPPORTED:
        return
    if variant.startswith("scalar"):
        reason = "it would trace every voxel in interpreted Python"
    elif "spectral" in variant:
        reason = "the cache holds colours or grey values, not wavelengths"
    elif "polarized" in variant:
        reason = "the cache holds no polarisation"
    else:
        reason = "it was never tested there"
    raise IrrcacheError(
        f'irrcache does not run in variant "{variant}": {reason}. '
        f"Use mi.set_variant with one of: {', '.join(SUPPORTED)}."
    )


def require_same_variant(made: str, current: str) -> None:
    """Raises IrrcacheError where a scene is to be rendered in another variant than it is of."""
    if made != current:
        raise IrrcacheError(
            f'irrcache: the scene was loaded in variant "{made}", and "{current}" is set now; load '
            f'it again, or say mi.set_variant("{made}").'
        )
