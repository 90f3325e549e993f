"""Mitsuba variants that the integrator supports."""

from __future__ import annotations

from mitsuba_irrcache.errors import IrrcacheError, original_message
from mitsuba_irrcache.machine.llvm import require_llvm

SUPPORTED = ("llvm_ad_rgb", "llvm_ad_mono", "cuda_ad_rgb", "cuda_ad_mono")


def select_variant(variant: str) -> None:
    """Select the variant of a command; raise IrrcacheError if it cannot be used on this machine."""
    import mitsuba as mi  # imported here because `irrcache doctor` does without

    if variant.startswith("llvm"):
        require_llvm()
    if variant not in mi.variants():
        raise IrrcacheError(
            f'Mitsuba has no variant "{variant}" (-m); it has {", ".join(mi.variants())}.'
        )
    try:
        mi.set_variant(variant)
    except ImportError as error:  # as without a GPU
        needed = "an NVIDIA GPU and its driver are needed" if "cuda" in variant else "see why"
        raise IrrcacheError(
            f'-m is "{variant}", which cannot be used on this machine '
            f"({original_message(error).rstrip('.')}): {needed} (irrcache doctor); or name another "
            f"variant, such as {SUPPORTED[0]}."
        ) from error


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
